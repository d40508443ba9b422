"""Recognition of given objects: the instances are known, and each is to be named with one of the classes.

Top-1 accuracy of a class is the share of its instances whose first name is right, and top-k that of those whose first k
names have the right one. SplatDistill's table 1, after CLIP² (Zeng et al. 2023), prints top-1 of each of ScanNet's
classes and their unweighted mean; there are 17 of them, without "otherfurniture". The mean over instances, in which
frequent classes count more, is printed too.

Files (there is no official format) are lists of JSON objects:

    labels       {"scene_id": "scene0011_00", "object_id": 3, "label": "chair"}
    predictions  {"scene_id": "scene0011_00", "object_id": 3, "labels": ["chair", "sofa"]}, the likeliest first

`evaluate protocol=recognition` ranks the classes by the cosine of their names with the mean feature of an object's
Gaussians.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from gsencoder.core.arrays import first_repeated
from gsencoder.core.errors import InputError, counted, error_prefix
from gsencoder.core.files import write_json
from gsencoder.data.labels.classes import load_classes, write_classes
from gsencoder.data.labels.files import (
    brief,
    entries_of,
    name_value,
    object_id,
    read_benchmark_json,
    refuse_repeated,
    scene_name,
)
from gsencoder.evaluate.benchmarks.files import ScoreOptions
from gsencoder.evaluate.benchmarks.protocol import (
    CLASS_IDS,
    LABELS,
    PREDICTIONS,
    Benchmark,
    Evaluation,
    Protocol,
    SceneResult,
    predicted_classes,
)
from gsencoder.evaluate.sources import LabeledPoints, class_cosines
from gsencoder.evaluate.tables import ScoreReport, grouped, mean_of, spread, table_of
from gsencoder.text.table import TextEncoder
from gsencoder.types import GaussianFeatures, Scene

OPTIONS = ("classes", "allow_missing")
KS = (1, 5)
"""Numbers of names of which one has to be right."""
RANKED = 10
"""Names that are predicted for each object."""


ObjectKey = tuple[str, str]
"""Scene and id of an object."""
RankedNames = Mapping[ObjectKey, tuple[str, ...]]
"""The classes predicted for objects, the likeliest first, each once; none where the method has no answer."""


class RecognizedInstance(NamedTuple):
    """A labeled object, and the rank of its class among the predicted names, from 1; 0 if it is not among them."""

    scene: str
    name: str
    rank: int
    answered: bool


class RecognitionScores(NamedTuple):
    """The accuracies of instances, for each k; NaN without any.

    Attributes:
        mean: over the classes that have instances.
    """

    classes: dict[int, dict[str, float]]
    mean: dict[int, float]
    overall: dict[int, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class RecognitionProtocol(Protocol):
    """All named objects with points count."""

    name: Literal["recognition"] = "recognition"

    def start(self, evaluation: Evaluation) -> "RecognitionBenchmark":
        return RecognitionBenchmark(evaluation)


Recognized = tuple[Mapping[ObjectKey, str], RankedNames]


class RecognitionBenchmark(Benchmark[Recognized]):
    def __init__(self, evaluation: Evaluation) -> None:
        self.evaluation, self.classes = evaluation, predicted_classes(evaluation)

    def predict(self, scene: Scene, features: GaussianFeatures) -> Recognized:
        points = self.classes.points(scene)
        labels = {(scene.name, str(number)): name for number, name in points.named_ids().items()}
        return labels, predict_recognition(points, features, self.classes.table.names, self.evaluation.words)

    def report(self, results: Sequence[SceneResult[Recognized]]) -> ScoreReport:
        """Writes and scores both lists."""
        labels, predictions = (self.evaluation.file(f"{name}.json") for name in (LABELS, PREDICTIONS))
        for side, path, key in ((0, labels, "label"), (1, predictions, "labels")):
            values = [each for result in sorted(results, key=lambda r: r.scene) for each in result.value[side].items()]
            write_json(path, [{"scene_id": scene, "object_id": number, key: v} for (scene, number), v in values])
        write_classes(self.evaluation.file(CLASS_IDS), self.classes.table)
        options = ScoreOptions(method=self.evaluation.method, classes=str(self.evaluation.file(CLASS_IDS)))
        return score(predictions, labels, options)


def predict_recognition(
    points: LabeledPoints, features: GaussianFeatures, names: Sequence[str], text: TextEncoder
) -> RankedNames:
    """The classes nearest to the mean feature of each named object's Gaussians, the nearest first; none for an object
    of which no Gaussian was seen."""
    numbers = list(points.named_ids())
    cosines = class_cosines(features, [points.rows_of(number) for number in numbers], names, text)
    return {
        (points.scene, str(number)): ()
        if np.isnan(row).any()
        else tuple(names[each] for each in np.argsort(-row, kind="stable")[:RANKED])
        for number, row in zip(numbers, cosines, strict=True)
    }


def score(predictions: Path, labels: Path, options: ScoreOptions) -> ScoreReport:
    """Accuracy of the classes of given objects."""
    true_names = read_recognition_labels(labels)
    names = load_classes(options.classes).names if options.classes else sorted(set(true_names.values()))
    ranked = read_recognition_predictions(predictions)
    with error_prefix(predictions):
        recognized = recognize(ranked, true_names, names, allow_missing=options.allow_missing)
    if not recognized:
        raise InputError(f"{labels}: nothing to score: it holds no object of the {len(names)} classes")
    scores = recognition_scores(recognized, names)
    counts = Counter(each.name for each in recognized)
    by_scene = [
        {"scene": scene, "objects": len(each)}
        | {f"top_{k}": value for k, value in recognition_scores(each, names).overall.items()}
        for scene, each in grouped(recognized, "scene").items()
    ]
    by_class = [
        {"class": name, "objects": counts[name]} | {f"top_{k}": scores.classes[k][name] for k in KS} for name in names
    ]
    return ScoreReport(
        results={
            "protocol": "recognition",
            "objects": len(recognized),
            "unanswered": sum(not each.answered for each in recognized),
            "other_classes": len(true_names) - len(recognized),
            **{f"mean_{k}": value for k, value in scores.mean.items()},
            **{f"overall_{k}": value for k, value in scores.overall.items()},
            "spread": spread(by_scene, [f"top_{k}" for k in KS]),
        },
        table=table_of(
            "Recognition of given objects, top-1",
            {options.method: {"mean": scores.mean[1], **scores.classes[1]}},
            published="splatdistill_1_recognition",
            by_class=names,
        ),
        rows={"scenes": by_scene, "classes": by_class},
        line=f"{counted(len(recognized), 'object')}, averaged over classes (over objects): "
        + ", ".join(f"top-{k} {scores.mean[k]:.3f} ({scores.overall[k]:.3f})" for k in KS),
    )


def recognize(
    predictions: RankedNames, labels: Mapping[ObjectKey, str], classes: Sequence[str], *, allow_missing: bool = False
) -> list[RecognizedInstance]:
    """Looks up every labeled object of the classes among the predictions, in the order of the labels; objects of other
    classes are not scored, whether they are predicted or not.

    Args:
        allow_missing: count instances without a prediction as wrong, instead of refusing them.
    """
    for key, names in predictions.items():
        if key not in labels:
            raise InputError(f"{described(key)} is predicted, and not in the truth")
        wrong = next((name for name in names if name not in classes), None)
        if wrong is not None:
            raise InputError(f"{described(key)} is predicted as {wrong[:40]!r}, which is no class")
        if first_repeated(names):
            raise InputError(f"{described(key)} has a name twice; expected each once")
    results = []
    for key, name in labels.items():
        if name not in classes:
            continue
        if key not in predictions and not allow_missing:
            raise InputError(f"{described(key)} has no prediction")
        ranked = predictions.get(key, ())
        rank = ranked.index(name) + 1 if name in ranked else 0
        results.append(RecognizedInstance(key[0], name, rank, bool(ranked)))
    return results


def recognition_scores(
    instances: Sequence[RecognizedInstance], classes: Sequence[str], *, ks: Sequence[int] = KS
) -> RecognitionScores:
    """The scores of instances of any scenes, as `recognize` gives them."""
    of_name = grouped(instances, "name")

    def share(rows: Sequence[RecognizedInstance], k: int) -> float:
        return mean_of([float(1 <= each.rank <= k) for each in rows])

    table = {k: {name: share(of_name.get(name, ()), k) for name in classes} for k in ks}
    mean = {k: mean_of(list(row.values())) for k, row in table.items()}
    return RecognitionScores(table, mean, {k: share(instances, k) for k in ks})


def described(key: tuple[str, str]) -> str:
    """An object's name in messages."""
    return f"object {key[1]} of {key[0]}"


