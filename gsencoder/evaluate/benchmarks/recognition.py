"""Recognition of given objects: the instances are known, and each is to be named with one of the classes.

Top-1 accuracy of a class is the share of its instances whose first name is right, and top-k that of those whose first k
names have the right one. The paper's table 1, after CLIP² (Zeng et al. 2023), prints top-1 of each of ScanNet's classes
and their unweighted mean; there are 17 of them, without "otherfurniture". The mean over instances, in which frequent
classes count more, stands beside it.

Files of object recognition. There is no official format; these are lists of JSON objects.

Truth:      {"scene_id": "scene0011_00", "object_id": 3, "label": "chair"}
Prediction: {"scene_id": "scene0011_00", "object_id": 3, "labels": ["chair", "sofa"]}, the likeliest first; [] for no
answer.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from gsencoder.core.arrays import first_repeated
from gsencoder.core.errors import InputError, about
from gsencoder.core.files import write_json
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
from gsencoder.evaluate.sources import LabeledPoints, class_cosines
from gsencoder.evaluate.tables import mean_of
from gsencoder.text.table import TextEncoder
from gsencoder.types import GaussianFeatures


@dataclass(frozen=True, slots=True, kw_only=True)
class NamedInstance:
    """An instance of the truth."""

    scene: str
    object: str
    name: str

    @property
    def key(self) -> tuple[str, str]:
        return self.scene, self.object


@dataclass(frozen=True, slots=True, kw_only=True)
class RankedNames:
    """What an instance is predicted to be.

    Attributes:
        names: of classes, the likeliest first, each once; none where the method has no answer.
    """

    scene: str
    object: str
    names: tuple[str, ...]

    @property
    def key(self) -> tuple[str, str]:
        return self.scene, self.object


@dataclass(frozen=True, slots=True, kw_only=True)
class RecognizedInstance:
    """An instance with its place in the ranking.

    Attributes:
        rank: of this class among the predicted names, from 1; 0 if it is not among them.
        first: the name predicted first; None without an answer.
    """

    scene: str
    object: str
    name: str
    rank: int
    first: str | None

    @property
    def key(self) -> tuple[str, str]:
        return self.scene, self.object


@dataclass(frozen=True, slots=True, kw_only=True)
class RecognitionScores:
    """The scores of instances; NaN without any.

    Attributes:
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


def recognize(
    predictions: Sequence[RankedNames],
    truth: Sequence[NamedInstance],
    classes: Sequence[str],
    *,
    allow_missing: bool = False,
) -> tuple[tuple[RecognizedInstance, ...], int]:
    """Looks up every instance of the truth among the predictions.

    Args:
        classes: that can be predicted. Instances of other classes are not scored, whether they are predicted or not.
        allow_missing: count instances without a prediction as wrong, instead of refusing them.

    Returns:
        The instances of the classes, in the order of the truth, and the number of instances of other classes.
    """
    _refuse_repeated([item.key for item in truth], "truth")
    _refuse_repeated([item.key for item in predictions], "predictions")
    keys, names = {item.key for item in truth}, set(classes)
    for item in predictions:
        if item.key not in keys:
            raise InputError(f"{described(item.key)} is predicted, and not in the truth")
        wrong = next((name for name in item.names if name not in names), None)
        if wrong is not None:
            raise InputError(f"{described(item.key)} is predicted as {wrong[:40]!r}, which is no class")
        if first_repeated(item.names):
            raise InputError(f"{described(item.key)} has a name twice; expected each once")
    answers = {item.key: item.names for item in predictions}
    scored = [instance for instance in truth if instance.name in names]
    missing = next((instance for instance in scored if instance.key not in answers), None)
    if missing is not None and not allow_missing:
        raise InputError(f"{described(missing.key)} has no prediction")
    results = []
    for instance in scored:
        ranked = answers.get(instance.key, ())
        results.append(
            RecognizedInstance(
                scene=instance.scene,
                object=instance.object,
                name=instance.name,
                rank=ranked.index(instance.name) + 1 if instance.name in ranked else 0,
                first=ranked[0] if ranked else None,
            )
        )
    return tuple(results), len(truth) - len(results)


