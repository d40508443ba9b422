"""Average precision of instances: values worked out by hand."""

import math

import pytest
from instance_scenes import BED, CHAIR, SOFA, aps, masks_of, scored, truth_of

from gsencoder.data.labels.classes import ClassTable
from gsencoder.evaluate.benchmarks.instances import OVERLAPS, match_instances


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
    assert matches.instances.tolist() == [0, 1]
    assert matches.hits.sum() == 0