def read_recognition_labels(path: Path) -> dict[ObjectKey, str]:
    """Reads the class of each object."""
    rows = _entries(path, "scene_id, object_id and label", foreign="labels")
    return {key: name_value(entry.get("label"), where, "label") for key, entry, where in rows}


def read_recognition_predictions(path: Path) -> dict[ObjectKey, tuple[str, ...]]:
    """Reads the names predicted for each object."""
    predictions: dict[ObjectKey, tuple[str, ...]] = {}
    for key, entry, where in _entries(path, "scene_id, object_id and labels", foreign="label"):
        values = entry.get("labels")
        if values is None and "labels" in entry:
            values = []
        if not isinstance(values, list):
            raise InputError(f"{where}: labels must be a list of names, got {brief(values)}")
        names = (name_value(value, where, f"labels[{index}]") for index, value in enumerate(values))
        predictions[key] = tuple(names)
    return predictions


def _entries(path: Path, expected: str, *, foreign: str) -> list[tuple[ObjectKey, Mapping[str, Any], str]]:
    """The entries of a file about different objects, and where they stand."""
    rows = []
    for entry, where in entries_of(read_benchmark_json(path), path, expected):
        if foreign in entry:
            raise InputError(f"{where}: unexpected key {foreign!r}; predictions and truth may be swapped")
        number = object_id(entry.get("object_id"), where)
        rows.append(((scene_name(entry.get("scene_id"), where), str(number)), entry, where))
    refuse_repeated(path, [key for key, _, _ in rows], described)
    return rows
