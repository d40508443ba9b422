"""Recognition of given objects: values worked out by hand, and scikit-learn's."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.metrics import recall_score, top_k_accuracy_score

from gsencoder.core.errors import InputError
from gsencoder.evaluate.benchmarks.recognition import ObjectKey, RankedNames, recognition_scores, recognize

CLASSES = ("bed", "chair", "sofa")


def labels_of(*names: str) -> dict[ObjectKey, str]:
    return {("a", str(number)): name for number, name in enumerate(names, start=1)}


def answers_of(**ranked: str) -> dict[ObjectKey, tuple[str, ...]]:
    """Names by the number of an object of scene a, after an x."""
    return {("a", number[1:]): tuple(names.split()) for number, names in ranked.items()}


TRUTH = labels_of("bed", "bed", "bed", "chair")


def test_instances_of_other_classes_are_not_scored_and_no_answer_is_wrong() -> None:
    truth = labels_of("bed", "bed", "bed", "chair", "dog")
    answers = answers_of(x1="", x2="bed", x3="bed", x4="chair")
    results = recognize(answers, truth, CLASSES)
    assert [each.answered for each in results] == [False, True, True, True]
    assert recognize(answers | answers_of(x5="bed"), truth, CLASSES) == results
    scores = recognition_scores(results, CLASSES)
    assert scores.overall[1] == scores.overall[5] == 3 / 4


def test_a_missing_prediction_is_refused_or_wrong() -> None:
    with pytest.raises(InputError, match="object 2 of a has no prediction"):
        recognize(answers_of(x1="bed"), TRUTH, CLASSES)
    results = recognize(answers_of(x1="bed"), TRUTH, CLASSES, allow_missing=True)
    assert [each.answered for each in results] == [True, False, False, False]


RANKINGS = st.lists(st.tuples(st.sampled_from(CLASSES), st.permutations(CLASSES)), min_size=1, max_size=30)


@settings(max_examples=25)
@given(RANKINGS)
def test_scores_are_those_of_scikit_learn(rows: list[tuple[str, list[str]]]) -> None:
    truth = labels_of(*(name for name, _ in rows))
    results = recognize({key: tuple(names) for key, (_, names) in zip(truth, rows, strict=True)}, truth, CLASSES)
    scores = recognition_scores(results, CLASSES, ks=(1, 2, 3))
    names = [name for name, _ in rows]
    points = np.array([[-ranked.index(name) for name in CLASSES] for _, ranked in rows])
    assert scores.overall[2] == pytest.approx(top_k_accuracy_score(names, points, k=2, labels=CLASSES))
    firsts = [ranked[0] for _, ranked in rows]
    expected = recall_score(names, firsts, labels=sorted(set(names)), average="macro", zero_division=0)
    assert scores.mean[1] == pytest.approx(expected)
    assert scores.mean[3] == 1


@pytest.mark.parametrize(
    ("answers", "message"),
    [
        ({("b", "1"): ("bed",)}, "object 1 of b is predicted, and not in the truth"),
        (answers_of(x1="Bed"), "predicted as 'Bed', which is no class"),
        (answers_of(x1="bed bed"), "object 1 of a has a name twice"),
    ],
)
def test_predictions_that_do_not_belong_to_the_truth_are_refused(answers: RankedNames, message: str) -> None:
    with pytest.raises(InputError, match=message):
        recognize(answers, TRUTH, CLASSES, allow_missing=True)
