"""Limits, ties and orders of the scores of instances, labels and recognized objects, worked out by hand."""

import math

import numpy as np
import pytest

from gsencoder.core.errors import InputError
from gsencoder.data.labels.classes import ClassTable
from gsencoder.evaluate.benchmarks.instances import (
    average_precision,
    instance_scores,
    match_instances,
    prediction_of_masks,
)
from gsencoder.evaluate.benchmarks.recognition import NamedInstance, RankedNames, recognition_scores, recognize
from gsencoder.evaluate.benchmarks.semantics import count_labels, semantic_scores

CLASSES = ClassTable(names=("bed", "chair"), ids=(4, 5), groups={"head": ("chair",), "tail": ("bed",)})


def matched(ids: list[tuple[int, int]], masks: list[tuple[int, int, int, float]], **options: bool) -> object:
    """Runs of ids, and masks by first vertex, end, class and score."""
    truth = np.concatenate([np.full(count, number) for number, count in ids])
    rows = np.arange(len(truth))
    made = prediction_of_masks(
        "s",
        [(rows >= first) & (rows < last) for first, last, _, _ in masks],
        [label for _, _, label, _ in masks],
        [score for _, _, _, score in masks],
        num_vertices=len(truth),
    )
    return match_instances(truth, made, CLASSES, **options)


def test_a_truth_of_a_smaller_id_chooses_first_whatever_the_scores_are() -> None:
    # P lies on both beds by 120 / 240 at least: a third of 160 and 100 vertices more.
    pairs = matched([(4001, 100), (4002, 100), (0, 50)], [(40, 160, 4, 0.1), (0, 100, 4, 0.9)])
    quarter = pairs.thresholds == 9  # type: ignore[attr-defined]
    # The first bed takes P, which is listed first, and the higher score is that of the match; the other is wrong.
    assert sorted(zip(pairs.outcome_scores[quarter], pairs.hits[quarter], strict=True)) == [(0.1, False), (0.9, True)]  # type: ignore[attr-defined]


def test_groups_that_are_small_and_of_no_class_are_counted_twice_as_in_scannets_script() -> None:
    # With a class of id 0, ids from 1 to 999 are groups of it. 60 of 200 vertices of a mask are on a small one: a share
    # of 0.3 counted once, and 0.6 counted twice, which is above 0.5.
    classes = ClassTable(names=("wall", "bed"), ids=(0, 4))
    truth = np.concatenate([np.full(60, 7), np.full(140, 4001), np.full(300, 4002)])
    made = prediction_of_masks("s", [np.arange(500) < 200], [0], [0.9], num_vertices=500)
    matches = match_instances(truth, made, classes)
    # False from 0.6 on, the third of nine thresholds: 0.5 and 0.55 ignore it, and so does 0.25.
    assert matches.thresholds[~matches.hits].tolist() == [2, 3, 4, 5, 6, 7, 8]


def test_ids_far_apart_are_counted_as_those_that_are_near() -> None:
    near = matched([(4001, 150), (5001, 150), (0, 20)], [(0, 140, 4, 0.5), (150, 290, 5, 0.6)])
    far = matched([(4001, 150), (5001, 150), (1 << 40, 20)], [(0, 140, 4, 0.5), (150, 290, 5, 0.6)])
    for name in ("instances", "hits", "outcome_scores", "rows", "thresholds"):
        assert np.array_equal(getattr(near, name), getattr(far, name))


def test_two_scenes_are_ranked_together_and_groups_take_their_own_classes() -> None:
    ids = np.repeat([4001, 5001], [200, 200])
    rows = np.arange(400)
    scenes = []
    for scene, score in (("a", 0.9), ("b", 0.1)):
        # The bed of each scene is right; the chair's mask of b is on the bed, and wrong.
        masks = [rows < 200, (rows < 190) if scene == "b" else (rows >= 200)]
        made = prediction_of_masks(scene, masks, [4, 5], [score, 0.5], num_vertices=400)
        scenes.append(match_instances(ids, made, CLASSES))
    scores = instance_scores(scenes, CLASSES)
    # Chairs: one right and one wrong of one score, of two: precision 1/2, 1, recall 1/2, 0, steps 1/4: 3/8.
    assert (scores.groups["tail"].ap50, scores.groups["head"].ap50) == (1, pytest.approx(3 / 8))
    assert (scores.classes["bed"].ap25, scores.overall.ap) == (1, pytest.approx((1 + 3 / 8) / 2))
    assert (scores.instances.tolist(), scores.predictions.tolist(), scores.equal_scores) == ([2, 2], [2, 2], False)


