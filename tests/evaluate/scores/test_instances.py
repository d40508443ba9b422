"""Average precision of instances: values worked out by hand, and laws on random scenes."""

import itertools
import math
from collections.abc import Sequence
from random import Random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsencoder.core.errors import InputError
from gsencoder.data.truth.class_table import ClassTable
from gsencoder.evaluate.scores.instance_masks import InstancePrediction, InstanceTruth, prediction_of_masks
from gsencoder.evaluate.scores.instance_matches import OVERLAPS, match_instances
from gsencoder.evaluate.scores.instances import InstanceScores, average_precision, instance_scores

CLASSES = ClassTable(
    names=("bed", "chair", "sofa"), ids=(4, 5, 6), groups={"head": ("bed",), "common": ("chair", "sofa"), "tail": ()}
)
BED, CHAIR, SOFA = 4, 5, 6
VERTICES = 2000

Mask = tuple[int, int, int, float]
"""First vertex, one past the last, class id, score."""


def truth_of(*parts: tuple[int, int, int], scene: str = "a") -> InstanceTruth:
    """A scene of 2,000 vertices with runs of vertices (first, one past the last, id); the others have the id 0."""
    ids = np.zeros(VERTICES, np.int64)
    for first, last, number in parts:
        ids[first:last] = number
    return InstanceTruth(scene=scene, ids=ids)


def masks_of(*masks: Mask, scene: str = "a") -> InstancePrediction:
    vertices = np.arange(VERTICES)
    return prediction_of_masks(
        scene,
        [(vertices >= first) & (vertices < last) for first, last, _, _ in masks],
        [label for _, _, label, _ in masks],
        [score for _, _, _, score in masks],
        num_vertices=VERTICES,
    )


def scored(truth: InstanceTruth, *masks: Mask, class_agnostic: bool = False) -> InstanceScores:
    matches = match_instances(truth, masks_of(*masks), CLASSES, class_agnostic=class_agnostic)
    return instance_scores([matches], CLASSES)


def aps(scores: InstanceScores) -> tuple[float, float, float]:
    return scores.overall.ap, scores.overall.ap50, scores.overall.ap25


def test_the_thresholds_are_nine_from_a_half_and_a_quarter() -> None:
    expected = [0.5, 0.55, 0.6, 0.65, 0.7, 0.75, 0.8, 0.85, 0.9, 0.25]
    assert OVERLAPS.tolist() == pytest.approx(expected, rel=1e-12)


def test_a_mask_that_is_the_truth_is_perfect() -> None:
    # precision (1, 1), recall (1, 0), steps (1 - 0) / 2 and (1 - 0) / 2.
    assert aps(scored(truth_of((0, 200, 4001)), (0, 200, BED, 0.3))) == (1, 1, 1)


def test_a_ranking_is_integrated_as_by_hand() -> None:
    # Two beds. Right at 0.9, wrong at 0.8 (on a chair), right at 0.7. From the lowest score:
    #   precision 2/3, 1/2, 1, and 1 at the end; recall 1, 1/2, 1/2, and 0.
    #   steps (1 - 1/2) / 2, (1 - 1/2) / 2, (1/2 - 0) / 2, (1/2 - 0) / 2: a quarter each.
    # AP of beds = (2/3 + 1/2 + 1 + 1) / 4 = 19/24. There is one chair, which nothing finds: 0.
    truth = truth_of((0, 200, 4001), (200, 400, 4002), (400, 600, 5001))
    scores = scored(truth, (0, 200, BED, 0.9), (400, 600, BED, 0.8), (200, 400, BED, 0.7))
    assert scores.classes["bed"].ap == pytest.approx(19 / 24)
    assert scores.classes["bed"].ap25 == pytest.approx(19 / 24)
    assert scores.classes["chair"].ap == 0
    assert scores.overall.ap == pytest.approx(19 / 48)
    assert scores.recall[0].tolist() == [1] * 10


