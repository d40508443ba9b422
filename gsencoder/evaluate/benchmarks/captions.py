"""Scan2Cap's m@kIoU: sentence scores of captions that count only where their box overlaps the object (Chen 2021).

Every object with captions is one sample. Its hypothesis is the caption of the predicted box that overlaps it most, of
equal ones the first, if their IoU is above k; else it is the empty caption "sos eos". References are all captions of
the object. Captions are wrapped in sos and eos, as lib/eval_helper.py does, and cut at blanks, without a tokenizer: sos
and eos count as words, and an object without a caption scores above 0 in BLEU-1 and ROUGE-L. Scores are of the corpus.

The script takes for each box the object that its detector was trained to assign, by the nearest center, which a file
of boxes does not have. The benchmark (benchmark/eval.py) assigns by generalized IoU, one box to one object, and takes
an IoU of k, too; where each object has one box of its own near it, all three agree.

Predicted captions in the files of Scan2Cap.

Captions of boxes (benchmark/predict.py): {scene: [{caption, box, sem_prob, obj_prob}]}, where a box is eight corners,
and the probabilities may be absent. Captions of given objects (lib/eval_helper.py): {"scene|object_id|object_name":
[caption]}, the name being optional.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from gsencoder.core.arrays import first_repeated
from gsencoder.core.errors import InputError
from gsencoder.core.files import write_json
from gsencoder.data.labels.captions import wrapped_caption
from gsencoder.data.labels.expressions import Expression
from gsencoder.data.labels.files import (
    Corner,
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
from gsencoder.evaluate.benchmarks.referring import box_ious
from gsencoder.evaluate.benchmarks.text_metrics import JavaTools, SentenceScores, score_sentences

MAX_TOKENS = 30
"""Tokens of a reference that Scan2Cap keeps (lib/config.py, MAX_DES_LEN)."""
EMPTY = "sos eos"


@dataclass(frozen=True, slots=True, kw_only=True)
class CaptionedObject:
    """A true object and what was written of it.

    Attributes:
        object_id: `objectId` of ScanNet's aggregation file, from 0.
        object_name: as the file writes it.
        captions: wrapped in sos and eos, tokens with blanks between them.
        aabb: lower and upper corner; None where the truth has no boxes.
    """

    scene: str
    object_id: int
    object_name: str
    captions: tuple[str, ...]
    aabb: tuple[Corner, Corner] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class CaptionedBox:
    """A predicted box and its caption.

    Attributes:
        caption: with or without sos and eos.
        objectness: probability that there is an object; it decides nothing here, and is kept in files.
        class_probabilities: of the detector; the same.
    """

    scene: str
    caption: str
    aabb: tuple[Corner, Corner]
    objectness: float = 1.0
    class_probabilities: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class NamedCaption:
    """A predicted caption of a true object, where proposals are given and no boxes are predicted.

    Attributes:
        caption: with or without sos and eos.
    """

    scene: str
    object_id: int
    caption: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DenseCaptionScores:
    """Scores of captions; one sample an object.

    Attributes:
        min_iou: k, which the IoU must be above; None where captions belong to objects by their ids.
        missing: objects whose caption counts as empty: no box overlaps them enough, or none is predicted for their id.
        ious: of each object and its best box, 0 without one; None where captions belong to objects by their ids.
        sentences: scores of the corpus and of each object, in this order.
    """

    min_iou: float | None
    objects: tuple[CaptionedObject, ...]
    predictions: int
    missing: int
    ious: Float64[np.ndarray, "N"] | None
    sentences: SentenceScores

    def columns(self) -> dict[str, float | None]:
        """Head and value of each column, such as CIDEr@0.5IoU; None where it is absent."""
        suffix = "" if self.min_iou is None else f"@{self.min_iou:g}IoU"
        return {f"{name}{suffix}": value for name, value in self.sentences.columns().items()}


def captioned_objects(
    expressions: Sequence[Expression], *, max_tokens: int | None = MAX_TOKENS
) -> tuple[CaptionedObject, ...]:
    """The objects of ScanRefer's or Nr3D's expressions with all their captions, in the order of the first ones.

    Args:
        max_tokens: tokens of a caption that are kept, as Scan2Cap's lib/eval_helper.py does; None = all, as its
            benchmark does.
    """
    objects: dict[tuple[str, int], list[Expression]] = {}
    for each in expressions:
        objects.setdefault((each.scene, each.object_id), []).append(each)
    return tuple(
        CaptionedObject(
            scene=scene,
            object_id=number,
            object_name=group[0].object_name,
            captions=tuple(f"sos {' '.join(each.tokens[:max_tokens])} eos" for each in group),
            aabb=group[0].aabb,
        )
        for (scene, number), group in objects.items()
    )


def score_box_captions(
    objects: Sequence[CaptionedObject],
    boxes: Sequence[CaptionedBox],
    *,
    min_iou: float = 0.5,
    tools: JavaTools | str | None = None,
) -> DenseCaptionScores:
    """m@kIoU of predicted boxes with captions.

    Args:
        boxes: of the same scenes, any number a scene, in any order.
    """
    if not 0 <= min_iou <= 1:
        raise InputError(f"the smallest IoU must lie in [0, 1], got {min_iou}")
    _check(objects, {each.scene for each in boxes})
    bare = next((each for each in objects if each.aabb is None), None)
    if bare is not None:
        raise InputError(f"object {bare.object_id} of {bare.scene} has no box; captions of boxes need true boxes")
    ious, best = _best_boxes(objects, boxes)
    captions = [boxes[row].caption if iou > min_iou else None for row, iou in zip(best, ious, strict=True)]
    return _scores(objects, captions, len(boxes), min_iou, ious, tools)


def score_named_captions(
    objects: Sequence[CaptionedObject],
    captions: Sequence[NamedCaption],
    *,
    tools: JavaTools | str | None = None,
) -> DenseCaptionScores:
    """The same scores where every caption says which object it is about, and none is dropped for its box.

    Args:
        captions: at most one an object.
    """
    _check(objects, {each.scene for each in captions})
    caption_of: dict[tuple[str, int], str] = {}
    keys = {(each.scene, each.object_id) for each in objects}
    for each in captions:
        key = each.scene, each.object_id
        if key in caption_of or key not in keys:
            wrong = "has two captions" if key in caption_of else "is no object of the truth"
            raise InputError(f"object {each.object_id} of {each.scene} {wrong}")
        caption_of[key] = each.caption
    spoken = [caption_of.get((each.scene, each.object_id)) for each in objects]
    return _scores(objects, spoken, len(captions), None, None, tools)


def _scores(
    objects: Sequence[CaptionedObject],
    captions: Sequence[str | None],
    predictions: int,
    min_iou: float | None,
    ious: np.ndarray | None,
    tools: JavaTools | str | None,
) -> DenseCaptionScores:
    spoken = [EMPTY if caption is None else wrapped_caption(caption) for caption in captions]
    return DenseCaptionScores(
        min_iou=min_iou,
        objects=tuple(objects),
        predictions=predictions,
        missing=sum(caption is None for caption in captions),
        ious=ious,
        sentences=score_sentences(spoken, [each.captions for each in objects], tokens="given", tools=tools),
    )


def _best_boxes(objects: Sequence[CaptionedObject], boxes: Sequence[CaptionedBox]) -> tuple[np.ndarray, np.ndarray]:
    """For each object the IoU with its best box, and the row of that box; 0 and −1 in scenes without boxes."""
    ious, best = np.zeros(len(objects)), np.full(len(objects), -1)
    rows: dict[str, list[int]] = {}
    for row, box in enumerate(boxes):
        rows.setdefault(box.scene, []).append(row)
    corners = np.array([box.aabb for box in boxes], np.float64).reshape(len(boxes), 2, 3)
    for index, each in enumerate(objects):
        if each.scene in rows:
            there = np.array(rows[each.scene])
            values = box_ious(corners[there], np.array(each.aabb, np.float64))
            best[index], ious[index] = there[values.argmax()], values.max()
    return ious, best


def _check(objects: Sequence[CaptionedObject], scenes: set[str]) -> None:
    if repeated := first_repeated((each.scene, each.object_id) for each in objects):
        scene, number = repeated[0]
        raise InputError(f"object {number} of {scene} is there twice; expected each once")
    other = min(scenes - {each.scene for each in objects}, default=None)
    if other is not None:
        raise InputError(f"captions are predicted for {other}, which is no scene of the truth")


EXPECTED = (
    "an object from scenes to lists of {caption, box}, or from scene|object_id|object_name to lists of one caption"
)


def read_caption_predictions(
    path: str | Path, objects: Sequence[CaptionedObject]
) -> tuple[CaptionedBox, ...] | tuple[NamedCaption, ...]:
    """Reads predicted captions of boxes or of given objects, by what is in the file."""
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
    """Writes captions of boxes as Scan2Cap's benchmark takes them, wrapped in sos and eos."""
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
    """Writes captions of given objects as Scan2Cap's evaluation writes them, wrapped in sos and eos."""
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
