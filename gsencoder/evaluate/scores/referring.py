"""Objects that a sentence refers to: the share of the sentences whose box has an IoU of 0.25, or 0.5, or more.

ScanRefer's metric (Chen et al. 2020; `benchmark/eval.py` and `scripts/eval.py`), with the IoU of axis-aligned boxes
that `gsencoder.evaluate.scores.box_overlap` defines, also for the unique, the multiple and the other sentences of
`gsencoder.evaluate.scores.referring_kinds` alone. A sentence without a predicted box has the IoU 0.

A method that finds several boxes is also scored by the best of the first k, or of all of them, as the paper does for
its table 5 (sec. 4.5). A user cannot know which box that is.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from gsencoder.core.arrays import first_repeated
from gsencoder.core.errors import InputError
from gsencoder.data.labels.expressions import Expression, described
from gsencoder.evaluate.scores.box_overlap import box_ious

IOUS = (0.25, 0.5)
"""IoUs from which on a box counts."""
NO_TRUE_BOX = "the object has no box in the truth"
"""Reason for which a sentence is not scored."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Sentence:
    """Which sentence something is about.

    Attributes:
        scene: name of its scene.
        object: id of the object that it means.
        annotation: number of the sentence about this object.
    """

    scene: str
    object: str
    annotation: str

    @property
    def key(self) -> tuple[str, str, str]:
        return self.scene, self.object, self.annotation


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferredObject(Sentence):
    """The truth of one sentence.

    Attributes:
        box: lower and upper corner; None if the object has none, and the sentence is not scored.
        multiple: whether its scene has several objects of its class; None if that is not known.
        others: whether its class is none of the named ones; None if that is not known.
    """

    box: Float64[np.ndarray, "2 3"] | None
    multiple: bool | None = None
    others: bool | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class PredictedBoxes(Sentence):
    """The boxes predicted for one sentence.

    Attributes:
        boxes: lower and upper corners, the likeliest box first; none where there is none.
        multiple: what the prediction's file says of the truth's `multiple`, as ScanRefer's own files do.
        others: the same of `others`.
    """

    boxes: Float64[np.ndarray, "K 2 3"]
    multiple: bool | None = None
    others: bool | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferringResult(Sentence):
    """One sentence, scored.

    Attributes:
        ious: of the predicted boxes with that of the object, in the order of the predictions.
        multiple: whether its scene has several objects of its class; None if that is not known.
        others: whether its class is none of the named ones; None if that is not known.
    """

    ious: tuple[float, ...]
    multiple: bool | None
    others: bool | None


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferringCell:
    """The accuracy of some sentences; NaN without any, where the official script prints 0."""

    sentences: int
    acc25: float
    acc50: float