def test_precision_is_taken_at_each_score_from_the_lowest() -> None:
    # Hits at 0.9, 0.7 and 0.5, wrong at 0.8 and 0.6, of four truths. From the lowest score: precision 3/5, 2/4, 2/3,
    # 1/2, 1, and 1; recall 3/4, 1/2, 1/2, 1/4, 1/4, 0.
    scores, hits = np.array([0.5, 0.9, 0.6, 0.8, 0.7]), np.array([True, True, False, False, True])
    ap = average_precision(scores, hits, 4)
    assert ap == pytest.approx((3 / 5 + 2 / 4 + 2 / 3 + 1 / 2 + 1 + 1) / 8)


def test_the_precision_of_no_predictions_is_0() -> None:
    assert average_precision(np.zeros(0), np.zeros(0, bool), 3) == 0


def test_sizes_that_differ_and_scores_that_are_not_finite_are_refused() -> None:
    made = prediction_of_masks("a", [], [], [], num_vertices=4)
    with pytest.raises(InputError, match="a: the masks have 4 vertices, and the truth 3"):
        match_instances(np.zeros(3, np.int64), made, CLASSES)
    for score in (math.nan, -math.inf):
        with pytest.raises(InputError, match="prediction 1 has the score"):
            prediction_of_masks("a", np.ones((2, 3), bool), [4, 4], [0.5, score], num_vertices=3)


def test_masks_begin_anew_and_may_be_empty() -> None:
    rows = np.array([[True, False, True], [False] * 3, [True, True, False]])
    made = prediction_of_masks("s", rows, [4, 5, 4], [0.1, 0.2, 0.3], num_vertices=3)
    assert [made.masks[row].tolist() for row in range(3)] == [[0, 2], [], [0, 1]]
    with pytest.raises(InputError, match="mask 0 has 3 vertices, and the scene 4"):
        prediction_of_masks("s", rows, [4, 5, 4], [0.1, 0.2, 0.3], num_vertices=4)


# Recognition and labels


def test_places_count_from_one_and_other_classes_are_counted_beside() -> None:
    truth = [NamedInstance(scene="s", object=str(k), name=name) for k, name in enumerate(("a", "b", "a", "z"))]
    ranked_names = [("b", "a"), (), ("a",)]
    ranked = [RankedNames(scene="s", object=str(k), names=names) for k, names in enumerate(ranked_names)]
    results, others = recognize(ranked, truth, ["a", "b"])
    assert [(each.rank, each.answered) for each in results] == [(2, True), (0, False), (1, True)]
    assert others == 1
    scores = recognition_scores(results, ["b", "a"], ks=(1, 2))
    assert scores.overall == {1: pytest.approx(1 / 3), 2: pytest.approx(2 / 3)}
    assert (scores.classes[2], scores.mean[2], scores.unanswered) == ({"b": 0, "a": 1}, 1 / 2, 1)
    with pytest.raises(InputError, match="object 1 of s has no prediction"):
        recognize(ranked[:1], truth, ["a", "b"])
    assert recognize(ranked[:1], truth, ["a", "b"], allow_missing=True)[0][1].rank == 0


def test_the_ceiling_is_of_the_background_and_no_class_is_of_none() -> None:
    classes = ClassTable(names=("ceiling", "bed", "floor", "lamp"), ids=(22, 4, 2, 9))
    truth, labels = np.array([22, 4, 4, 2, 9]), np.array([22, 4, 22, 2, 77])
    scores = semantic_scores([count_labels("s", truth, labels, classes)], classes)
    assert scores.foreground.miou == pytest.approx((1 / 2 + 0) / 2)
    assert {name: (each.truths, each.predictions) for name, each in scores.classes.items()} == {
        "ceiling": (1, 2),
        "bed": (2, 1),
        "floor": (1, 1),
        "lamp": (1, 0),
    }
    # A class that is there and never predicted counts among those in truth.
    assert scores.overall.miou_present == pytest.approx((1 / 2 + 1 / 2 + 1 + 0) / 4)