def test_equal_scores_are_one_step_and_are_reported() -> None:
    # Two beds, one right mask and one on a chair, both of score 1: precision (1/2, 1), recall (1/2, 0), and steps of
    # 1/4: AP = (1/2 + 1) / 4.
    truth = truth_of((0, 200, 4001), (200, 400, 4002), (400, 600, 5001))
    scores = scored(truth, (0, 200, BED, 1.0), (400, 600, BED, 1.0))
    assert scores.classes["bed"].ap50 == pytest.approx(3 / 8)
    assert scores.equal_scores


def test_scores_that_differ_and_a_single_mask_have_a_ranking() -> None:
    truth = truth_of((0, 200, 4001))
    assert not scored(truth, (0, 200, BED, 1.0)).equal_scores
    assert not scored(truth, (0, 200, BED, 1.0), (0, 200, BED, 0.9)).equal_scores
    assert not scored(truth).equal_scores


@pytest.mark.parametrize(
    ("size", "expected"),
    [
        (100, (0, 0, 0)),  # 100 / 400 = 0.25 is not above 0.25.
        (101, (0, 0, 1)),
        (200, (0, 0, 1)),  # 200 / 400 = 0.5 is not above 0.5.
        (201, (1 / 9, 1, 1)),
        (240, (2 / 9, 1, 1)),  # 240 / 400 is above 0.55, and not above 0.6.
    ],
)
def test_the_iou_must_be_above_the_threshold(size: int, expected: tuple[float, float, float]) -> None:
    assert aps(scored(truth_of((0, 400, 4001)), (0, size, BED, 1.0))) == pytest.approx(expected)


def test_a_second_mask_of_a_truth_is_wrong_and_the_higher_score_is_right() -> None:
    # Match at 0.9, false at 0.3: precision (1/2, 1, 1), recall (1, 1, 0), steps 0, 1/2, 1/2.
    truth = truth_of((0, 200, 4001))
    for masks in ([(0, 200, BED, 0.3), (0, 190, BED, 0.9)], [(0, 190, BED, 0.9), (0, 200, BED, 0.3)]):
        assert scored(truth, *masks).overall.ap50 == 1
    # The second mask of the first bed outranks the match of the second: from the lowest score, precision 2/3, 1/2, 1, 1
    # and recall 1, 1/2, 1/2, 0, which is 19/24 as above.
    truth = truth_of((0, 200, 4001), (200, 400, 4002))
    masks = [(0, 200, BED, 0.9), (0, 190, BED, 0.8), (200, 400, BED, 0.7)]
    assert scored(truth, *masks).overall.ap50 == pytest.approx(19 / 24)


def test_a_mask_mostly_on_vertices_without_class_is_ignored_at_lower_thresholds() -> None:
    # 120 of 200 vertices have no class: a share of 0.6, which is above 0.25, 0.5 and 0.55. There the match at 0.5 is
    # alone, and AP is 1. At the other seven the mask is false: precision (1/2, 0, 1), recall (1, 0, 0), steps 1/2, 1/2,
    # 0, and AP is 1/4.
    truth = truth_of((0, 200, 4001), (400, 480, 5001))
    scores = scored(truth, (0, 200, BED, 0.5), (400, 600, BED, 0.9))
    assert scores.classes["bed"].ap == pytest.approx((2 + 7 / 4) / 9)
    assert scores.classes["bed"].ap50 == scores.classes["bed"].ap25 == 1


def test_an_id_of_no_class_is_ignored_as_0_is() -> None:
    for number in (0, 17, 999, 7001, -1, -3000):
        truth = truth_of((0, 200, 4001), (400, 600, number))
        assert scored(truth, (0, 200, BED, 0.5), (400, 600, BED, 0.9)).overall.ap == 1


def test_a_truth_of_99_vertices_does_not_count_and_one_of_100_does() -> None:
    assert math.isnan(scored(truth_of((0, 99, 4001)), (0, 100, BED, 1.0)).overall.ap)
    assert scored(truth_of((0, 100, 4001)), (0, 100, BED, 1.0)).overall.ap == 1


def test_a_mask_of_99_vertices_does_not_count() -> None:
    scores = scored(truth_of((0, 100, 4001)), (0, 99, BED, 1.0))
    assert scores.overall.ap == 0
    assert scores.predictions.tolist() == [0, 0, 0]