ReferringTable = dict[str, dict[str, ReferringCell]]
"""Cells by "unique", "multiple" and "overall", and there by "not_in_others", "in_others" and "overall"."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferringScores:
    """The scores of sentences.

    Attributes:
        sentences: that are scored.
        without_box: of them, those without a predicted box.
        top1: of the first box.
        best_of: of the best among the first k boxes, by k.
        best: of the best among all boxes.
    """

    sentences: int
    without_box: int
    top1: ReferringTable
    best_of: dict[int, ReferringTable]
    best: ReferringTable


def referred_objects(expressions: Sequence[Expression]) -> tuple[ReferredObject, ...]:
    """The truth of expressions, in order."""
    return tuple(
        ReferredObject(
            scene=each.scene,
            object=str(each.object_id),
            annotation=each.annotation,
            box=None if each.aabb is None else np.array(each.aabb, np.float64),
            multiple=each.multiple,
            others=each.others,
        )
        for each in expressions
    )


def compare_boxes(
    predictions: Sequence[PredictedBoxes], truth: Sequence[ReferredObject], *, allow_missing: bool = False
) -> tuple[tuple[ReferringResult, ...], dict[str, int]]:
    """Computes the IoUs of every sentence of the truth.

    Args:
        predictions: in any order. What they say of `multiple` and `others` is taken where the truth does not say it.
        truth: in any order.
        allow_missing: count sentences without a prediction as ones without a box; else they are refused.

    Returns:
        The sentences that are scored, in the order of the truth; and how many are not, by the reason.

    Raises:
        InputError: a sentence that is there twice, is not in the truth, or has no prediction; truth and prediction
            that contradict each other about `multiple` or `others`.
    """
    _refuse_repeated([item.key for item in truth], "is there twice in the truth; expected each once")
    _refuse_repeated([item.key for item in predictions], "is predicted twice; expected each once")
    prediction_of = {prediction.key: prediction for prediction in predictions}
    keys = {item.key for item in truth}
    unknown = next((key for key in prediction_of if key not in keys), None)
    if unknown is not None:
        raise InputError(f"{described(unknown)} is predicted, and not in the truth")
    results, skipped = [], 0
    for item in truth:
        if item.box is None:
            skipped += 1
            continue
        if item.key not in prediction_of and not allow_missing:
            raise InputError(f"{described(item.key)} has no prediction")
        prediction = prediction_of.get(item.key) or PredictedBoxes(
            scene=item.scene, object=item.object, annotation=item.annotation, boxes=np.zeros((0, 2, 3))
        )
        results.append(
            ReferringResult(
                scene=item.scene,
                object=item.object,
                annotation=item.annotation,
                ious=tuple(box_ious(prediction.boxes, item.box).tolist()),
                multiple=_agreed(item.multiple, prediction.multiple, "unique_multiple", item.key),
                others=_agreed(item.others, prediction.others, "others", item.key),
            )
        )
    return tuple(results), {NO_TRUE_BOX: skipped} if skipped else {}


def referring_scores(results: Sequence[ReferringResult], *, ks: Sequence[int] = (5,)) -> ReferringScores:
    """The scores of sentences of any scenes. Those whose `multiple` or `others` is not known count in "overall" alone.

    Args:
        results: as `compare_boxes` gives them.
        ks: numbers of boxes of which the best counts.

    Raises:
        InputError: a sentence that is there twice, or a k below 1.
    """
    _refuse_repeated([item.key for item in results], "is there twice; each is scored once")
    if min(ks, default=1) < 1:
        raise InputError(f"referring: expected k of 1 or more, got {min(ks)}")

    def table(k: int | None) -> ReferringTable:
        ious = np.array([max(item.ious[:k], default=0.0) for item in results], np.float64)
        return _table(ious, results)

    return ReferringScores(
        sentences=len(results),
        without_box=sum(not item.ious for item in results),
        top1=table(1),
        best_of={k: table(k) for k in ks},
        best=table(None),
    )


def _refuse_repeated(keys: Sequence[tuple[str, str, str]], problem: str) -> None:
    if repeated := first_repeated(keys):
        raise InputError(f"{described(repeated[0])} {problem}")


def _agreed(true: bool | None, predicted: bool | None, subject: str, key: tuple[str, str, str]) -> bool | None:
    if true is not None and predicted is not None and true != predicted:
        raise InputError(
            f"{described(key)}: {subject} is {int(predicted)} in the prediction, and {int(true)} in the truth"
        )
    return predicted if true is None else true


def _table(ious: Float64[np.ndarray, " n"], results: Sequence[ReferringResult]) -> ReferringTable:
    everything = np.ones(len(results), bool)
    subsets = {
        "unique": np.array([item.multiple is False for item in results], bool),
        "multiple": np.array([item.multiple is True for item in results], bool),
        "overall": everything,
    }
    kinds: Mapping[str, np.ndarray] = {
        "not_in_others": np.array([item.others is False for item in results], bool),
        "in_others": np.array([item.others is True for item in results], bool),
        "overall": everything,
    }
    return {
        subset: {kind: _cell(ious[inside & of_kind]) for kind, of_kind in kinds.items()}
        for subset, inside in subsets.items()
    }


def _cell(ious: Float64[np.ndarray, " n"]) -> ReferringCell:
    acc25, acc50 = (float((ious >= least).mean()) if len(ious) else math.nan for least in IOUS)
    return ReferringCell(sentences=len(ious), acc25=acc25, acc50=acc50)