def recognition_scores(
    instances: Sequence[RecognizedInstance], classes: Sequence[str], *, ks: Sequence[int] = (1, 5)
) -> RecognitionScores:
    """The scores of instances of any scenes.

    Args:
        classes: all of them, in the order of the table.
        ks: numbers of names of which one has to be right.
    """
    _refuse_repeated([item.key for item in instances], "instances")
    if min(ks, default=1) < 1:
        raise InputError(f"recognition: expected k of 1 or more, got {min(ks)}")
    ranks_of: dict[str, list[int]] = {name: [] for name in classes}
    for item in instances:
        if item.name not in ranks_of:
            raise InputError(f"{described(item.key)} is {item.name[:40]!r}, which is no class")
        ranks_of[item.name].append(item.rank)
    table = {k: {name: _share(ranks, k) for name, ranks in ranks_of.items()} for k in ks}
    everything = [item.rank for item in instances]
    return RecognitionScores(
        instances=len(instances),
        unanswered=sum(item.first is None for item in instances),
        classes=table,
        mean={k: mean_of(list(row.values())) for k, row in table.items()},
        overall={k: _share(everything, k) for k in ks},
        counts={name: len(ranks) for name, ranks in ranks_of.items()},
    )


def described(key: tuple[str, str]) -> str:
    """An instance's name in messages."""
    return f"object {key[1]} of {key[0]}"


def _share(ranks: list[int], k: int) -> float:
    return mean_of([float(1 <= rank <= k) for rank in ranks])


def _refuse_repeated(keys: Sequence[tuple[str, str]], where: str) -> None:
    if repeated := first_repeated(keys):
        raise InputError(f"{described(repeated[0])} is twice among the {where}; expected each once")


def recognize_files(
    predictions: Path, truth: Path, classes: Sequence[str], *, allow_missing: bool = False
) -> tuple[tuple[RecognizedInstance, ...], int]:
    """Reads predictions and truth, and looks up every instance, as `recognize` does."""
    instances, names = read_recognition_truth(truth), read_recognition_predictions(predictions)
    with about(predictions):
        return recognize(names, instances, classes, allow_missing=allow_missing)


def read_recognition_truth(path: Path) -> tuple[NamedInstance, ...]:
    """Reads the class of each instance."""
    instances = tuple(
        NamedInstance(
            scene=scene_name(entry.get("scene_id"), where),
            object=str(object_id(entry.get("object_id"), where)),
            name=name_value(entry.get("label"), where, "label"),
        )
        for entry, where in _entries(path, "scene_id, object_id and label", foreign="labels")
    )
    refuse_repeated(path, [each.key for each in instances], described)
    return instances


def read_recognition_predictions(path: Path) -> tuple[RankedNames, ...]:
    """Reads the names predicted for each instance."""
    predictions = tuple(
        RankedNames(
            scene=scene_name(entry.get("scene_id"), where),
            object=str(object_id(entry.get("object_id"), where)),
            names=_names(entry, where),
        )
        for entry, where in _entries(path, "scene_id, object_id and labels", foreign="label")
    )
    refuse_repeated(path, [each.key for each in predictions], described)
    return predictions


def write_recognition_truth(path: Path, instances: Sequence[NamedInstance]) -> None:
    """Writes the class of each instance."""
    write_json(path, [{"scene_id": i.scene, "object_id": i.object, "label": i.name} for i in instances])


def write_recognition_predictions(path: Path, predictions: Sequence[RankedNames]) -> None:
    """Writes the names predicted for each instance."""
    write_json(path, [{"scene_id": p.scene, "object_id": p.object, "labels": p.names} for p in predictions])


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


RANKED = 10
"""Names that are predicted for each object."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RecognitionProtocol:
    """Which objects count."""

    name: Literal["recognition"] = "recognition"
    min_points: int = field(default=1, metadata={"help": "smallest number of points of an object that counts"})

    def __post_init__(self) -> None:
        if self.min_points < 1:
            raise InputError(f"min_points: expected 1 or more, got {self.min_points}")


def recognition_truth(points: LabeledPoints, protocol: RecognitionProtocol) -> list[NamedInstance]:
    """The named objects of a scene with enough points, by ascending id."""
    counts = np.bincount(points.objects)
    return [
        NamedInstance(scene=points.scene, object=str(number), name=name)
        for number, name in points.named_ids().items()
        if counts[number] >= protocol.min_points
    ]


def predict_recognition(
    points: LabeledPoints,
    features: GaussianFeatures,
    truth: Sequence[NamedInstance],
    names: Sequence[str],
    text: TextEncoder,
) -> list[RankedNames]:
    """The classes nearest to the mean feature of each object's Gaussians, the nearest first.

    An object of which no Gaussian was seen has no names.
    """
    parts = [points.rows_of(int(each.object)) for each in truth]
    cosines = class_cosines(features, parts, names, text)
    return [
        RankedNames(
            scene=each.scene,
            object=each.object,
            names=()
            if np.isnan(row).any()
            else tuple(names[number] for number in np.argsort(-row, kind="stable")[:RANKED]),
        )
        for each, row in zip(truth, cosines, strict=True)
    ]
