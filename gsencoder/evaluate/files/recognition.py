"""Files of object recognition. There is no official format; these are lists of JSON objects.

Truth:      {"scene_id": "scene0011_00", "object_id": 3, "label": "chair"}
Prediction: {"scene_id": "scene0011_00", "object_id": 3, "labels": ["chair", "sofa"]}, the likeliest first; [] for no
answer.
"""

from collections.abc import Sequence
from pathlib import Path

from gsencoder.core.errors import about
from gsencoder.core.files.json_values import write_json
from gsencoder.evaluate.files.json_entries import Entry, read_entries
from gsencoder.evaluate.scores.recognition import NamedInstance, RankedNames, RecognizedInstance, recognize


def recognize_files(
    predictions: Path, truth: Path, classes: Sequence[str], *, allow_missing: bool = False
) -> tuple[tuple[RecognizedInstance, ...], int]:
    """Reads predictions and truth, and looks up every instance, as `recognize` does.

    Raises:
        InputError: a file that cannot be used, or what `recognize` refuses.
    """
    true, found = read_recognition_truth(truth), read_recognition_predictions(predictions)
    with about(predictions):
        return recognize(found, true, classes, allow_missing=allow_missing)


def read_recognition_truth(path: Path) -> tuple[NamedInstance, ...]:
    """Reads the class of each instance.

    Raises:
        InputError: not such a file, or an instance that is there twice.
    """
    entries = read_entries(path)
    _refuse_swapped(entries, "labels")
    instances = [
        NamedInstance(scene=entry.word("scene_id"), object=entry.number_word("object_id"), name=entry.word("label"))
        for entry in entries
    ]
    _refuse_twice(entries, [(item.scene, item.object) for item in instances])
    return tuple(instances)


def read_recognition_predictions(path: Path) -> tuple[RankedNames, ...]:
    """Reads the names predicted for each instance.

    Raises:
        InputError: not such a file, or an instance that is there twice.
    """
    entries = read_entries(path)
    _refuse_swapped(entries, "label")
    names = [
        RankedNames(scene=entry.word("scene_id"), object=entry.number_word("object_id"), names=entry.words("labels"))
        for entry in entries
    ]
    _refuse_twice(entries, [(item.scene, item.object) for item in names])
    return tuple(names)


def write_recognition_truth(path: Path, instances: Sequence[NamedInstance]) -> None:
    """Writes the class of each instance."""
    write_json(path, [{"scene_id": i.scene, "object_id": i.object, "label": i.name} for i in instances])


def write_recognition_predictions(path: Path, predictions: Sequence[RankedNames]) -> None:
    """Writes the names predicted for each instance."""
    write_json(path, [{"scene_id": p.scene, "object_id": p.object, "labels": p.names} for p in predictions])


def _refuse_swapped(entries: Sequence[Entry], foreign: str) -> None:
    for entry in entries:
        if foreign in entry:
            raise entry.error(f"unexpected key {foreign!r}; predictions and truth may be swapped")


def _refuse_twice(entries: Sequence[Entry], keys: Sequence[tuple[str, str]]) -> None:
    seen: set[tuple[str, str]] = set()
    for entry, key in zip(entries, keys, strict=True):
        if key in seen:
            raise entry.error(f"object {key[1]} of {key[0]} is there already; expected each once")
        seen.add(key)
