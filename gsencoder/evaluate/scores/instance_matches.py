"""Which predicted instances match true ones, as ScanNet's `evaluate_semantic_instance.py` decides it (Dai et al. 2017).

A truth is an instance of a scored class with 100 vertices or more. A prediction is a mask of vertices with a class and
a score; masks of fewer than 100 vertices are left out, as are those of classes that are not scored. At a threshold of
the IoU:

* Truths, in the order of their ids, take the predictions of their class whose IoU is strictly above the threshold, in
  the order in which these are listed, unless another truth has them already. The highest score is that of the match,
  and each further prediction is a false positive.
* A prediction that is above the threshold with no instance of its class is a false positive, unless more than that
  share of its vertices is ignored: vertices without a scored class, and those of its class's instances that have fewer
  than 100.

From 0.5 on a prediction can match one truth only, and the order in which predictions are listed means nothing; at 0.25
one may lie on several truths, and the order counts there, as in the official script, whatever the scores are.

Without classes, truths and predictions are all of one class; what truth labels as no class remains ignored.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

from gsencoder.core.errors import InputError
from gsencoder.data.labels.classes import ClassTable
from gsencoder.data.labels.expressions import IDS_PER_CLASS
from gsencoder.evaluate.scores.instance_masks import InstancePrediction, InstanceTruth

OVERLAPS = np.append(np.arange(0.5, 0.95, 0.05), 0.25)
"""Thresholds of IoU. Their floating-point values decide ties: 0.6 here is 0.6000000000000001."""
MIN_REGION = 100
"""Smallest number of vertices of a truth and of a prediction that count."""
MAX_TABLE = 1 << 22
"""Largest range of ids that are counted in a table; ScanNet200's reach 1,191,000."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneMatches:
    """Which predictions of a scene are right, at each threshold: all that scores need of it.

    Attributes:
        scene: its name.
        class_agnostic: whether classes were looked at.
        truths: numbers of truths by class (one class where they were not looked at).
        predictions: numbers of predictions that count, by class.
        scores: of these predictions.
        shared: number of these predictions that are above the lowest threshold with several truths.
        other_classes: number of predictions whose class is not scored.
        rows: class of each outcome; those of ignored predictions are left out.
        thresholds: index in `OVERLAPS` of each outcome.
        hits: whether it is a match, or a false positive.
        outcome_scores: its score.
    """

    scene: str
    class_agnostic: bool
    truths: Int64[np.ndarray, " C"]
    predictions: Int64[np.ndarray, " C"]
    scores: Float64[np.ndarray, " n"]
    shared: int
    other_classes: int
    rows: Int64[np.ndarray, " K"]
    thresholds: Int64[np.ndarray, " K"]
    hits: Bool[np.ndarray, " K"]
    outcome_scores: Float64[np.ndarray, " K"]


class _Pairs(NamedTuple):
    """Pairs of a prediction and an instance of its class that have vertices in common."""

    predictions: Int64[np.ndarray, " P"]
    instances: Int64[np.ndarray, " P"]
    ious: Float64[np.ndarray, " P"]