@pytest.mark.parametrize(("small", "first"), [(4002, 1.0), (5002, 0.25)])
def test_small_instances_are_ignored_for_masks_of_their_class_alone(small: int, first: float) -> None:
    # 80 of 150 vertices are 80 of the 90 of a small instance: IoU 80 / 160 = 0.5, which is not above 0.5, and a share
    # of 0.53 is ignored at 0.5 and not at 0.55. The others are a sofa. At 0.55, and where the small one is a chair, the
    # mask is false and ranks first: AP 1/4, as above.
    truth = truth_of((0, 200, 4001), (400, 490, small), (490, 800, 6001))
    scores = scored(truth, (0, 200, BED, 0.5), (410, 560, BED, 0.9))
    assert scores.classes["bed"].ap50 == first
    assert scores.classes["bed"].ap == pytest.approx((first + 8 / 4) / 9)


def test_a_mask_on_a_small_instance_of_its_class_is_neither_right_nor_wrong() -> None:
    truth = truth_of((0, 200, 4001), (400, 499, 4002), (499, 600, 5001))
    scores = scored(truth, (0, 200, BED, 0.5), (400, 500, BED, 0.9))
    assert scores.classes["bed"].ap == 1


def test_a_mask_at_the_limit_of_the_ignored_share_is_false() -> None:
    # Half of the mask has no class, and the share must be above the threshold of a half.
    truth = truth_of((0, 200, 4001), (400, 500, 5001))
    assert scored(truth, (0, 200, BED, 0.5), (400, 600, BED, 0.9)).classes["bed"].ap50 == 0.25
    assert scored(truth, (0, 200, BED, 0.5), (400, 601, BED, 0.9)).classes["bed"].ap50 == 1


def test_a_mask_over_two_truths_goes_to_the_one_that_comes_first_and_the_order_of_masks_counts() -> None:
    # P has 60 vertices of each of two beds (IoU 60 / 160 = 0.375), Q is the first bed.
    # P, Q: the first bed takes P, Q is its second mask, and the second bed finds P taken. One of two is right, one of
    # two masks wrong, at one score: AP25 = 1/2 · (1/2 + 1) / 2.
    # Q, P: the first bed takes Q, P is its second mask and false, and the second bed takes P: AP25 = (2/3 + 1) / 2.
    truth = truth_of((0, 100, 4001), (100, 200, 4002))
    p, q = (40, 160, BED, 1.0), (0, 100, BED, 1.0)
    assert scored(truth, p, q).overall.ap25 == pytest.approx(3 / 8)
    assert scored(truth, q, p).overall.ap25 == pytest.approx(5 / 6)
    assert scored(truth, p, q).shared == scored(truth, q, p).shared == 1
    assert scored(truth, p, q).overall.ap50 == scored(truth, q, p).overall.ap50


def test_a_class_without_truths_is_left_out_of_means_however_often_it_is_predicted() -> None:
    scores = scored(truth_of((0, 200, 4001)), (0, 200, BED, 0.5), (0, 200, SOFA, 0.9))
    assert scores.overall.ap == 1
    assert math.isnan(scores.classes["sofa"].ap)
    assert scores.predictions.tolist() == [1, 0, 1]


def test_groups_are_means_of_their_classes_with_truths() -> None:
    truth = truth_of((0, 200, 4001), (200, 400, 5001), (400, 600, 6001))
    scores = scored(truth, (0, 200, BED, 1.0), (200, 400, CHAIR, 1.0))
    assert scores.groups["head"].ap50 == 1
    assert scores.groups["common"].ap50 == 0.5
    assert math.isnan(scores.groups["tail"].ap50)
    assert scores.overall.ap50 == pytest.approx(2 / 3)


def test_without_classes_any_label_finds_any_truth() -> None:
    truth = truth_of((0, 200, 4001), (200, 400, 5001), (400, 600, 7001))
    masks = [(0, 200, CHAIR, 0.9), (200, 400, -1, 0.8), (400, 600, BED, 0.95)]
    scores = scored(truth, *masks, class_agnostic=True)
    # The third mask lies on vertices of no class, and is ignored.
    assert aps(scores) == (1, 1, 1)
    assert list(scores.classes) == ["any"]
    assert scores.groups == {}
    assert scored(truth, *masks).overall.ap == 0


