"""The naming protocol: the accuracy of classifying Gaussians of labeled scenes by the nearest word to their features.

The classes of a scene are the names of its objects and "other", the normalized mean of the text table. The ground truth
is the class nearest to the feature fused from the maps of the labels teacher. Only Gaussians that were seen count, and
all names count equally, however many Gaussians they have.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from jaxtyping import Float32, Int64

from gsencoder.core.errors import InputError
from gsencoder.data.seeding.seed import SeedConfig
from gsencoder.evaluate.sources import FeatureSource, with_features
from gsencoder.fusion.errors import field_error
from gsencoder.fusion.fuse import FuseConfig, fuse
from gsencoder.teachers.build import build_teacher
from gsencoder.teachers.labels import LabelsConfig, LabelsTeacher
from gsencoder.text.vocabulary import Words
from gsencoder.types import GaussianFeatures, Scene

CHUNK_ROWS = 16_384
"""Rows of features that are compared with all words in one matrix product."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NamingProtocol:
    """Selection of the names that count."""

    name: Literal["naming"] = "naming"
    min_gaussians: int = field(
        default=1, metadata={"help": "smallest number of Gaussians, over all scenes, that a name must have to count"}
    )

    def __post_init__(self) -> None:
        if self.min_gaussians < 1:
            raise InputError(f"min_gaussians: expected 1 or more, got {self.min_gaussians}")


@dataclass(frozen=True, slots=True, kw_only=True)
class NamingCounts:
    """Numbers of Gaussians of each name in one scene, and of those classified correctly.

    Attributes:
        total: for each name, the Gaussians whose fused feature is nearest to it.
        correct: for each name, those of them whose evaluated feature is nearest to it too.
        cosine: mean cosine of evaluated and fused features about the mean of the space; NaN between different spaces.
    """

    scene: str
    total: dict[str, int]
    correct: dict[str, int]
    cosine: float
    seconds: dict[str, float]


def evaluate_naming(
    scenes: Iterable[tuple[Scene, float]],
    source: FeatureSource,
    words: Words,
    *,
    seeds: SeedConfig = SeedConfig(),
    fusion: FuseConfig = FuseConfig(),
) -> list[NamingCounts]:
    """Runs the protocol scene by scene; one scene is in memory at a time.

    Args:
        scenes: labeled scenes with instance maps and the seconds of loading, as `load_scenes` yields them.
        source: computes the features to evaluate.
        words: text table of the labels teacher.
        seeds: how Gaussians are made for scenes without.
        fusion: how the ground truth is fused.

    Returns:
        One result per scene, in order.
    """
    results = []
    for loaded_scene, load_seconds in scenes:
        scene, features, seconds = with_features(loaded_scene, source, seeds)
        teacher = build_teacher(LabelsConfig(), scene, words)
        assert isinstance(teacher, LabelsTeacher)
        truth = fuse(scene, teacher, fusion).features
        if features.space.text_encoder != words.space.text_encoder:
            raise InputError(
                f"naming: the features are of the space ({features.space.describe()}), but the words of "
                f"({words.space.describe()}); give words of the features' space"
            )
        results.append(compare_names(scene.name, truth, features, teacher, {"load": load_seconds, **seconds}))
    return results


def compare_names(
    name: str,
    truth: GaussianFeatures,
    features: GaussianFeatures,
    teacher: LabelsTeacher,
    seconds: dict[str, float],
) -> NamingCounts:
    """Counts for which Gaussians the nearest word to the feature is the nearest word to the fused feature.

    Args:
        truth: features fused from the teacher's maps; Gaussians not seen in them do not count.
        features: features to evaluate, of the same Gaussians.
        teacher: labels teacher of the scene.
        seconds: seconds of each step, stored in the result.
    """
    rows = np.flatnonzero(truth.seen)
    true_codes, predicted_codes = (nearest_words(values, rows, teacher.vectors) for values in (truth, features))
    total = np.bincount(true_codes, minlength=len(teacher.names))
    correct = np.bincount(true_codes[predicted_codes == true_codes], minlength=len(teacher.names))
    present = np.flatnonzero(total)
    return NamingCounts(
        scene=name,
        total={teacher.names[code]: int(total[code]) for code in present},
        correct={teacher.names[code]: int(correct[code]) for code in present},
        cosine=1 - field_error(features, truth).centered if features.space == truth.space else float("nan"),
        seconds=seconds,
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


def naming_scores(scenes: Sequence[NamingCounts], protocol: NamingProtocol = NamingProtocol()) -> dict[str, Any]:
    """The metrics of the protocol: accuracy averaged over names including "other", over names of objects, and over
    Gaussians; mean cosine; and the accuracy of each name, in ascending order.
    """
    total: dict[str, int] = {}
    correct: dict[str, int] = {}
    for scene in scenes:
        for name, count in scene.total.items():
            total[name] = total.get(name, 0) + count
            correct[name] = correct.get(name, 0) + scene.correct[name]
    accuracies = {name: correct[name] / count for name, count in total.items() if count >= protocol.min_gaussians}
    if not accuracies:
        raise InputError(
            f"naming: no name has {protocol.min_gaussians} Gaussians or more; lower protocol.min_gaussians"
        )
    of_names = [accuracy for name, accuracy in accuracies.items() if name != "other"]
    gaussians = sum(total[name] for name in accuracies)
    order = sorted(accuracies, key=lambda name: (accuracies[name], name))
    return {
        "accuracy": float(np.mean(list(accuracies.values()))),
        "accuracy_named": float(np.mean(of_names)) if of_names else float("nan"),
        "accuracy_gaussians": sum(correct[name] for name in accuracies) / gaussians,
        "cosine": float(np.mean([scene.cosine for scene in scenes])),
        "names": {name: {"gaussians": total[name], "accuracy": accuracies[name]} for name in order},
    }
