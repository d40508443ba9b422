"""Scan2Cap's m@kIoU: sentence scores of captions that count only where their box overlaps the object (Chen 2021).

Every object with captions is one sample. Its hypothesis is the caption of the predicted box that overlaps it most, of
equal ones the first, if their IoU is above k; else it is the empty caption "sos eos". References are all captions of
the object. Captions are wrapped in sos and eos, as lib/eval_helper.py does, and cut at blanks, without a tokenizer: sos
and eos count as words, and an object without a caption scores above 0 in BLEU-1 and ROUGE-L. Scores are of the corpus.

The script takes for each box the object that its detector was trained to assign, by the nearest center, which a file
of boxes does not have. The benchmark (benchmark/eval.py) assigns by generalized IoU, one box to one object, and takes
an IoU of k, too; where each object has one box of its own near it, all three agree.

Labels are ScanRefer's file of expressions, with boxes where captions are of boxes. Predictions are Scan2Cap's captions
of boxes (benchmark/predict.py), {scene: [{caption, box, sem_prob, obj_prob}]}, where a box is eight corners and the
probabilities decide nothing; or its captions of given objects (lib/eval_helper.py), {"scene|object_id|object_name":
[caption]}, the name being optional. `ask task=caption` writes them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from gsencoder.core.errors import InputError, counted
from gsencoder.data.labels.expressions import Expression, read_scanrefer, wrapped_caption
from gsencoder.data.labels.files import (
    Corner,
    Entry,
    box_ious,
    corner_bounds,
    entries_of,
    object_id,
    read_benchmark_json,
    scene_name,
    shown,
    text_list,
    text_value,
)
from gsencoder.evaluate.benchmarks.files import ScoreOptions, refuse_missing
from gsencoder.evaluate.benchmarks.text_metrics import JavaTools, SentenceScores, score_sentences, sentence_figures
from gsencoder.evaluate.tables import ScoreReport, spread, table_of

OPTIONS = ("min_iou", "java", "allow_missing")
MAX_TOKENS = 30
"""Tokens of a reference that Scan2Cap keeps (lib/config.py, MAX_DES_LEN)."""
EMPTY = "sos eos"
EXPECTED = (
    "an object from scenes to lists of {caption, box}, or from scene|object_id|object_name to lists of one caption"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class CaptionedObject:
    """A labeled object and what was written of it.

    Attributes:
        object_id: `objectId` of ScanNet's aggregation file, from 0.
        captions: wrapped in sos and eos, tokens with blanks between them.
        aabb: lower and upper corner; None where the labels have no boxes.
    """

    scene: str
    object_id: int
    object_name: str
    captions: tuple[str, ...]
    aabb: tuple[Corner, Corner] | None = None

    @property
    def key(self) -> tuple[str, int]:
        return self.scene, self.object_id


@dataclass(frozen=True, slots=True, kw_only=True)
class CaptionedBox:
    """A predicted box and its caption, with or without sos and eos."""

    scene: str
    caption: str
    aabb: tuple[Corner, Corner]


@dataclass(frozen=True, slots=True, kw_only=True)
class NamedCaption:
    """A predicted caption of a labeled object, where proposals are given and no boxes are predicted."""

    scene: str
    object_id: int
    caption: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DenseCaptionScores:
    """Scores of captions; one sample an object, in their order.

    Attributes:
        missing: objects whose caption counts as empty: no box overlaps them enough, or none is predicted for their id.
        ious: of each object and its best box, 0 without one; None where captions belong to objects by their ids.
        sentences: scores of the corpus and of each object.
    """

    missing: int
    ious: Float64[np.ndarray, "N"] | None
    sentences: SentenceScores


def score(predictions: Path, labels: Path, options: ScoreOptions) -> ScoreReport:
    """Scores of captions of boxes or of given objects."""
    objects = captioned_objects(read_scanrefer(labels))
    if not objects:
        raise InputError(f"{labels}: nothing to score: it holds no descriptions")
    captions = read_caption_predictions(predictions, objects)
    tools = None if options.java else "Java was not asked for (java=false)"
    boxes = [each for each in captions if isinstance(each, CaptionedBox)]
    if boxes:
        silent = sorted({each.scene for each in objects} - {each.scene for each in boxes})
        refuse_missing(silent, "scene", predictions, options)
        scores = score_box_captions(objects, boxes, min_iou=options.min_iou, tools=tools)
    else:
        named = [each for each in captions if isinstance(each, NamedCaption)]
        keys = {(each.scene, each.object_id) for each in named}
        missing = [f"{each.object_id} of {each.scene}" for each in objects if each.key not in keys]
        refuse_missing(missing, "object", predictions, options)
        scores = score_named_captions(objects, named, tools=tools)
    sentences = scores.sentences
    ending = f"_{round(100 * options.min_iou)}" if boxes else ""
    overall = {f"{name}{ending}": value for name, value in sentence_figures(sentences).items()}
    rows = [
        {
            "scene": each.scene,
            "object": each.object_id,
            "name": each.object_name,
            "iou": None if scores.ious is None else float(scores.ious[row]),
            "cider": float(sentences.cider_each[row]),
            "rouge_l": float(sentences.rouge_l_each[row]),
            "bleu_4": float(sentences.bleu_each[row, 3]),
        }
        for row, each in enumerate(objects)
    ]
    by_scene = [
        {"scene": scene, "objects": len(of_scene)}
        | {name: float(np.mean([row[name] for row in of_scene])) for name in ("cider", "rouge_l", "bleu_4")}
        for scene in dict.fromkeys(row["scene"] for row in rows)
        for of_scene in ([row for row in rows if row["scene"] == scene],)
    ]
    return ScoreReport(
        results={
            "protocol": "captions",
            "objects": len(objects),
            "predictions": len(captions),
            "missing": scores.missing,
            "min_iou": options.min_iou if boxes else None,
            "tokens": sentences.tokens,
            "absent": dict(sentences.absent),
            **overall,
            "spread": spread(by_scene, ["cider", "rouge_l", "bleu_4"]),
        },
        table=table_of(
            f"Captions at an IoU of {options.min_iou:g}" if boxes else "Captions of given objects",
            {options.method: overall},
            published="splatdistill_4_captions" if ending == "_50" else "",
            notes=[f"{column} is absent: {reason}." for column, reason in sentences.absent.items()],
        ),
        rows={"objects": rows, "scenes": by_scene},
        line=f"{counted(len(objects), 'object')}, {scores.missing} without a caption that counts: CIDEr "
        f"{100 * sentences.cider:.1f}, BLEU-4 {100 * sentences.bleu[3]:.1f}, ROUGE-L {100 * sentences.rouge_l:.1f}",
    )


def captioned_objects(expressions: Sequence[Expression]) -> tuple[CaptionedObject, ...]:
    """The objects of expressions with all their captions, each cut to `MAX_TOKENS`, in the order of the first ones."""
    objects: dict[tuple[str, int], list[Expression]] = {}
    for each in expressions:
        objects.setdefault((each.scene, each.object_id), []).append(each)
    return tuple(
        CaptionedObject(
            scene=scene,
            object_id=number,
            object_name=group[0].object_name,
            captions=tuple(f"sos {' '.join(each.tokens[:MAX_TOKENS])} eos" for each in group),
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
        objects: with boxes, each once.
        boxes: of the same scenes, any number a scene, in any order.
        min_iou: k.
        tools: see `score_sentences`.
    """
    bare = next((each for each in objects if each.aabb is None), None)
    if bare is not None:
        raise InputError(f"object {bare.object_id} of {bare.scene} has no box; captions of boxes need true boxes")
    ious, best = _best_boxes(objects, boxes)
    captions = [boxes[row].caption if iou > min_iou else None for row, iou in zip(best, ious, strict=True)]
    return _scores(objects, captions, ious, tools)


