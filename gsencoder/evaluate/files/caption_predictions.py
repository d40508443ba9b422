"""Predicted captions in the files of Scan2Cap.

Captions of boxes (benchmark/predict.py): {scene: [{caption, box, sem_prob, obj_prob}]}, where a box is eight corners,
and the probabilities may be absent. Captions of given objects (lib/eval_helper.py): {"scene|object_id|object_name":
[caption]}, the name being optional.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gsencoder.core.errors import InputError
from gsencoder.core.files import write_json
from gsencoder.data.labels.captions import wrapped_caption
from gsencoder.data.labels.files import (
    Entry,
    box_corners,
    corner_bounds,
    entries_of,
    number,
    object_id,
    read_benchmark_json,
    scene_name,
    shown,
    text_list,
    text_value,
)
from gsencoder.evaluate.scores.dense_captions import CaptionedBox, CaptionedObject, NamedCaption

EXPECTED = (
    "an object from scenes to lists of {caption, box}, or from scene|object_id|object_name to lists of one caption"
)


def read_caption_predictions(
    path: str | Path, objects: Sequence[CaptionedObject]
) -> tuple[CaptionedBox, ...] | tuple[NamedCaption, ...]:
    """Reads predicted captions of boxes or of given objects, by what is in the file.

    Args:
        path: the file.
        objects: of the truth.

    Raises:
        InputError: not such a file, truth in its place, captions of other scenes or objects, two captions of one
            object, or something else than texts and finite numbers.
    """
    file = Path(path)
    content = read_benchmark_json(file)
    if not isinstance(content, dict):
        truth = isinstance(content, list) and bool(content) and isinstance(content[0], dict) and "ann_id" in content[0]
        hint = "; this is truth: were predictions and truth swapped?" if truth else ""
        raise InputError(f"{file}: expected {EXPECTED}, got {shown(content)}{hint}")
    if any("|" in key for key in content):
        return _named(content, file, objects)
    scenes = {each.scene for each in objects}
    boxes = []
    for key, rows in content.items():
        where = f"{file}: {shown(key)}"
        if scene_name(key, where) not in scenes:
            raise InputError(f"{where}: is no scene of the truth")
        boxes += [_box(row, key) for row in entries_of(rows, file, "caption and box", key=key)]
    return tuple(boxes)


def write_box_captions(path: str | Path, boxes: Sequence[CaptionedBox]) -> None:
    """Writes captions of boxes as Scan2Cap's benchmark takes them, wrapped in sos and eos.

    Raises:
        InputError: the file cannot be written.
    """
    scenes: dict[str, list[dict[str, Any]]] = {}
    for each in boxes:
        scenes.setdefault(each.scene, []).append(
            {
                "caption": wrapped_caption(each.caption),
                "box": box_corners(*each.aabb),
                "sem_prob": list(each.class_probabilities),
                "obj_prob": [1 - each.objectness, each.objectness],
            }
        )
    write_json(path, scenes)


def write_named_captions(
    path: str | Path, objects: Sequence[CaptionedObject], captions: Sequence[NamedCaption]
) -> None:
    """Writes captions of given objects as Scan2Cap's evaluation writes them, wrapped in sos and eos.

    Raises:
        InputError: captions of other objects, two of one, or the file cannot be written.
    """
    names = {(each.scene, each.object_id): each.object_name for each in objects}
    captions_of: dict[str, list[str]] = {}
    for each in captions:
        if (each.scene, each.object_id) not in names:
            raise InputError(f"{path}: object {each.object_id} of {each.scene} is captioned and is not in the truth")
        key = f"{each.scene}|{each.object_id}|{names[each.scene, each.object_id]}"
        if key in captions_of:
            raise InputError(f"{path}: {key[:80]} has two captions; expected one")
        captions_of[key] = [wrapped_caption(each.caption)]
    write_json(path, captions_of)


def _box(row: Entry, scene: str) -> CaptionedBox:
    entry, where = row
    return CaptionedBox(
        scene=scene,
        caption=text_value(entry.get("caption"), where, "caption", empty=True),
        aabb=corner_bounds(entry.get("box"), where, "box"),
        objectness=(_probabilities(entry, "obj_prob", where) or (1.0,))[-1],
        class_probabilities=_probabilities(entry, "sem_prob", where),
    )


def _probabilities(entry: Mapping[str, Any], key: str, where: str) -> tuple[float, ...]:
    values = entry.get(key, [])
    if not isinstance(values, list):
        raise InputError(f"{where}: {key} must be a list of numbers, got {shown(values)}")
    return tuple(number(value, where, f"{key}[{index}]") for index, value in enumerate(values))


def _named(content: Mapping[str, Any], path: Path, objects: Sequence[CaptionedObject]) -> tuple[NamedCaption, ...]:
    names = {(each.scene, each.object_id): each.object_name for each in objects}
    scenes = {scene for scene, _ in names}
    key_of: dict[tuple[str, int], str] = {}
    captions = []
    for key, value in content.items():
        where = f"{path}: {shown(key)}"
        scene, _, rest = key.partition("|")
        number_text, _, name = rest.partition("|")
        identity = scene_name(scene, where), object_id(number_text, where)
        if identity not in names:
            raise InputError(f"{where}: is no {'object' if scene in scenes else 'scene'} of the truth")
        if name and name != names[identity]:
            raise InputError(f"{where}: the truth calls this object {shown(names[identity])}")
        if identity in key_of:
            raise InputError(f"{where}: is the same object as {shown(key_of[identity])}")
        sentences = text_list(value, where, "caption", empty=True)
        if len(sentences) != 1:
            raise InputError(f"{where}: has {len(sentences)} captions, expected one")
        key_of[identity] = key
        captions.append(NamedCaption(scene=scene, object_id=identity[1], caption=sentences[0]))
    return tuple(captions)
