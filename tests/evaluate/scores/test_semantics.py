"""Scores of labels of vertices: values worked out by hand, and scikit-learn's."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.metrics import accuracy_score, jaccard_score, recall_score

from gsencoder.data.labels.classes import ClassTable
from gsencoder.evaluate.benchmarks.semantics import LabelCounts, SemanticScores, count_labels, semantic_scores

CLASSES = ClassTable(names=("wall", "bed", "chair", "sofa"), ids=(1, 4, 5, 6))
WALL, BED, CHAIR, SOFA = CLASSES.ids


def counts(truth: list[int], predicted: list[int], scene: str = "a") -> LabelCounts:
    return count_labels(scene, np.array(truth, np.int64), np.array(predicted, np.int64), CLASSES)


def scored(truth: list[int], predicted: list[int]) -> SemanticScores:
    return semantic_scores([counts(truth, predicted)], CLASSES)


def test_without_vertices_that_count_there_are_no_scores() -> None:
    for truth, predicted in (([], []), ([0, 77], [BED, SOFA])):
        scores = scored(truth, predicted)
        assert all(math.isnan(value) for value in scores.figures.values())
        assert scores.ignored == len(truth)


LABELS = st.lists(st.tuples(st.sampled_from([1, 4, 5, 6, 0]), st.sampled_from([1, 4, 5, 6, 0])), min_size=1)


@settings(max_examples=25)
@given(LABELS)
def test_scores_are_those_of_scikit_learn(pairs: list[tuple[int, int]]) -> None:
    scores = scored([true for true, _ in pairs], [predicted for _, predicted in pairs])
    with_class = [(true, predicted) for true, predicted in pairs if true]
    if not with_class:
        assert math.isnan(scores.figures["miou"])
        return
    truth, predicted = zip(*with_class, strict=True)
    seen = sorted({label for pair in with_class for label in pair if label})
    there = sorted(set(truth))
    iou = jaccard_score(truth, predicted, labels=seen, average="macro", zero_division=0)
    present = jaccard_score(truth, predicted, labels=there, average="macro", zero_division=0)
    assert scores.figures["miou"] == pytest.approx(iou)
    assert scores.figures["miou_present"] == pytest.approx(present)
    assert scores.figures["macc"] == pytest.approx(recall_score(truth, predicted, labels=there, average="macro"))
    assert scores.figures["accuracy"] == pytest.approx(accuracy_score(truth, predicted))


@settings(max_examples=25)
@given(LABELS, st.integers(0, 100))
def test_scenes_scored_together_are_one_long_scene_in_any_order(pairs: list[tuple[int, int]], cut: int) -> None:
    truth, predicted = ([pair[side] for pair in pairs] for side in (0, 1))
    parts = [counts(truth[:cut], predicted[:cut], "a"), counts(truth[cut:], predicted[cut:], "b")]
    whole = scored(truth, predicted)
    for scenes in (parts, parts[::-1]):
        together = semantic_scores(scenes, CLASSES)
        assert together.figures["miou"] == pytest.approx(whole.figures["miou"], nan_ok=True)
        assert together.figures["f_macc"] == pytest.approx(whole.figures["f_macc"], nan_ok=True)


def test_the_ceiling_is_of_the_background_and_no_class_is_of_none() -> None:
    classes = ClassTable(names=("ceiling", "bed", "floor", "lamp"), ids=(22, 4, 2, 9))
    truth, labels = np.array([22, 4, 4, 2, 9]), np.array([22, 4, 22, 2, 77])
    scores = semantic_scores([count_labels("s", truth, labels, classes)], classes)
    assert scores.figures["f_miou"] == pytest.approx((1 / 2 + 0) / 2)
    assert {name: (each["truths"], each["predictions"]) for name, each in scores.classes.items()} == {
        "ceiling": (1, 2), "bed": (2, 1), "floor": (1, 1), "lamp": (1, 0),
    }  # fmt: skip
    # A class that is there and never predicted counts among those in truth.
    assert scores.figures["miou_present"] == pytest.approx((1 / 2 + 1 / 2 + 1 + 0) / 4)
