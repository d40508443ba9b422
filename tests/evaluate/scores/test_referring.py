"""Boxes of sentences: values worked out by hand, and laws."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
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


def truth(number: int, multiple: bool | None = False, others: bool | None = False) -> Expression:
    aabb = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    return replace(expression(number, "x"), multiple=multiple, others=others, aabb=aabb)


def found(number: int, *boxes: np.ndarray) -> PredictedBoxes:
    rows = np.array(boxes, np.float64).reshape(-1, 2, 3)
    return PredictedBoxes(scene="a", object_id=number, annotation="0", boxes=rows)


def test_the_iou_has_scanrefers_epsilon() -> None:
    # A quarter of the cube: 0.25 / (1 + 0.25 - 0.25 + 1e-8).
    assert box_ious(np.array([part(0.25)]), CUBE)[0] == 0.25 / (1 + 1e-8)
    # Boxes without volume overlap nothing, and those that touch have no common volume.
    assert box_ious(np.array([CUBE, FAR, part(0), CUBE + 1]), CUBE).tolist() == [1 / (1 + 1e-8), 0, 0, 0]
    assert box_ious(np.array([part(0)]), part(0)).tolist() == [0]


def test_a_tie_at_a_threshold_is_below_it_for_the_epsilon() -> None:
    results = compare_boxes([found(1, part(0.25)), found(2, part(0.5))], [truth(1), truth(2)])
    assert referring_scores(results)["overall"]["overall"] == {"sentences": 2, "acc25": 1 / 2, "acc50": 0}


def test_cells_are_those_worked_out_by_hand() -> None:
    sentences = [truth(1), truth(2, multiple=True), truth(3, multiple=True), truth(4, multiple=True, others=True)]
    predictions = [found(1, part(0.6)), found(2, part(0.3)), found(3, FAR, part(0.7)), found(4)]
    results = compare_boxes(predictions, sentences)
    unique, multiple, overall = (referring_scores(results)[name] for name in ("unique", "multiple", "overall"))
    assert unique["overall"] == {"sentences": 1, "acc25": 1, "acc50": 1}
    assert multiple["overall"] == {"sentences": 3, "acc25": 1 / 3, "acc50": 0}
    assert multiple["not_in_others"] == {"sentences": 2, "acc25": 1 / 2, "acc50": 0}
    assert multiple["in_others"] == {"sentences": 1, "acc25": 0, "acc50": 0}
    assert overall["overall"] == {"sentences": 4, "acc25": 2 / 4, "acc50": 1 / 4}
    assert unique["in_others"]["sentences"] == 0
    assert math.isnan(unique["in_others"]["acc25"])
    # The second box of the third sentence is right.
    for k in (2, None):
        assert referring_scores(results, k)["overall"]["overall"] == {"sentences": 4, "acc25": 3 / 4, "acc50": 2 / 4}


def test_facts_that_are_not_known_leave_a_sentence_in_the_overall_cells_alone() -> None:
    results = compare_boxes([found(1, CUBE)], [truth(1, multiple=None, others=None)])
    table = referring_scores(results)
    counts = {(subset, kind): cell["sentences"] for subset, row in table.items() for kind, cell in row.items()}
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
        ("a", "1", "chair"), ("a", "1", "chair"), ("a", "2", "chair"), ("a", "3", "bed"), ("b", "1", "chair"),
        ("b", "2", OTHERS), ("b", "3", OTHERS),
    ]  # fmt: skip
    assert several_of_their_class(objects) == (True, True, True, False, False, True, True)
    # An object counts with the class of its first sentence: of the second's, none is not exactly one.
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
        expression(1, "office_chair"), expression(2, "armchair"),
        expression(3, "cart", multiple=True, others=False), expression(1, "armchair", scene="b"),
    )  # fmt: skip
    kinds = with_kinds(sentences, {"office_chair": "chair", "armchair": "chair", "cart": OTHERS})
    assert [each.multiple for each in kinds] == [True, True, True, False]
    assert [each.others for each in kinds] == [False, False, False, False]
    assert with_kinds((), {}) == ()


BOXES = st.lists(st.lists(st.floats(-2, 2, width=32), min_size=6, max_size=6), min_size=1, max_size=5).map(
    lambda rows: np.sort(np.array(rows, np.float64).reshape(-1, 2, 3), axis=1)
)


@settings(max_examples=25)
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


@settings(max_examples=25)
@given(ROWS)
def test_the_best_of_more_boxes_is_no_worse_and_cells_add_up(rows: list[Row]) -> None:
    results = [
        ReferringResult(scene="a", object_id=k, annotation="0", ious=tuple(ious), multiple=multiple, others=others)
        for k, (ious, multiple, others) in enumerate(rows)
    ]
    tables = [referring_scores(results, k) for k in (1, 2, None)]
    accuracies = [table["overall"]["overall"]["acc50"] for table in tables]
    assert accuracies == sorted(accuracies)
    for table in tables:
        for row in table.values():
            assert row["overall"]["sentences"] == row["in_others"]["sentences"] + row["not_in_others"]["sentences"]
    assert referring_scores(results, 9) == tables[2]
