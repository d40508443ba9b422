"""Where selections start, and what the settings do to it."""

import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from selected_rooms import EMBEDDINGS, selected_room, words

from gsencoder.core.errors import InputError
from gsencoder.infer import select as module
from gsencoder.infer.localize import LocalizeConfig
from gsencoder.infer.select import Candidates, Parts, SelectConfig, box_parts, select, threshold_parts
from gsencoder.types import Box, Localization, Scene

SCENE, KINDS = selected_room()
LIKELY = (0.8, 0.4, 0.39)


def box(rank: int, word: str = "mug") -> Box:
    """A box of two Gaussians, the larger row first."""
    none = np.zeros(3)
    return Box(
        query=word,
        rank=rank,
        score=1.0 - rank,
        probability=LIKELY[rank],
        aabb_min=none,
        aabb_max=none,
        obb_center=none,
        obb_rotation=np.eye(3),
        obb_size=none,
        rows=np.array([2 * rank + 1, 2 * rank]),
    )


FOUND = Localization(
    queries=("mug", "book"),
    relevancy=np.zeros((2, 8), np.float32),
    thresholds=np.zeros(2, np.float32),
    probabilities=np.array([0.8, 0.1], np.float32),
    boxes=tuple(box(rank) for rank in range(3)),
)


def rows_of(parts: Parts) -> list[list[list[int]]]:
    return [[rows.tolist() for rows in groups] for groups in parts]


def test_boxes_that_are_nearly_as_probable_as_the_best_are_taken() -> None:
    assert rows_of(box_parts(FOUND, ())) == [[[0, 1], [2, 3]], []]


def test_boxes_that_are_asked_for_by_number_are_taken_once_whatever_their_probability() -> None:
    mug = Localization(
        queries=("mug",),
        relevancy=FOUND.relevancy[:1],
        thresholds=FOUND.thresholds[:1],
        probabilities=FOUND.probabilities[:1],
        boxes=FOUND.boxes,
    )
    assert rows_of(box_parts(mug, (2, 0, 2))) == [[[4, 5], [0, 1]]]
    with pytest.raises(InputError, match="box=3: 'mug' has 3 boxes, 0 to 2$"):
        box_parts(mug, (0, 3))
    with pytest.raises(InputError, match="box=0: 'book' has no box: absent"):
        box_parts(FOUND, (0,))


def test_a_threshold_takes_what_reaches_it_and_no_part_of_a_word_that_nothing_reaches() -> None:
    relevancy = np.array([[0.5, 0.49, np.nan, 0.9], [0.1, np.nan, 0.2, -1.0]], np.float32)
    assert rows_of(threshold_parts(("a", "b"), relevancy, 0.5)) == [[[0, 3]], []]
    with pytest.raises(InputError, match=r"threshold=0.95: .* the best are 'a' 0.9, 'b' 0.2$"):
        threshold_parts(("a", "b"), relevancy, 0.95)
    with pytest.raises(InputError, match=r"the best are 'a' nan$"):
        threshold_parts(("a",), np.full((1, 2), np.nan, np.float32), 0.5)


def test_parts_of_several_words_share_no_gaussian_when_they_grow(monkeypatch: pytest.MonkeyPatch) -> None:
    grown: list[Parts] = []
    by_features = module.labels_by_features

    def recording(*arguments: Any) -> Candidates:
        grown.append(arguments[2])
        return by_features(*arguments)

    monkeypatch.setattr(module, "labels_by_features", recording)
    selection, localization = select(SCENE, ("mug", "table"), words(), threshold=0.0)
    assert (localization.relevancy >= 0.0).all(axis=0).any()  # The rims are both.
    for number, groups in enumerate(grown[0]):
        for rows in groups:
            assert (selection.seeds[rows] == number + 1).all()
    assert sum(len(rows) for groups in grown[0] for rows in groups) == np.count_nonzero(selection.seeds)


def two_mugs() -> Scene:
    """The scene with a second mug, paler than the first, in place of the book."""
    features = SCENE.features["names"]
    vectors = features.features.copy()
    vectors[KINDS == 1] = 0.8 * EMBEDDINGS[0] + 0.2 * EMBEDDINGS[2]
    return replace(SCENE, features={"names": replace(features, features=vectors)})


@pytest.mark.parametrize(("probable", "kinds"), [(0.0, {0, 1}), (1.0, {0})])
def test_of_two_mugs_the_more_probable_one_or_both_are_taken(
    monkeypatch: pytest.MonkeyPatch, probable: float, kinds: set[int]
) -> None:
    monkeypatch.setattr(module, "PROBABLE", probable)
    selection, localization = select(two_mugs(), ("mug",), words())
    likely = [each.probability for each in localization.boxes]
    assert likely == sorted(set(likely), reverse=True)
    assert set(KINDS[selection.labels == 1]) == kinds


def test_seeds_are_the_labels_before_they_grew() -> None:
    grown, _ = select(SCENE, ("mug", "book"), words(), threshold=0.9)
    start, _ = select(SCENE, ("mug", "book"), words(), SelectConfig(grow=False), threshold=0.9)
    assert (grown.seeds == start.labels).all()
    assert (grown.seeds != grown.labels).any()


@pytest.mark.filterwarnings("ignore:.*words have no box")
def test_settings_of_boxes_are_those_that_are_given() -> None:
    with pytest.raises(InputError, match="no Gaussian of table is selected"):
        select(SCENE, ("mug",), words(), localization=LocalizeConfig(min_weight=1e30))


@pytest.mark.filterwarnings("ignore:.*words have no box")
def test_cameras_are_placed_only_where_something_was_found() -> None:
    bare = replace(SCENE, views=None)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*has no views")
        with pytest.raises(InputError, match="no Gaussian of table is selected"):
            select(bare, ("lamp",), words())
