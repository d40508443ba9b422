"""Average precision of instances, as ScanNet's `evaluate_semantic_instance.py` counts it (Dai et al. 2017).

`gsencoder.evaluate.scores.instance_matches` decides which predictions match a truth, are wrong, or are ignored.
Precision p and recall r are taken at each distinct score, from the lowest, and the point (1, 0) is added; AP sums
p[i] · (r[i - 1] - r[i + 1]) / 2, with r[-1] = r[0] and a 0 after the last. Predictions of one score are one step of the
curve, whatever their order.

AP of a class is the mean over the thresholds 0.50, 0.55, …, 0.90; AP50 and AP25 are those at 0.5 and 0.25. Without
truths a class has none, and means leave it out; with truths and no predictions it is 0.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from gsencoder.core.arrays import first_repeated
from gsencoder.core.errors import InputError
from gsencoder.data.labels.classes import ClassTable
from gsencoder.evaluate.scores.instance_matches import OVERLAPS, SceneMatches


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
    if repeated := first_repeated(scene.scene for scene in matches):
        raise InputError(f"instances: the scene {repeated[0]} is there twice; each is scored once")
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
