"""Average precision of instances, as ScanNet's `evaluate_semantic_instance.py` counts it (Dai et al. 2017).

A truth is an instance of a scored class with 100 vertices or more. A prediction is a mask of vertices with a class and
a score; masks of fewer than 100 vertices are left out, as are those of classes that are not scored. At a threshold of
the IoU:

* Truths, in the order of their ids, take the predictions of their class whose IoU is strictly above the threshold, in
  the order in which these are listed, unless another truth has them already. The highest score is that of the match,
  and each further prediction is a false positive.
* A prediction that is above the threshold with no instance of its class is a false positive, unless more than that
  share of its vertices is ignored: vertices without a scored class, and those of its class's instances that have fewer
  than 100.
* Precision p and recall r are taken at each distinct score, from the lowest, and the point (1, 0) is added; AP sums
  p[i] · (r[i - 1] - r[i + 1]) / 2, with r[-1] = r[0] and a 0 after the last.

AP of a class is the mean over the thresholds 0.50, 0.55, …, 0.90; AP50 and AP25 are those at 0.5 and 0.25. Without
truths a class has none, and means leave it out; with truths and no predictions it is 0.

Predictions of one score are one step of the curve, whatever their order. From 0.5 on a prediction can match one truth
only, and the order in which predictions are listed means nothing; at 0.25 one may lie on several truths, and the order
counts there, as in the official script, whatever the scores are.

Without classes, truths and predictions are all of one class; what truth labels as no class remains ignored.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

from gsencoder.core.errors import InputError
from gsencoder.evaluate.scores.class_table import ClassTable
from gsencoder.evaluate.scores.instance_masks import InstancePrediction, InstanceTruth

OVERLAPS = np.append(np.arange(0.5, 0.95, 0.05), 0.25)
"""Thresholds of IoU. Their floating-point values decide ties: 0.6 here is 0.6000000000000001."""
MIN_REGION = 100
"""Smallest number of vertices of a truth and of a prediction that count."""
IDS_PER_LABEL = 1000
"""An instance's id in truth is its class's id times this, and a number from 1."""

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
    rows: Int64[np.ndarray, " K"]
    thresholds: Int64[np.ndarray, " K"]
    hits: Bool[np.ndarray, " K"]
    outcome_scores: Float64[np.ndarray, " K"]


@dataclass(frozen=True, slots=True, kw_only=True)
class InstanceAverages:
    """AP over 0.5 to 0.9, at 0.5 and at 0.25; NaN without truths."""

    ap: float
    ap50: float
    ap25: float


@dataclass(frozen=True, slots=True, kw_only=True)
class InstanceScores:
    """The scores of scenes.

    Attributes:
        scenes: how many.
        overall: mean over the classes that have truths.
        classes: by name; the one class of a class-agnostic score is called "any".
        groups: mean over the classes of each group that have truths.
        recall: share of the truths that are matched, by class and threshold of `OVERLAPS`; NaN without truths.
        truths: that count, by class.
        predictions: that count, by class.
        equal_scores: whether there are several predictions, all with one score. Their ranking is then undefined, and AP
            is recall · (precision + 1) / 2 at each threshold.
        shared: predictions that are above 0.25 with several truths; AP25 depends on the order of the predictions where
            there are any.
    """

    scenes: int
    overall: InstanceAverages
    classes: dict[str, InstanceAverages]
    groups: dict[str, InstanceAverages]
    recall: Float64[np.ndarray, "C T"]
    truths: Int64[np.ndarray, " C"]
    predictions: Int64[np.ndarray, " C"]
    equal_scores: bool
    shared: int


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
    instance_rows, rows = classes.rows(ids // IDS_PER_LABEL), classes.rows(prediction.labels)
    if class_agnostic:
        instance_rows, rows = np.where(instance_rows < 0, -1, 0), np.zeros_like(rows)
    number = 1 if class_agnostic else len(classes.names)
    void = instance_rows < 0
    instance_rows = np.where(ids == 0, -1, instance_rows)
    counted = (instance_rows >= 0) & (ids >= IDS_PER_LABEL) & (sizes >= min_region)
    kept = np.flatnonzero((rows >= 0) & (np.diff(prediction.offsets) >= min_region))
    rows, scores, areas = rows[kept], prediction.scores[kept], np.diff(prediction.offsets)[kept]
    common = np.zeros((len(kept), len(ids)), np.int64)
    for row, index in enumerate(kept.tolist()):
        common[row] = np.bincount(codes[prediction.mask(index)], minlength=len(ids))

    same = rows[:, None] == instance_rows
    first, second = np.nonzero(same & (common > 0))
    shared = common[first, second]
    pairs = _Pairs(first, second, shared / (sizes[second] + areas[first] - shared))
    # The official script adds an instance that is small and a group (an id below 1000) twice.
    small = same & (sizes < min_region)
    groups = same & (ids < IDS_PER_LABEL)
    ignored = (common * (void + small.astype(np.int64) + groups)).sum(axis=1) / np.maximum(areas, 1)

    outcomes = [_outcomes(pairs, counted, scores, ignored, overlap) for overlap in OVERLAPS]
    of_instance = np.concatenate([owners for owners, _, _ in outcomes])
    hits = np.concatenate([right for _, right, _ in outcomes])
    multiple = np.bincount(pairs.predictions[(pairs.ious > OVERLAPS.min()) & counted[pairs.instances]], minlength=1)
    return SceneMatches(
        scene=truth.scene,
        class_agnostic=class_agnostic,
        truths=np.bincount(instance_rows[counted], minlength=number),
        predictions=np.bincount(rows, minlength=number),
        scores=scores,
        shared=int((multiple > 1).sum()),
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
    counted: Bool[np.ndarray, " I"],
    scores: Float64[np.ndarray, " M"],
    ignored: Float64[np.ndarray, " M"],
    overlap: float,
) -> tuple[Int64[np.ndarray, " K"], Bool[np.ndarray, " K"], Float64[np.ndarray, " K"]]:
    """The outcomes at one threshold: a prediction of the class of each, whether it is a match, and its score."""
    above = pairs.ious > overlap
    candidates = np.flatnonzero(above & counted[pairs.instances])
    candidates = candidates[np.lexsort((pairs.predictions[candidates], pairs.instances[candidates]))]
    taken: set[int] = set()
    matched: dict[int, tuple[int, float]] = {}
    wrong: list[tuple[int, float]] = []
    for prediction, instance in zip(
        pairs.predictions[candidates].tolist(), pairs.instances[candidates].tolist(), strict=True
    ):
        if prediction in taken:
            continue
        score = float(scores[prediction])
        if instance in matched:
            # A prediction that comes second is not taken, whichever of both scores is the higher one.
            owner, best = matched[instance]
            matched[instance] = owner, max(best, score)
            wrong.append((prediction, min(best, score)))
        else:
            taken.add(prediction)
            matched[instance] = prediction, score
    alone = np.ones(len(scores), bool)
    alone[pairs.predictions[above]] = False
    false = np.flatnonzero(alone & (ignored <= overlap))
    found = [*matched.values(), *wrong]
    return (
        np.concatenate([np.array([owner for owner, _ in found], np.int64), false]),
        np.arange(len(found) + len(false)) < len(matched),
        np.concatenate([np.array([score for _, score in found], np.float64), scores[false]]),
    )


def average_precision(
    scores: Float64[np.ndarray, " n"], hits: Bool[np.ndarray, " n"], truths: int
) -> tuple[float, float]:
    """AP and recall of ranked predictions (the module has the equation); predictions of one score are one step.

    Args:
        scores: of predictions that are not ignored.
        hits: which of them match a truth.
        truths: number of truths, one or more.
    """
    order = np.argsort(scores, kind="stable")
    _, starts = np.unique(scores[order], return_index=True)
    hits_before = np.concatenate([[0], np.cumsum(hits[order])])
    right = hits_before[-1] - hits_before[starts]
    precision = np.append(right / (len(scores) - starts), 1.0)
    recall = np.append(right / truths, 0.0)
    around = np.concatenate([recall[:1], recall, [0.0]])
    return float(precision @ ((around[:-2] - around[2:]) / 2)), float(recall[0])


def instance_scores(matches: Sequence[SceneMatches], classes: ClassTable) -> InstanceScores:
    """The scores of scenes together; of one scene, its own.

    Args:
        matches: of the scenes, in any order.
        classes: with which they were matched.

    Raises:
        InputError: no scene, a scene that is there twice, or matches with and without classes.
    """
    if not matches:
        raise InputError("instances: no scene to score")
    names = [scene.scene for scene in matches]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"instances: the scene {twice} is there twice; each is scored once")
    agnostic = matches[0].class_agnostic
    labels = ("any",) if agnostic else classes.names
    if any(m.class_agnostic != agnostic or len(m.truths) != len(labels) for m in matches):
        raise InputError("instances: the scenes were matched with different classes")
    truths = np.sum([m.truths for m in matches], axis=0)
    predictions = np.sum([m.predictions for m in matches], axis=0)
    keys = np.concatenate([m.rows * len(OVERLAPS) + m.thresholds for m in matches])
    order = np.argsort(keys, kind="stable")
    starts = np.searchsorted(keys[order], np.arange(len(labels) * len(OVERLAPS) + 1))
    hits = np.concatenate([m.hits for m in matches])[order]
    scores = np.concatenate([m.outcome_scores for m in matches])[order]
    table, recall = np.full((2, len(labels), len(OVERLAPS)), math.nan)
    for row in np.flatnonzero(truths):
        for column in range(len(OVERLAPS)):
            cell = row * len(OVERLAPS) + column
            part = slice(starts[cell], starts[cell + 1])
            table[row, column], recall[row, column] = average_precision(scores[part], hits[part], int(truths[row]))
    ranked = np.concatenate([m.scores for m in matches])
    # A group's names are rows of the table; none of them are scored without classes.
    members = {} if agnostic else {g: [labels.index(name) for name in n] for g, n in classes.groups.items()}
    return InstanceScores(
        scenes=len(matches),
        overall=_averages(table),
        classes={name: _averages(table[row : row + 1]) for row, name in enumerate(labels)},
        groups={group: _averages(table[rows]) for group, rows in members.items()},
        recall=recall,
        truths=truths,
        predictions=predictions,
        equal_scores=len(ranked) > 1 and bool((ranked == ranked[0]).all()),
        shared=sum(m.shared for m in matches),
    )


def _averages(table: Float64[np.ndarray, "c T"]) -> InstanceAverages:
    """Means over the classes of a table that have truths."""
    present = table[~np.isnan(table[:, 0])]
    if not len(present):
        return InstanceAverages(ap=math.nan, ap50=math.nan, ap25=math.nan)
    strict, half, quarter = OVERLAPS >= 0.5, OVERLAPS == 0.5, OVERLAPS == 0.25
    ap, ap50, ap25 = (float(present[:, which].mean()) for which in (strict, half, quarter))
    return InstanceAverages(ap=ap, ap50=ap50, ap25=ap25)