def match_instances(
    truth: InstanceTruth,
    prediction: InstancePrediction,
    classes: ClassTable,
    *,
    class_agnostic: bool = False,
    min_region: int = MIN_REGION,
) -> SceneMatches:
    """Decides at each threshold which predictions of a scene match a truth, are wrong, or are ignored.

    Args:
        truth: of the scene.
        prediction: of the same scene and vertices. The order of its masks matters where one of them lies on several
            truths (see the module).
        classes: that are scored.
        class_agnostic: leave the classes out of account; labels of predictions are then not looked at.
        min_region: smallest number of vertices of a truth and of a prediction that count.

    Raises:
        InputError: two scenes, or numbers of vertices that differ.
    """
    if truth.scene != prediction.scene:
        raise InputError(f"the prediction is of the scene {prediction.scene!r}, and the truth of {truth.scene!r}")
    if len(truth.ids) != prediction.num_vertices:
        raise InputError(
            f"{truth.scene}: the masks have {prediction.num_vertices:,} vertices, and the truth {len(truth.ids):,}; "
            "expected those of the same mesh"
        )
    ids, codes, sizes = _distinct(truth.ids)
    instance_rows, rows = classes.rows(ids // IDS_PER_CLASS), classes.rows(prediction.labels)
    if class_agnostic:
        instance_rows, rows = np.where(instance_rows < 0, -1, 0), np.zeros_like(rows)
    number = 1 if class_agnostic else len(classes.names)
    void = instance_rows < 0
    instance_rows = np.where(ids == 0, -1, instance_rows)
    in_score = (instance_rows >= 0) & (ids >= IDS_PER_CLASS) & (sizes >= min_region)
    other_classes = int((rows < 0).sum())
    large = np.flatnonzero((rows >= 0) & (np.diff(prediction.offsets) >= min_region))
    rows, scores, areas = rows[large], prediction.scores[large], np.diff(prediction.offsets)[large]
    common = np.zeros((len(large), len(ids)), np.int64)
    for row, index in enumerate(large.tolist()):
        common[row] = np.bincount(codes[prediction.mask(index)], minlength=len(ids))

    same = rows[:, None] == instance_rows
    first, second = np.nonzero(same & (common > 0))
    shared = common[first, second]
    pairs = _Pairs(first, second, shared / (sizes[second] + areas[first] - shared))
    # The official script adds an instance that is small and a group (an id below 1000) twice.
    small = same & (sizes < min_region)
    groups = same & (ids < IDS_PER_CLASS)
    ignored = (common * (void + small.astype(np.int64) + groups)).sum(axis=1) / np.maximum(areas, 1)

    outcomes = [_outcomes(pairs, in_score, scores, ignored, overlap) for overlap in OVERLAPS]
    of_instance = np.concatenate([owners for owners, _, _ in outcomes])
    hits = np.concatenate([right for _, right, _ in outcomes])
    multiple = np.bincount(pairs.predictions[(pairs.ious > OVERLAPS.min()) & in_score[pairs.instances]], minlength=1)
    return SceneMatches(
        scene=truth.scene,
        class_agnostic=class_agnostic,
        truths=np.bincount(instance_rows[in_score], minlength=number),
        predictions=np.bincount(rows, minlength=number),
        scores=scores,
        shared=int((multiple > 1).sum()),
        other_classes=other_classes,
        rows=rows[of_instance],
        thresholds=np.repeat(np.arange(len(OVERLAPS)), [len(owners) for owners, _, _ in outcomes]),
        hits=hits,
        outcome_scores=np.concatenate([values for _, _, values in outcomes]),
    )


def _distinct(
    ids: Int64[np.ndarray, " V"],
) -> tuple[Int64[np.ndarray, " I"], Int64[np.ndarray, " V"], Int64[np.ndarray, " I"]]:
    """The distinct ids in ascending order, the index of each vertex's id among them, and their numbers of vertices."""
    lowest = int(ids.min(initial=0))
    if int(ids.max(initial=0)) - lowest > MAX_TABLE:
        return np.unique(ids, return_inverse=True, return_counts=True)
    # Counting takes a tenth of the time of sorting.
    counts = np.bincount(ids - lowest)
    present = np.flatnonzero(counts)
    codes = np.zeros(len(counts), np.int64)
    codes[present] = np.arange(len(present))
    return present + lowest, codes[ids - lowest], counts[present]


def _outcomes(
    pairs: _Pairs,
    in_score: Bool[np.ndarray, " I"],
    scores: Float64[np.ndarray, " M"],
    ignored: Float64[np.ndarray, " M"],
    overlap: float,
) -> tuple[Int64[np.ndarray, " K"], Bool[np.ndarray, " K"], Float64[np.ndarray, " K"]]:
    """The outcomes at one threshold: a prediction of the class of each, whether it is a match, and its score."""
    above = pairs.ious > overlap
    candidates = np.flatnonzero(above & in_score[pairs.instances])
    candidates = candidates[np.lexsort((pairs.predictions[candidates], pairs.instances[candidates]))]
    used_predictions: set[int] = set()
    matched: dict[int, tuple[int, float]] = {}
    wrong: list[tuple[int, float]] = []
    for prediction, instance in zip(
        pairs.predictions[candidates].tolist(), pairs.instances[candidates].tolist(), strict=True
    ):
        if prediction in used_predictions:
            continue
        score = float(scores[prediction])
        if instance in matched:
            # A prediction that comes second is not taken, whichever of both scores is the higher one.
            owner, best = matched[instance]
            matched[instance] = owner, max(best, score)
            wrong.append((prediction, min(best, score)))
        else:
            used_predictions.add(prediction)
            matched[instance] = prediction, score
    alone = np.ones(len(scores), bool)
    alone[pairs.predictions[above]] = False
    false = np.flatnonzero(alone & (ignored <= overlap))
    owned = [*matched.values(), *wrong]
    return (
        np.concatenate([np.array([owner for owner, _ in owned], np.int64), false]),
        np.arange(len(owned) + len(false)) < len(matched),
        np.concatenate([np.array([score for _, score in owned], np.float64), scores[false]]),
    )
