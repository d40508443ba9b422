"""Average precision of instances on random scenes: the definition, and orders that mean nothing."""

import itertools
import math
from collections.abc import Sequence
from random import Random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from instance_scenes import BED, CHAIR, CLASSES, VERTICES, Mask, aps, masks_of, scored, truth_of

from gsencoder.data.labels.classes import ClassTable
from gsencoder.evaluate.benchmarks.instances import (
    OVERLAPS,
    InstanceScores,
    instance_scores,
    match_instances,
    prediction_of_masks,
)


@st.composite
def scenes(draw: st.DrawFn) -> tuple[np.ndarray, list[Mask]]:
    borders = sorted(draw(st.lists(st.integers(0, VERTICES), min_size=2, max_size=9, unique=True)))
    labels = st.sampled_from([0, 4, 4, 5, 9])
    parts = [(a, b, draw(labels) * 1000 + k) for k, (a, b) in enumerate(itertools.pairwise(borders), 1)]
    masks = []
    for _ in range(draw(st.integers(0, 6))):
        first, last, number = draw(st.sampled_from(parts))
        start = max(0, first + draw(st.integers(-60, 60)))
        end = min(VERTICES, max(start, last + draw(st.integers(-60, 200))))
        masks.append((start, end, draw(st.sampled_from([number // 1000, 4])), draw(st.sampled_from([0.1, 0.5, 0.9]))))
    return truth_of(*parts), masks


def same(first: InstanceScores, second: InstanceScores) -> None:
    assert aps(first) == pytest.approx(aps(second), nan_ok=True)


def by_definition(truth: np.ndarray, masks: Sequence[Mask], label: int, overlap: float) -> float:
    """AP of a class of one scene at one threshold from 0.5 on, where no mask lies on two truths, by sets and loops."""
    ids = sorted({number for number in truth.tolist() if number // 1000 == label})
    instances = {number: set(np.flatnonzero(truth == number).tolist()) for number in ids}
    void = {v for v, number in enumerate(truth.tolist()) if number // 1000 not in CLASSES.ids}
    candidates = [(set(range(a, b)), score) for a, b, own, score in masks if own == label and b - a >= 100]
    big = {number for number in ids if len(instances[number]) >= 100}
    if not big:
        return math.nan
    ranked: list[tuple[float, bool]] = []
    owned: dict[int, list[float]] = {}
    for mask, score in candidates:
        owner = [n for n in ids if len(mask & instances[n]) / len(mask | instances[n]) > overlap]
        if owner:
            owned.setdefault(owner[0], []).append(score)
        else:
            ignored = len(mask & void) + sum(len(mask & instances[n]) for n in ids if n not in big)
            if ignored / len(mask) <= overlap:
                ranked.append((score, False))
    for number, matches in owned.items():
        if number in big:
            ranked += [(score, rank == 0) for rank, score in enumerate(sorted(matches, reverse=True))]
    points = [(1.0, 0.0)]
    for least in sorted({score for score, _ in ranked}, reverse=True):
        above = [hit for score, hit in ranked if score >= least]
        points.insert(0, (sum(above) / len(above), sum(above) / len(big)))
    recalls = [points[0][1], *(recall for _, recall in points), 0.0]
    return sum(p * (recalls[k] - recalls[k + 2]) / 2 for k, (p, _) in enumerate(points))


@given(scenes())
def test_every_threshold_from_a_half_follows_the_definition(scene: tuple[np.ndarray, list[Mask]]) -> None:
    truth, masks = scene
    scores = scored(truth, *masks)
    for name, label in (("bed", BED), ("chair", CHAIR)):
        expected = [by_definition(truth, masks, label, overlap) for overlap in OVERLAPS[:-1]]
        assert scores.classes[name].ap == pytest.approx(np.mean(expected), nan_ok=True)
        assert scores.classes[name].ap50 == pytest.approx(expected[0], nan_ok=True)


@given(scenes(), st.randoms())
def test_the_order_of_masks_means_nothing_where_none_lies_on_two_truths(
    scene: tuple[np.ndarray, list[Mask]], random: Random
) -> None:
    truth, masks = scene
    shuffled = list(masks)
    random.shuffle(shuffled)
    first, second = scored(truth, *masks), scored(truth, *shuffled)
    assert first.shared == second.shared
    if first.shared:
        assert (first.overall.ap, first.overall.ap50) == pytest.approx(
            (second.overall.ap, second.overall.ap50), nan_ok=True
        )
    else:
        same(first, second)


@given(scenes(), st.integers(0, 2**32 - 1))
def test_the_order_of_vertices_means_nothing(scene: tuple[np.ndarray, list[Mask]], seed: int) -> None:
    truth, masks = scene
    order = np.random.default_rng(seed).permutation(VERTICES)
    made = masks_of(*masks)
    in_masks = [np.isin(order, made.masks[index]) for index in range(len(masks))]
    moved = prediction_of_masks("a", in_masks, made.labels.tolist(), made.scores.tolist(), num_vertices=VERTICES)
    matches = match_instances(truth[order], moved, CLASSES)
    same(scored(truth, *masks), instance_scores([matches], CLASSES))


@given(scenes())
def test_only_the_ranking_by_scores_counts(scene: tuple[np.ndarray, list[Mask]]) -> None:
    truth, masks = scene
    same(scored(truth, *masks), scored(truth, *[(a, b, label, 5 * score - 9) for a, b, label, score in masks]))


@given(st.lists(scenes(), min_size=2, max_size=4))
def test_the_order_of_scenes_means_nothing_and_a_scene_without_anything_changes_nothing(
    parts: list[tuple[np.ndarray, list[Mask]]],
) -> None:
    matches = [
        match_instances(truth, masks_of(*masks, scene=str(k)), CLASSES) for k, (truth, masks) in enumerate(parts)
    ]
    empty = match_instances(truth_of(), masks_of(scene="empty"), CLASSES)
    same(instance_scores(matches, CLASSES), instance_scores([empty, *matches[::-1]], CLASSES))


def test_ids_in_a_wide_range_match_as_those_in_a_narrow_one() -> None:
    classes = ClassTable(names=("far",), ids=(2_000_000,))
    truth = truth_of((0, 200, 2_000_000_001), (200, 400, 2_000_000_002))
    masks = masks_of((0, 200, 2_000_000, 0.5), (200, 399, 2_000_000, 0.6))
    assert instance_scores([match_instances(truth, masks, classes)], classes).overall.ap == 1
