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
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from gsencoder.core.errors import InputError, counted
from gsencoder.data.labels.expressions import Expression, read_scanrefer, wrapped_caption
from gsencoder.data.labels.files import (
    Corner,
    box_ious,
    brief,
    corner_bounds,
    entries_of,
    object_id,
    read_benchmark_json,
    scene_name,
    text_list,
    text_value,
)
from gsencoder.evaluate.benchmarks.files import ScoreOptions, refuse_missing
from gsencoder.evaluate.benchmarks.text_metrics import JavaTools, SentenceScores, score_sentences, sentence_figures
from gsencoder.evaluate.tables import ScoreReport, grouped, spread, table_of

OPTIONS = ("min_iou", "java", "allow_missing")
MAX_TOKENS = 30
"""Tokens of a reference that Scan2Cap keeps (lib/config.py, MAX_DES_LEN)."""
EMPTY = "sos eos"
EXPECTED = (
    "an object from scenes to lists of {caption, box}, or from scene|object_id|object_name to lists of one caption"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class CaptionedObject:
    """A labeled object, its captions, wrapped in sos and eos, tokens with blanks between them, and the lower and upper
    corner of its box; None where the labels have no boxes."""

    scene: str
    object_id: int
    object_name: str
    captions: tuple[str, ...]
    aabb: tuple[Corner, Corner] | None = None

    @property
    def key(self) -> tuple[str, int]:
        return self.scene, self.object_id


BoxCaptions = dict[str, list[tuple[str, tuple[Corner, Corner]]]]
"""Predicted boxes of each scene: a caption, with or without sos and eos, and the lower and the upper corner."""
NamedCaptions = dict[tuple[str, int], str]
"""Predicted captions of labeled objects, by scene and id, where proposals are given and no boxes are predicted."""


class DenseCaptionScores(NamedTuple):
    """Scores of captions, one sample an object, in their order: the number of objects whose caption is empty, and
    the IoU of each with its best box, 0 without one; None where captions belong to objects by their ids."""

    missing: int
    ious: Float64[np.ndarray, "N"] | None
    sentences: SentenceScores


def score(predictions: Path, labels: Path, options: ScoreOptions) -> ScoreReport:
    """Scores of captions of boxes or of given objects."""
    objects = captioned_objects(read_scanrefer(labels))
    if not objects:
        raise InputError(f"{labels}: nothing to score: it holds no descriptions")
    boxes, named = read_caption_predictions(predictions, objects)
    tools = None if options.java else "Java was not asked for (java=false)"
    if boxes:
        silent = sorted({each.scene for each in objects} - boxes.keys())
        refuse_missing(silent, "scene", predictions, options)
        scores = score_box_captions(objects, boxes, min_iou=options.min_iou, tools=tools)
    else:
        missing = [f"{each.object_id} of {each.scene}" for each in objects if each.key not in named]
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
    names = ("cider", "rouge_l", "bleu_4")
    by_scene = [
        {"scene": scene, "objects": len(each), **{name: float(np.mean([row[name] for row in each])) for name in names}}
        for scene, each in grouped(rows, "scene").items()
    ]
    return ScoreReport(
        results={
            "protocol": "captions",
            "objects": len(objects),
            "predictions": sum(map(len, boxes.values())) + len(named),
            "missing": scores.missing,
            "min_iou": options.min_iou if boxes else None,
            "tokens": sentences.tokens,
            "absent": sentences.absent,
            **overall,
            "spread": spread(by_scene, names),
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
    objects = grouped(expressions, "scene", "object_id")
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
    boxes: BoxCaptions,
    *,
    min_iou: float = 0.5,
    tools: JavaTools | str | None = None,
) -> DenseCaptionScores:
    """m@kIoU of predicted boxes with captions; k is `min_iou`, `tools` as of `score_sentences`."""
    ious = np.zeros(len(objects))
    captions: list[str | None] = []
    for row, each in enumerate(objects):
        if each.aabb is None:
            raise InputError(f"object {each.object_id} of {each.scene} has no box; captions of boxes need true boxes")
        captions.append(None)
        if there := boxes.get(each.scene):
            values = box_ious(np.array([aabb for _, aabb in there], np.float64), np.array(each.aabb, np.float64))
            ious[row] = values.max()
            if ious[row] > min_iou:
                captions[row] = there[int(values.argmax())][0]
    return _scores(objects, captions, ious, tools)


def score_named_captions(
    objects: Sequence[CaptionedObject], captions: NamedCaptions, *, tools: JavaTools | str | None = None
) -> DenseCaptionScores:
    """The same scores where every caption says which object it is about, and none is dropped for its box."""
    return _scores(objects, [captions.get(each.key) for each in objects], None, tools)


def _scores(
    objects: Sequence[CaptionedObject],
    captions: Sequence[str | None],
    ious: np.ndarray | None,
    tools: JavaTools | str | None,
) -> DenseCaptionScores:
    wrapped = [EMPTY if caption is None else wrapped_caption(caption) for caption in captions]
    sentences = score_sentences(wrapped, [each.captions for each in objects], tokens="given", tools=tools)
    return DenseCaptionScores(sum(caption is None for caption in captions), ious, sentences)


def read_caption_predictions(path: Path, objects: Sequence[CaptionedObject]) -> tuple[BoxCaptions, NamedCaptions]:
    """Reads predicted captions of boxes or of given objects, by what is in the file, for labeled objects; one of both
    is empty."""
    content = read_benchmark_json(path)
    if not isinstance(content, dict):
        swapped = isinstance(content, list) and content and isinstance(content[0], dict) and "ann_id" in content[0]
        hint = "; this is truth: were predictions and truth swapped?" if swapped else ""
        raise InputError(f"{path}: expected {EXPECTED}, got {brief(content)}{hint}")
    if any("|" in key for key in content):
        return {}, _named(content, path, objects)
    scenes = {each.scene for each in objects}
    boxes: BoxCaptions = {}
    for key, rows in content.items():
        where = f"{path}: {brief(key)}"
        if scene_name(key, where) not in scenes:
            raise InputError(f"{where}: is no scene of the truth")
        for entry, place in entries_of(rows, path, "caption and box", key=key):
            caption = text_value(entry.get("caption"), place, "caption", empty=True)
            boxes.setdefault(key, []).append((caption, corner_bounds(entry.get("box"), place, "box")))
    return boxes, {}


def _named(content: Mapping[str, Any], path: Path, objects: Sequence[CaptionedObject]) -> NamedCaptions:
    names = {each.key: each.object_name for each in objects}
    key_of: dict[tuple[str, int], str] = {}
    captions: NamedCaptions = {}
    for key, value in content.items():
        where = f"{path}: {brief(key)}"
        scene, _, rest = key.partition("|")
        number_text, _, name = rest.partition("|")
        identity = scene_name(scene, where), object_id(number_text, where)
        if identity not in names:
            raise InputError(f"{where}: is no object of the truth")
        if name and name != names[identity]:
            raise InputError(f"{where}: the truth calls this object {brief(names[identity])}")
        if identity in key_of:
            raise InputError(f"{where}: is the same object as {brief(key_of[identity])}")
        sentences = text_list(value, where, "caption", empty=True)
        if len(sentences) != 1:
            raise InputError(f"{where}: has {len(sentences)} captions, expected one")
        key_of[identity] = key
        captions[identity] = sentences[0]
    return captions