def score_named_captions(
    objects: Sequence[CaptionedObject], captions: Sequence[NamedCaption], *, tools: JavaTools | str | None = None
) -> DenseCaptionScores:
    """The same scores where every caption says which object it is about, at most one an object, and none is dropped for
    its box."""
    caption_of = {(each.scene, each.object_id): each.caption for each in captions}
    return _scores(objects, [caption_of.get(each.key) for each in objects], None, tools)


def _scores(
    objects: Sequence[CaptionedObject],
    captions: Sequence[str | None],
    ious: np.ndarray | None,
    tools: JavaTools | str | None,
) -> DenseCaptionScores:
    spoken = [EMPTY if caption is None else wrapped_caption(caption) for caption in captions]
    return DenseCaptionScores(
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


def read_caption_predictions(
    path: Path, objects: Sequence[CaptionedObject]
) -> tuple[CaptionedBox, ...] | tuple[NamedCaption, ...]:
    """Reads predicted captions of boxes or of given objects, by what is in the file, for labeled objects."""
    content = read_benchmark_json(path)
    if not isinstance(content, dict):
        swapped = isinstance(content, list) and content and isinstance(content[0], dict) and "ann_id" in content[0]
        hint = "; this is truth: were predictions and truth swapped?" if swapped else ""
        raise InputError(f"{path}: expected {EXPECTED}, got {shown(content)}{hint}")
    if any("|" in key for key in content):
        return _named(content, path, objects)
    scenes = {each.scene for each in objects}
    boxes = []
    for key, rows in content.items():
        where = f"{path}: {shown(key)}"
        if scene_name(key, where) not in scenes:
            raise InputError(f"{where}: is no scene of the truth")
        boxes += [_box(row, key) for row in entries_of(rows, path, "caption and box", key=key)]
    return tuple(boxes)


def _box(row: Entry, scene: str) -> CaptionedBox:
    entry, where = row
    caption = text_value(entry.get("caption"), where, "caption", empty=True)
    return CaptionedBox(scene=scene, caption=caption, aabb=corner_bounds(entry.get("box"), where, "box"))


def _named(content: Mapping[str, Any], path: Path, objects: Sequence[CaptionedObject]) -> tuple[NamedCaption, ...]:
    names = {each.key: each.object_name for each in objects}
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
