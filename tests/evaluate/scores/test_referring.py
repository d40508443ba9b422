"""Boxes of sentences: values worked out by hand, and laws."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsencoder.core.errors import InputError
from gsencoder.data.labels.expressions import Expression
from gsencoder.data.labels.files import box_ious
from gsencoder.evaluate.benchmarks.localization import aabb_iou
from gsencoder.evaluate.benchmarks.referring import (
    OTHERS,
    PredictedBoxes,
    ReferringResult,
    compare_boxes,
    named_classes,
    referring_scores,
    several_of_their_class,
    with_kinds,
)

CUBE = np.array([[0.0, 0, 0], [1, 1, 1]])
FAR = CUBE + 5


def part(share: float) -> np.ndarray:
    """A box within the cube that is a share of it."""
    return np.array([[0.0, 0, 0], [1, 1, share]])


def truth(number: int, multiple: bool | None = False, others: bool | None = False, box: bool = True) -> Expression:
    aabb = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)) if box else None
    return replace(expression(number, "x"), multiple=multiple, others=others, aabb=aabb)


def found(number: int, *boxes: np.ndarray, scene: str = "a") -> PredictedBoxes:
    return PredictedBoxes(
        scene=scene, object_id=number, annotation="0", boxes=np.array(boxes, np.float64).reshape(-1, 2, 3)
    )


def test_the_iou_has_scanrefers_epsilon() -> None:
    # A quarter of the cube: 0.25 / (1 + 0.25 - 0.25 + 1e-8).
    assert box_ious(np.array([part(0.25)]), CUBE)[0] == 0.25 / (1 + 1e-8)
    assert box_ious(np.array([CUBE, FAR, part(0)]), CUBE).tolist() == [1 / (1 + 1e-8), 0, 0]


def test_boxes_without_volume_overlap_nothing() -> None:
    flat = np.zeros((2, 3))
    assert box_ious(np.array([flat, CUBE]), flat).tolist() == [0, 0]
    # Boxes that touch have no common volume.
    assert box_ious(np.array([CUBE + 1]), CUBE).tolist() == [0]


def test_a_tie_at_a_threshold_is_below_it_for_the_epsilon() -> None:
    results = compare_boxes([found(1, part(0.25)), found(2, part(0.5))], [truth(1), truth(2)])
    cell = referring_scores(results).top1["overall"]["overall"]
    assert (cell.sentences, cell.acc25, cell.acc50) == (2, 1 / 2, 0)


def test_cells_are_those_worked_out_by_hand() -> None:
    sentences = [truth(1), truth(2, multiple=True), truth(3, multiple=True), truth(4, multiple=True, others=True)]
    predictions = [found(1, part(0.6)), found(2, part(0.3)), found(3, FAR, part(0.7)), found(4)]
    results = compare_boxes(predictions, sentences)
    scores = referring_scores(results, ks=(1, 2))
    unique, multiple, overall = (scores.top1[name] for name in ("unique", "multiple", "overall"))
    assert (unique["overall"].acc25, unique["overall"].acc50) == (1, 1)
    assert (multiple["overall"].sentences, multiple["overall"].acc25, multiple["overall"].acc50) == (3, 1 / 3, 0)
    assert (multiple["not_in_others"].sentences, multiple["not_in_others"].acc25) == (2, 1 / 2)
    assert (multiple["in_others"].sentences, multiple["in_others"].acc25) == (1, 0)
    assert (overall["overall"].acc25, overall["overall"].acc50) == (2 / 4, 1 / 4)
    assert unique["in_others"].sentences == 0
    assert math.isnan(unique["in_others"].acc25)
    # The second box of the third sentence is right.
    assert scores.best_of[1]["overall"] == overall
    for table in (scores.best_of[2], scores.best):
        assert (table["overall"]["overall"].acc25, table["overall"]["overall"].acc50) == (3 / 4, 2 / 4)
    assert scores.without_box == 1


def test_an_object_without_a_box_is_not_scored_and_a_missing_prediction_is_refused_or_wrong() -> None:
    sentences = [truth(1), truth(2, box=False), truth(3)]
    with pytest.raises(InputError, match="sentence 0 about object 3 of a has no prediction"):
        compare_boxes([found(1, CUBE)], sentences)
    results = compare_boxes([found(1, CUBE), found(2, CUBE)], sentences, allow_missing=True)
    scores = referring_scores(results)
    assert (len(results), scores.without_box) == (2, 1)
    assert scores.top1["overall"]["overall"].acc25 == 1 / 2


def test_without_sentences_there_are_no_scores() -> None:
    scores = referring_scores([])
    assert math.isnan(scores.best["overall"]["overall"].acc50)


def test_facts_that_are_not_known_leave_a_sentence_in_the_overall_cells_alone() -> None:
    results = compare_boxes([found(1, CUBE)], [truth(1, multiple=None, others=None)])
    table = referring_scores(results).top1
    counts = {(subset, kind): cell.sentences for subset, row in table.items() for kind, cell in row.items()}
    assert counts.pop(("overall", "overall")) == 1
    assert set(counts.values()) == {0}


def test_facts_of_the_prediction_are_taken_where_truth_has_none_and_refused_where_it_contradicts_them() -> None:
    prediction = PredictedBoxes(scene="a", object_id=1, annotation="0", boxes=CUBE[None], multiple=True, others=False)
    results = compare_boxes([prediction], [truth(1, multiple=None, others=None)])
    assert (results[0].multiple, results[0].others) == (True, False)
    with pytest.raises(InputError, match="object 1 of a: unique_multiple is 1 in the prediction, and 0 in the truth"):
        compare_boxes([prediction], [truth(1)])


def test_an_object_is_alone_among_the_described_objects_of_its_scene() -> None:
    # Scene a: two chairs of three sentences and one bed; scene b: one chair; others are one class in each scene.
    objects = [
        ("a", "1", "chair"),
        ("a", "1", "chair"),
        ("a", "2", "chair"),
        ("a", "3", "bed"),
        ("b", "1", "chair"),
        ("b", "2", OTHERS),
        ("b", "3", OTHERS),
    ]
    assert several_of_their_class(objects) == (True, True, True, False, False, True, True)


def test_an_object_counts_with_the_class_of_its_first_sentence() -> None:
    # Its second sentence calls the object a sofa, of which no object is one: none is not exactly one.
    assert several_of_their_class([("a", "1", "chair"), ("a", "1", "sofa")]) == (False, True)


def test_the_class_of_a_name_is_one_of_seventeen_or_others() -> None:
    ids = {"office chair": 5, "wall": 1, "floor": 2, "lamp": 35, "shelf": 15, "cart": 40, "desk": 14, "trash can": 39}
    classes = named_classes(["office_chair", "desk", *(name.replace(" ", "_") for name in ids)], ids)
    assert (classes.pop("office_chair"), classes.pop("desk")) == ("chair", "desk")
    assert set(classes.values()) == {OTHERS}
    named = named_classes([str(number) for number in range(1, 41)], {str(number): number for number in range(1, 41)})
    assert len(set(named.values()) - {OTHERS}) == 17


def expression(number: int, name: str, scene: str = "a", **stated: bool) -> Expression:
    return Expression(
        scene=scene, object_id=number, object_name=name, annotation="0", text=name, tokens=(name,), **stated
    )


def test_what_a_file_says_of_a_sentence_is_kept_and_the_rest_is_counted() -> None:
    sentences = (
        expression(1, "office_chair"),
        expression(2, "armchair"),
        expression(3, "cart", multiple=True, others=False),
        expression(1, "armchair", scene="b"),
    )
    kinds = with_kinds(sentences, {"office_chair": "chair", "armchair": "chair", "cart": OTHERS})
    assert [each.multiple for each in kinds] == [True, True, True, False]
    assert [each.others for each in kinds] == [False, False, False, False]
    assert with_kinds((), {}) == ()


BOXES = st.lists(st.lists(st.floats(-2, 2, width=32), min_size=6, max_size=6), min_size=1, max_size=5).map(
    lambda rows: np.sort(np.array(rows, np.float64).reshape(-1, 2, 3), axis=1)
)


@given(BOXES, BOXES)
def test_ious_are_those_of_boxes_but_for_the_epsilon(boxes: np.ndarray, others: np.ndarray) -> None:
    ious = box_ious(boxes, others[0])
    assert ((ious >= 0) & (ious < 1)).all()
    for box, iou in zip(boxes, ious, strict=True):
        exact = aabb_iou(*box, *others[0])
        # Both volumes are the union and the common volume: union · (1 + IoU).
        union = (np.prod(box[1] - box[0]) + np.prod(others[0][1] - others[0][0])) / (1 + exact)
        assert iou == pytest.approx(exact * union / (union + 1e-8), rel=1e-9, abs=1e-12)


Row = tuple[list[float], bool, bool]
ROWS = st.lists(st.tuples(st.lists(st.floats(0, 1), max_size=4), st.booleans(), st.booleans()), min_size=1, max_size=20)


def results_of(rows: list[Row]) -> list[ReferringResult]:
    return [
        ReferringResult(scene="a", object_id=k, annotation="0", ious=tuple(ious), multiple=multiple, others=others)
        for k, (ious, multiple, others) in enumerate(rows)
    ]


@given(ROWS)
def test_the_best_of_more_boxes_is_no_worse_and_cells_add_up(rows: list[Row]) -> None:
    scores = referring_scores(results_of(rows), ks=(1, 2, 9))
    tables = [scores.top1, scores.best_of[2], scores.best]
    accuracies = [table["overall"]["overall"].acc50 for table in tables]
    assert accuracies == sorted(accuracies)
    for table in tables:
        for row in table.values():
            assert row["overall"].sentences == row["in_others"].sentences + row["not_in_others"].sentences
    first = [scores.best_of[1]["overall"]["overall"], scores.best_of[9]["overall"]["overall"]]
    assert first == [scores.top1["overall"]["overall"], scores.best["overall"]["overall"]]


@given(ROWS)
def test_the_order_of_sentences_means_nothing(rows: list[Row]) -> None:
    results = results_of(rows)
    first, second = referring_scores(results), referring_scores(results[::-1])
    for kind in ("in_others", "overall"):
        pair = [
            (scores.top1["multiple"][kind].acc25, scores.top1["multiple"][kind].acc50) for scores in (first, second)
        ]
        assert pair[0] == pytest.approx(pair[1], nan_ok=True)


@pytest.mark.parametrize(
    ("predictions", "sentences", "message"),
    [
        ([found(7, CUBE)], [truth(1)], "sentence 0 about object 7 of a is predicted, and not in the truth"),
        ([found(1, CUBE, scene="b")], [truth(1)], "object 1 of b is predicted, and not in the truth"),
    ],
)
def test_predictions_that_do_not_belong_to_the_truth_are_refused(
    predictions: list[PredictedBoxes], sentences: list[Expression], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        compare_boxes(predictions, sentences, allow_missing=True)


def test_the_best_of_five_boxes_is_scored_where_nothing_else_is_asked_for() -> None:
    results = compare_boxes([found(1, FAR, FAR, FAR, FAR, CUBE), found(2, *[FAR] * 5, CUBE)], [truth(1), truth(2)])
    scores = referring_scores(results)
    assert {k: table["overall"]["overall"].acc50 for k, table in scores.best_of.items()} == {5: 1 / 2}
    assert (scores.top1["overall"]["overall"].acc25, scores.best["overall"]["overall"].acc25) == (0, 1)
