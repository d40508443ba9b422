"""The absent protocol: scores against values worked out by hand and against scikit-learn, and the choice of words."""

import math

import numpy as np
import pytest

from gsencoder.core.errors import InputError
from gsencoder.evaluate.benchmarks.absent import (
    WordPresence,
    absent_scores,
    auroc,
    auroc_standard_error,
    calibration_error,
    probabilities_by_word,
    reliability,
    words_to_ask,
)
from gsencoder.types import SceneObject


def thing(name: str | None, views: int = 9, max_pixels: int = 900, *, placed: bool = True) -> SceneObject:
    corner = np.zeros(3)
    return SceneObject(
        id=1, name=name, aabb_min=corner, aabb_max=corner + 1, placed=placed, views=views, max_pixels=max_pixels
    )


def asked(word: str, present: bool, probability: float) -> WordPresence:
    return WordPresence(word=word, present=present, probability=probability, boxed=probability >= 0.5)


def scene_of(*rows: tuple[str, bool, float]) -> tuple[WordPresence, ...]:
    return tuple(asked(*row) for row in rows)


def test_words_hardly_seen_are_neither_present_nor_absent() -> None:
    objects = [
        thing("mug"), thing("sofa", placed=False), thing("fork", views=4), thing("pen", max_pixels=59),
        thing(None),
    ]  # fmt: skip
    house = ["mug", "sofa", "fork", "pen", "lamp", "drill"]
    assert words_to_ask(objects, house) == (["mug", "sofa"], ["drill", "lamp"])
    # A word is present if any object of its name is seen well.
    assert words_to_ask([thing("mug", views=1), thing("mug")], ["mug"]) == (["mug"], [])
    assert words_to_ask(objects, house, min_views=4, min_pixels=59)[0] == ["fork", "mug", "pen", "sofa"]


def test_auroc_is_the_share_of_pairs_in_the_right_order() -> None:
    # Present 0.9, 0.4; absent 0.4, 0.1: pairs 0.9>0.4, 0.9>0.1, 0.4=0.4 (one half), 0.4>0.1, so 3.5 of 4.
    present = np.array([True, True, False, False])
    assert auroc(present, np.array([0.9, 0.4, 0.4, 0.1])) == 3.5 / 4
    assert auroc(present, np.array([0.1, 0.2, 0.3, 0.4])) == 0
    assert auroc(present, np.full(4, 0.7)) == 0.5
    assert math.isnan(auroc(present[:2], np.array([0.1, 0.2])))


def test_the_standard_error_of_the_auroc_is_the_jackknife_over_scenes() -> None:
    present = np.array([True, False] * 3)
    scene = np.array([0, 0, 1, 1, 2, 2])
    probability = np.array([0.9, 0.1, 0.8, 0.2, 0.3, 0.5])
    # Without scene 0: pairs 0.8>0.2, 0.8>0.5, 0.3>0.2, 0.3<0.5, so 3/4; without 1 the same; without 2 all, 1.
    values = np.array([0.75, 0.75, 1.0])
    expected = math.sqrt(2 / 3 * ((values - values.mean()) ** 2).sum())
    assert auroc_standard_error(present, probability, scene) == pytest.approx(expected)
    assert math.isnan(auroc_standard_error(present[:2], probability[:2], scene[:2]))


def test_the_calibration_error_averages_the_bins_by_their_words() -> None:
    # Bin 0.2–0.3: 0.2 and 0.28, mean 0.24, half present; bin 0.9–1: 0.9 and 1, mean 0.95, all present.
    present = np.array([True, False, True, True])
    probability = np.array([0.2, 0.28, 0.9, 1.0])
    assert calibration_error(present, probability) == pytest.approx((2 * 0.26 + 2 * 0.05) / 4)
    rows = reliability(present, probability)
    assert [(row["from"], row["to"], row["words"], row["present"]) for row in rows] == [
        (0.2, 0.3, 2, 0.5),
        (0.9, 1, 2, 1),
    ]
    assert [row["probability"] for row in rows] == pytest.approx([0.24, 0.95])
    assert math.isnan(calibration_error(present[:0], probability[:0]))


def test_the_scores_of_scenes_are_those_of_all_their_words() -> None:
    scenes = [scene_of(("mug", True, 0.9), ("lamp", False, 0.1)), scene_of(("lamp", True, 0.4), ("mug", False, 0.6))]
    scores = absent_scores(scenes)
    assert (scores["present"], scores["absent"]) == (2, 2)
    # Pairs: 0.9 beats both, 0.4 beats 0.1 alone.
    assert scores["auroc"] == 0.75
    assert scores["brier"] == pytest.approx((0.01 + 0.01 + 0.36 + 0.36) / 4)
    assert (scores["boxed_present"], scores["boxed_absent"]) == (0.5, 0.5)


def test_words_that_are_told_least_apart_come_first() -> None:
    scenes = [scene_of(("mug", True, 0.9), ("lamp", False, 0.1)), scene_of(("mug", False, 0.6))]
    table = probabilities_by_word(scenes)
    assert list(table) == ["mug", "lamp"]
    assert table["mug"] == {
        "present": 1, "absent": 1, "probability_present": pytest.approx(0.9), "probability_absent": pytest.approx(0.6)
    }  # fmt: skip
    assert math.isnan(table["lamp"]["probability_present"])


def test_scores_need_words_of_both_kinds() -> None:
    for present in (True, False):
        with pytest.raises(InputError, match="present and words that are absent, got"):
            absent_scores([scene_of(("mug", present, 0.5))])
