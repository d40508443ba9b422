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

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from gsencoder.core.arrays import first_repeated
from gsencoder.core.errors import InputError, about, counted
from gsencoder.core.files import write_json
from gsencoder.data.labels.classes import load_classes, write_classes
from gsencoder.data.labels.files import (
    Entry,
    entries_of,
    name_value,
    object_id,
    read_benchmark_json,
    refuse_repeated,
    scene_name,
    shown,
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
from gsencoder.evaluate.tables import ScoreReport, mean_of, spread, table_of
from gsencoder.text.table import TextEncoder
from gsencoder.types import GaussianFeatures, Scene

OPTIONS = ("classes", "allow_missing")
KS = (1, 5)
"""Numbers of names of which one has to be right."""
RANKED = 10
"""Names that are predicted for each object."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectKey:
    """An object of a scene, by its id there."""

    scene: str
    object: str

    @property
    def key(self) -> tuple[str, str]:
        return self.scene, self.object


@dataclass(frozen=True, slots=True, kw_only=True)
class NamedInstance(ObjectKey):
    """A labeled object and its class."""

    name: str


@dataclass(frozen=True, slots=True, kw_only=True)
class RankedNames(ObjectKey):
    """The classes predicted for an object, the likeliest first, each once; none where the method has no answer."""

    names: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class RecognizedInstance(NamedInstance):
    """A labeled object with its place in the ranking.

    Attributes:
        rank: of its class among the predicted names, from 1; 0 if it is not among them.
        answered: whether any name is predicted.
    """

    rank: int
    answered: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class RecognitionScores:
    """The scores of instances; NaN without any.

    Attributes:
        instances: their number.
        unanswered: of them, those that have no prediction; they count as wrong.
        classes: for each k, accuracy by name of the class; NaN for classes without instances.
        mean: for each k, the mean over the classes that have instances.
        overall: for each k, the mean over instances.
        counts: instances by name of the class.
    """

    instances: int
    unanswered: int
    classes: dict[int, dict[str, float]]
    mean: dict[int, float]
    overall: dict[int, float]
    counts: dict[str, int]


@dataclass(frozen=True, slots=True, kw_only=True)
class RecognitionProtocol(Protocol):
    """All named objects with points count."""

    name: Literal["recognition"] = "recognition"

    def start(self, evaluation: Evaluation) -> "RecognitionBenchmark":
        return RecognitionBenchmark(evaluation)


Recognized = tuple[list[NamedInstance], list[RankedNames]]


class RecognitionBenchmark(Benchmark[Recognized]):
    def __init__(self, evaluation: Evaluation) -> None:
        self.evaluation, self.classes = evaluation, predicted_classes(evaluation)

    def predict(self, scene: Scene, features: GaussianFeatures) -> Recognized:
        points = self.classes.points(scene)
        instances = named_instances(points)
        return instances, predict_recognition(
            points, features, instances, self.classes.table.names, self.evaluation.words
        )

    def report(self, results: Sequence[SceneResult[Recognized]]) -> ScoreReport:
        """Writes and scores both lists."""
        ordered = sorted(results, key=lambda result: result.scene)
        labels, predictions = (self.evaluation.file(f"{name}.json") for name in (LABELS, PREDICTIONS))
        write_recognition_labels(labels, [each for result in ordered for each in result.value[0]])
        write_recognition_predictions(predictions, [each for result in ordered for each in result.value[1]])
        write_classes(self.evaluation.file(CLASS_IDS), self.classes.table)
        options = ScoreOptions(method=self.evaluation.method, classes=str(self.evaluation.file(CLASS_IDS)))
        return score(predictions, labels, options)


def named_instances(points: LabeledPoints) -> list[NamedInstance]:
    """The named objects of a scene that have points, by ascending id."""
    return [
        NamedInstance(scene=points.scene, object=str(number), name=name) for number, name in points.named_ids().items()
    ]


def predict_recognition(
    points: LabeledPoints,
    features: GaussianFeatures,
    instances: Sequence[NamedInstance],
    names: Sequence[str],
    text: TextEncoder,
) -> list[RankedNames]:
    """The classes nearest to the mean feature of each object's Gaussians, the nearest first; none for an object of
    which no Gaussian was seen."""
    parts = [points.rows_of(int(each.object)) for each in instances]
    cosines = class_cosines(features, parts, names, text)
    return [
        RankedNames(
            scene=each.scene,
            object=each.object,
            names=()
            if np.isnan(row).any()
            else tuple(names[number] for number in np.argsort(-row, kind="stable")[:RANKED]),
        )
        for each, row in zip(instances, cosines, strict=True)
    ]


def score(predictions: Path, labels: Path, options: ScoreOptions) -> ScoreReport:
    """Accuracy of the classes of given objects."""
    instances = read_recognition_labels(labels)
    names = load_classes(options.classes).names if options.classes else sorted({each.name for each in instances})
    ranked = read_recognition_predictions(predictions)
    with about(predictions):
        recognized, skipped = recognize(ranked, instances, names, allow_missing=options.allow_missing)
    if not recognized:
        raise InputError(f"{labels}: nothing to score: it holds no object of the {len(names)} classes")
    scores = recognition_scores(recognized, names)
    of_scene = defaultdict(list)
    for each in recognized:
        of_scene[each.scene].append(each)
    by_scene = [
        {"scene": scene, "objects": len(each)}
        | {f"top_{k}": value for k, value in recognition_scores(each, names).overall.items()}
        for scene, each in of_scene.items()
    ]
    by_class = [
        {"class": name, "objects": scores.counts[name]} | {f"top_{k}": scores.classes[k][name] for k in KS}
        for name in names
    ]
    return ScoreReport(
        results={
            "protocol": "recognition",
            "objects": scores.instances,
            "unanswered": scores.unanswered,
            "other_classes": skipped,
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
        line=f"{counted(scores.instances, 'object')}, averaged over classes (over objects): "
        + ", ".join(f"top-{k} {scores.mean[k]:.3f} ({scores.overall[k]:.3f})" for k in KS),
    )


def recognize(
    predictions: Sequence[RankedNames],
    instances: Sequence[NamedInstance],
    classes: Sequence[str],
    *,
    allow_missing: bool = False,
) -> tuple[tuple[RecognizedInstance, ...], int]:
    """Looks up every labeled object among the predictions.

    Args:
        predictions: in any order.
        instances: labeled ones, in any order, each once.
        classes: that can be predicted. Instances of other classes are not scored, whether they are predicted or not.
        allow_missing: count instances without a prediction as wrong, instead of refusing them.

    Returns:
        The instances of the classes, in the order of the labels, and the number of instances of other classes.
    """
    keys, names = {item.key for item in instances}, set(classes)
    for item in predictions:
        if item.key not in keys:
            raise InputError(f"{described(item.key)} is predicted, and not in the truth")
        wrong = next((name for name in item.names if name not in names), None)
        if wrong is not None:
            raise InputError(f"{described(item.key)} is predicted as {wrong[:40]!r}, which is no class")
        if first_repeated(item.names):
            raise InputError(f"{described(item.key)} has a name twice; expected each once")
    answers = {item.key: item.names for item in predictions}
    scored = [instance for instance in instances if instance.name in names]
    missing = next((instance for instance in scored if instance.key not in answers), None)
    if missing is not None and not allow_missing:
        raise InputError(f"{described(missing.key)} has no prediction")
    results = []
    for each in scored:
        ranked = answers.get(each.key, ())
        rank = ranked.index(each.name) + 1 if each.name in ranked else 0
        results.append(
            RecognizedInstance(scene=each.scene, object=each.object, name=each.name, rank=rank, answered=bool(ranked))
        )
    return tuple(results), len(instances) - len(results)


def recognition_scores(
    instances: Sequence[RecognizedInstance], classes: Sequence[str], *, ks: Sequence[int] = KS
) -> RecognitionScores:
    """The scores of instances of any scenes, as `recognize` gives them."""
    ranks_of: dict[str, list[int]] = {name: [] for name in classes}
    for item in instances:
        ranks_of[item.name].append(item.rank)
    table = {k: {name: _share(ranks, k) for name, ranks in ranks_of.items()} for k in ks}
    everything = [item.rank for item in instances]
    return RecognitionScores(
        instances=len(instances),
        unanswered=sum(not item.answered for item in instances),
        classes=table,
        mean={k: mean_of(list(row.values())) for k, row in table.items()},
        overall={k: _share(everything, k) for k in ks},
        counts={name: len(ranks) for name, ranks in ranks_of.items()},
    )


def described(key: tuple[str, str]) -> str:
    """An object's name in messages."""
    return f"object {key[1]} of {key[0]}"


def _share(ranks: list[int], k: int) -> float:
    return mean_of([float(1 <= rank <= k) for rank in ranks])


def read_recognition_labels(path: Path) -> tuple[NamedInstance, ...]:
    """Reads the class of each object."""
    instances = tuple(
        NamedInstance(**_key(entry, where), name=name_value(entry.get("label"), where, "label"))
        for entry, where in _entries(path, "scene_id, object_id and label", foreign="labels")
    )
    refuse_repeated(path, [each.key for each in instances], described)
    return instances


def read_recognition_predictions(path: Path) -> tuple[RankedNames, ...]:
    """Reads the names predicted for each object."""
    predictions = tuple(
        RankedNames(**_key(entry, where), names=_names(entry, where))
        for entry, where in _entries(path, "scene_id, object_id and labels", foreign="label")
    )
    refuse_repeated(path, [each.key for each in predictions], described)
    return predictions


def write_recognition_labels(path: Path, instances: Sequence[NamedInstance]) -> None:
    """Writes the class of each object."""
    write_json(path, [{"scene_id": i.scene, "object_id": i.object, "label": i.name} for i in instances])


def write_recognition_predictions(path: Path, predictions: Sequence[RankedNames]) -> None:
    """Writes the names predicted for each object."""
    write_json(path, [{"scene_id": p.scene, "object_id": p.object, "labels": p.names} for p in predictions])


def _key(entry: Mapping[str, Any], where: str) -> dict[str, str]:
    number = object_id(entry.get("object_id"), where)
    return {"scene": scene_name(entry.get("scene_id"), where), "object": str(number)}


def _entries(path: Path, expected: str, *, foreign: str) -> tuple[Entry, ...]:
    entries = entries_of(read_benchmark_json(path), path, expected)
    for entry, where in entries:
        if foreign in entry:
            raise InputError(f"{where}: unexpected key {foreign!r}; predictions and truth may be swapped")
    return entries


def _names(entry: Mapping[str, Any], where: str) -> tuple[str, ...]:
    values = entry.get("labels")
    if values is None and "labels" in entry:
        return ()
    if not isinstance(values, list):
        raise InputError(f"{where}: labels must be a list of names, got {shown(values)}")
    return tuple(name_value(value, where, f"labels[{index}]") for index, value in enumerate(values))
