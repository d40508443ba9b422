"""Files of object recognition. There is no official format; these are lists of JSON objects.

Truth:      {"scene_id": "scene0011_00", "object_id": 3, "label": "chair"}
Prediction: {"scene_id": "scene0011_00", "object_id": 3, "labels": ["chair", "sofa"]}, the likeliest first; [] for no
answer.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

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
from gsencoder.evaluate.scores.recognition import (
    NamedInstance,
    RankedNames,
    RecognizedInstance,
    described,
    recognize,
)


def recognize_files(
    predictions: Path, truth: Path, classes: Sequence[str], *, allow_missing: bool = False
) -> tuple[tuple[RecognizedInstance, ...], int]:
    """Reads predictions and truth, and looks up every instance, as `recognize` does.

    Raises:
        InputError: a file that cannot be used, or what `recognize` refuses.
    """
    instances, names = read_recognition_truth(truth), read_recognition_predictions(predictions)
    with about(predictions):
        return recognize(names, instances, classes, allow_missing=allow_missing)


def read_recognition_truth(path: Path) -> tuple[NamedInstance, ...]:
    """Reads the class of each instance.

    Raises:
        InputError: not such a file, or an instance that is there twice.
    """
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
    """Reads the names predicted for each instance.

    Raises:
        InputError: not such a file, or an instance that is there twice.
    """
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