def test_a_scene_without_masks_scores_0_and_one_without_truths_has_no_score() -> None:
    assert aps(scored(truth_of((0, 200, 4001)))) == (0, 0, 0)
    assert all(math.isnan(value) for value in aps(scored(truth_of(), (0, 200, BED, 1.0))))


def test_masks_that_are_all_ignored_score_0() -> None:
    # The official script stopped here with an error before ScanNet's pull request 26.
    assert aps(scored(truth_of((0, 200, 4001)), (500, 700, BED, 1.0))) == (0, 0, 0)


def test_class_0_has_instances_from_id_1000_never_and_its_ids_below_are_ignored() -> None:
    # With a class of id 0, ids from 1 to 999 are its "groups", which the official script ignores.
    classes = ClassTable(names=("wall", "bed"), ids=(0, 4))
    matches = match_instances(truth_of((0, 200, 5), (200, 400, 4001)), masks_of((0, 200, 0, 1.0)), classes)
    assert matches.truths.tolist() == [0, 1]
    assert matches.hits.sum() == 0


# Laws


@st.composite
def scenes(draw: st.DrawFn) -> tuple[InstanceTruth, list[Mask]]:
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


def by_definition(truth: InstanceTruth, masks: Sequence[Mask], label: int, overlap: float) -> float:
    """AP of a class of one scene at one threshold from 0.5 on, where no mask lies on two truths, by sets and loops."""
    ids = sorted({number for number in truth.ids.tolist() if number // 1000 == label})
    instances = {number: set(np.flatnonzero(truth.ids == number).tolist()) for number in ids}
    void = {v for v, number in enumerate(truth.ids.tolist()) if number // 1000 not in CLASSES.ids}
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
    for number, found in owned.items():
        if number in big:
            ranked += [(score, rank == 0) for rank, score in enumerate(sorted(found, reverse=True))]
    points = [(1.0, 0.0)]
    for least in sorted({score for score, _ in ranked}, reverse=True):
        above = [hit for score, hit in ranked if score >= least]
        points.insert(0, (sum(above) / len(above), sum(above) / len(big)))
    recalls = [points[0][1], *(recall for _, recall in points), 0.0]
    return sum(p * (recalls[k] - recalls[k + 2]) / 2 for k, (p, _) in enumerate(points))


@given(scenes())
def test_every_threshold_from_a_half_follows_the_definition(scene: tuple[InstanceTruth, list[Mask]]) -> None:
    truth, masks = scene
    scores = scored(truth, *masks)
    for name, label in (("bed", BED), ("chair", CHAIR)):
        expected = [by_definition(truth, masks, label, overlap) for overlap in OVERLAPS[:-1]]
        assert scores.classes[name].ap == pytest.approx(np.mean(expected), nan_ok=True)
        assert scores.classes[name].ap50 == pytest.approx(expected[0], nan_ok=True)


@given(scenes(), st.randoms())
def test_the_order_of_masks_means_nothing_where_none_lies_on_two_truths(
    scene: tuple[InstanceTruth, list[Mask]], random: Random
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
def test_the_order_of_vertices_means_nothing(scene: tuple[InstanceTruth, list[Mask]], seed: int) -> None:
    truth, masks = scene
    order = np.random.default_rng(seed).permutation(VERTICES)
    made = masks_of(*masks)
    kept = [np.isin(order, made.mask(index)) for index in range(len(masks))]
    moved = prediction_of_masks("a", kept, made.labels.tolist(), made.scores.tolist(), num_vertices=VERTICES)
    matches = match_instances(InstanceTruth(scene="a", ids=truth.ids[order]), moved, CLASSES)
    same(scored(truth, *masks), instance_scores([matches], CLASSES))


@given(scenes())
def test_only_the_ranking_by_scores_counts(scene: tuple[InstanceTruth, list[Mask]]) -> None:
    truth, masks = scene
    same(scored(truth, *masks), scored(truth, *[(a, b, label, 5 * score - 9) for a, b, label, score in masks]))


@given(st.lists(scenes(), min_size=2, max_size=4))
def test_the_order_of_scenes_means_nothing_and_a_scene_without_anything_changes_nothing(
    parts: list[tuple[InstanceTruth, list[Mask]]],
) -> None:
    matches = [
        match_instances(InstanceTruth(scene=str(k), ids=truth.ids), masks_of(*masks, scene=str(k)), CLASSES)
        for k, (truth, masks) in enumerate(parts)
    ]
    empty = match_instances(truth_of(scene="empty"), masks_of(scene="empty"), CLASSES)
    same(instance_scores(matches, CLASSES), instance_scores([empty, *matches[::-1]], CLASSES))


def test_ids_in_a_wide_range_match_as_those_in_a_narrow_one() -> None:
    classes = ClassTable(names=("far",), ids=(2_000_000,))
    truth = truth_of((0, 200, 2_000_000_001), (200, 400, 2_000_000_002))
    masks = masks_of((0, 200, 2_000_000, 0.5), (200, 399, 2_000_000, 0.6))
    assert instance_scores([match_instances(truth, masks, classes)], classes).overall.ap == 1


def test_precision_and_recall_of_no_predictions_are_0() -> None:
    assert average_precision(np.zeros(0), np.zeros(0, bool), 3) == (0, 0)


# What is refused


def test_scenes_and_sizes_that_differ_are_refused() -> None:
    with pytest.raises(InputError, match="of the scene 'b', and the truth of 'a'"):
        match_instances(truth_of(), masks_of(scene="b"), CLASSES)
    with pytest.raises(InputError, match="2,000 vertices, and the truth 3"):
        match_instances(InstanceTruth(scene="a", ids=np.zeros(3, np.int64)), masks_of(), CLASSES)


def test_a_scene_that_is_there_twice_is_refused() -> None:
    matches = match_instances(truth_of(), masks_of(), CLASSES)
    with pytest.raises(InputError, match="the scene a is there twice"):
        instance_scores([matches, matches], CLASSES)
    with pytest.raises(InputError, match="no scene"):
        instance_scores([], CLASSES)


def test_scenes_matched_with_and_without_classes_are_not_mixed() -> None:
    first = match_instances(truth_of(), masks_of(), CLASSES)
    second = match_instances(truth_of(scene="b"), masks_of(scene="b"), CLASSES, class_agnostic=True)
    with pytest.raises(InputError, match="different classes"):
        instance_scores([first, second], CLASSES)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scores": np.array([np.nan])}, "prediction 0 has the score nan"),
        ({"scores": np.array([np.inf])}, "score inf"),
        ({"scores": np.zeros(2)}, "1 labels, 2 scores and 1 masks"),
        ({"offsets": np.array([0, 2])}, "do not divide their 3 vertices"),
        ({"vertices": np.array([1, 1, 2])}, "not ascending"),
        ({"vertices": np.array([1, 2, 9])}, "outside of the scene's 9"),
        ({"vertices": np.array([-1, 2, 3])}, "outside"),
    ],
)
def test_masks_that_contradict_themselves_are_refused(
    changes: dict[str, np.ndarray], message: str, no_jaxtyping: None
) -> None:
    good = {
        "vertices": np.array([1, 2, 3]),
        "offsets": np.array([0, 3]),
        "labels": np.array([4]),
        "scores": np.array([0.5]),
    }
    InstancePrediction(scene="a", num_vertices=9, **good)
    with pytest.raises(InputError, match=message):
        InstancePrediction(scene="a", num_vertices=9, **(good | changes))


def test_masks_of_several_and_of_no_vertices_are_taken() -> None:
    prediction = prediction_of_masks(
        "a", [np.zeros(3, bool), np.ones(3, bool), np.zeros(3, bool)], [4, 4, 4], [1.0, 2.0, 3.0], num_vertices=3
    )
    assert [prediction.mask(index).tolist() for index in range(3)] == [[], [0, 1, 2], []]
    with pytest.raises(InputError, match="mask 0 has 3 vertices, and the scene 4"):
        prediction_of_masks("a", [np.zeros(3, bool)], [4], [1.0], num_vertices=4)
