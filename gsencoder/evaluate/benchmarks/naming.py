"""Naming of Gaussians: the accuracy of classifying them by the word nearest to their feature.

The classes of a scene are the names of its objects and "other", the normalized mean of the text table. The ground truth
is the class nearest to the feature fused from the maps of the labels teacher. Only Gaussians that were seen count, and
all names count equally, however many Gaussians they have.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float32, Int64

from gsencoder.core.errors import InputError, counted
from gsencoder.evaluate.benchmarks.protocol import Benchmark, Evaluation, Protocol, SceneResult
from gsencoder.evaluate.tables import ScoreReport, mean_of, table_of
from gsencoder.fusion.basis import field_error
from gsencoder.fusion.fuse import fuse
from gsencoder.teachers.labels import LabelsConfig, LabelsTeacher
from gsencoder.types import GaussianFeatures, Scene

CHUNK_ROWS = 16_384
"""Rows of features that are compared with all words in one matrix product."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NamingProtocol(Protocol):
    """The names of all objects count."""

    name: Literal["naming"] = "naming"

    def start(self, evaluation: Evaluation) -> "NamingBenchmark":
        return NamingBenchmark(evaluation)


@dataclass(frozen=True, slots=True, kw_only=True)
class NamingCounts:
    """For each name of one scene the Gaussians whose fused feature is nearest to it, those of them whose evaluated
    feature is too, and the mean centered cosine of both features; NaN between different spaces."""

    total: dict[str, int]
    correct: dict[str, int]
    cosine: float


class NamingBenchmark(Benchmark[NamingCounts]):
    def __init__(self, evaluation: Evaluation) -> None:
        self.evaluation = evaluation

    def predict(self, scene: Scene, features: GaussianFeatures) -> NamingCounts:
        words = self.evaluation.words
        if features.space.text_encoder != words.space.text_encoder:
            raise InputError(
                f"naming: the features are of the space ({features.space.describe()}), but the words of "
                f"({words.space.describe()}); give words of the features' space"
            )
        teacher = LabelsConfig().build(scene, words)
        return compare_names(fuse(scene, teacher, self.evaluation.fusion).features, features, teacher)

    def report(self, results: Sequence[SceneResult[NamingCounts]]) -> ScoreReport:
        scores = naming_scores([result.value for result in results])
        by_scene = [
            {
                "scene": result.scene,
                "gaussians": sum(result.value.total.values()),
                **(naming_scores([result.value]) if result.value.total else {}),
            }
            for result in results
        ]
        shares = {name: value for name, value in scores.items() if name != "names"}
        return ScoreReport(
            results={"protocol": "naming", **scores, "scenes": by_scene},
            table=table_of("Naming", {self.evaluation.method: shares}),
            rows={
                "names": [{"name": name, **row} for name, row in scores["names"].items()],
                "scenes": [{name: value for name, value in row.items() if name != "names"} for row in by_scene],
            },
            line=f"{counted(len(scores['names']), 'name')} in {counted(len(results), 'scene')}: accuracy "
            f"{scores['accuracy']:.3f} averaged over names, {scores['accuracy_gaussians']:.3f} over Gaussians, "
            f"centered cosine {scores['cosine']:.3f}",
        )


def compare_names(truth: GaussianFeatures, features: GaussianFeatures, teacher: LabelsTeacher) -> NamingCounts:
    """Counts for which Gaussians the nearest word to the feature is the nearest word to the fused feature.

    Args:
        truth: features fused from the teacher's maps; Gaussians not seen in them do not count.
    """
    rows = np.flatnonzero(truth.seen)
    true_codes, predicted_codes = (nearest_words(values, rows, teacher.vectors) for values in (truth, features))
    total = np.bincount(true_codes, minlength=len(teacher.names))
    correct = np.bincount(true_codes[predicted_codes == true_codes], minlength=len(teacher.names))
    present = np.flatnonzero(total)
    return NamingCounts(
        total={teacher.names[code]: int(total[code]) for code in present},
        correct={teacher.names[code]: int(correct[code]) for code in present},
        cosine=1 - field_error(features, truth).centered if features.space == truth.space else float("nan"),
    )


def nearest_words(
    features: GaussianFeatures, rows: Int64[np.ndarray, " n"], vectors: Float32[np.ndarray, "C D"]
) -> Int64[np.ndarray, " n"]:
    """For each of the given rows, the index of the vector with the largest cosine to its feature."""
    directions = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    codes = [
        (features.decode(rows[start : start + CHUNK_ROWS]) @ directions.T).argmax(axis=1)
        for start in range(0, len(rows), CHUNK_ROWS)
    ]
    return np.concatenate(codes) if codes else np.zeros(0, np.int64)


def naming_scores(scenes: Sequence[NamingCounts]) -> dict[str, Any]:
    """Accuracy averaged over names including "other", over names of objects, and over Gaussians; mean cosine; and the
    accuracy of each name, in ascending order."""
    total, correct = Counter[str](), Counter[str]()
    for scene in scenes:
        total.update(scene.total)
        correct.update(scene.correct)
    if not total:
        raise InputError("naming: the views of no scene show a Gaussian; give scenes with instance maps")
    accuracies = {name: correct[name] / count for name, count in total.items()}
    order = sorted(accuracies, key=lambda name: (accuracies[name], name))
    return {
        "accuracy": mean_of(list(accuracies.values())),
        "accuracy_named": mean_of([each for name, each in accuracies.items() if name != "other"]),
        "accuracy_gaussians": sum(correct.values()) / sum(total.values()),
        "cosine": float(np.mean([scene.cosine for scene in scenes])),
        "names": {name: {"gaussians": total[name], "accuracy": accuracies[name]} for name in order},
    }
