"""How selections grow: labels by features, by the pixels of views, and by what lies around, on cases made by hand."""

import numpy as np
import pytest
from feature_fields import plain_features
from selected_rooms import SPACE

from gsencoder.infer.select import (
    NO_SHARE,
    Candidates,
    Labels,
    Parts,
    SelectConfig,
    Votes,
    labels_by_features,
    labels_by_pixels,
    labels_of_hidden,
)
from gsencoder.types import GaussianFeatures

USUAL = (1.0, 10.0, 10.0, 10.0, 100.0)
"""Weight of the Gaussians of an object on its pixels; their median is 10."""


def label_of(
    label: int, share: float, *, seen: bool, present: tuple[float, float], removed: tuple[float, float]
) -> int:
    """The label by pixels of one Gaussian that could be of an object of five others."""
    count = len(USUAL) + 1
    candidates = Candidates(
        labels=np.array([1] * len(USUAL) + [label], np.int32),
        possible=np.ones(count, np.int32),
        shares=np.array([1.0] * len(USUAL) + [share]),
    )
    votes = Votes(
        present=np.array([*((0.0, weight) for weight in USUAL), present], np.float32),
        removed=np.array([*((0.0, 0.0) for _ in USUAL), removed], np.float32),
    )
    known = np.array([True] * len(USUAL) + [seen])
    labels = labels_by_pixels(candidates, known, votes, SelectConfig())
    assert (labels[:-1] == 1).all()
    return int(labels[-1])


NOTHING = (0.0, 0.0)


@pytest.mark.parametrize(
    ("share", "present", "removed", "expected"),
    [
        (0.4, (0.5, 9.5), NOTHING, 1),  # partly the object, and before its pixels alone
        (0.4, (1.5, 8.5), NOTHING, 0),  # as much, but beside them, too
        (0.34, (0.0, 10.0), NOTHING, 0),  # less than 0.7 times the share
        (0.4, NOTHING, NOTHING, 0),  # shown by no view
        (0.4, (9.0, 1.0), (2.0, 12.0), 1),  # a ghost
        (0.4, (9.0, 1.0), (2.0, 8.0), 0),  # fainter than the Gaussians of the object
        (0.4, (9.0, 1.0), (14.0, 12.0), 0),  # mostly seen elsewhere
    ],
)
def test_what_is_partly_object_is_taken_where_pixels_show_it_or_would_show_its_ghost(share, present, removed, expected):
    assert label_of(0, share, seen=True, present=present, removed=removed) == expected


@pytest.mark.parametrize(("present", "expected"), [((9.5, 0.5), 0), ((8.0, 2.0), 1), (NOTHING, 1)])
def test_what_was_taken_is_lost_only_if_its_pixels_are_of_something_else(present, expected):
    assert label_of(1, 1.0, seen=True, present=present, removed=NOTHING) == expected


@pytest.mark.parametrize(
    ("label", "present", "removed", "expected"),
    [
        (0, (4.0, 6.0), NOTHING, 1),
        (0, (6.0, 4.0), (0.0, 10.0), 0),  # what is shown now decides
        (0, NOTHING, (4.0, 6.0), 1),
        (0, NOTHING, (6.0, 4.0), 0),
        (0, NOTHING, NOTHING, 0),
        (1, (6.0, 4.0), NOTHING, 0),
        (1, (4.0, 6.0), NOTHING, 1),
    ],
)
def test_without_a_feature_more_than_half_of_the_weight_decides(label, present, removed, expected):
    assert label_of(label, NO_SHARE, seen=False, present=present, removed=removed) == expected


def line(count: int) -> np.ndarray:
    return np.arange(count, dtype=np.float64)[:, None] * [1.0, 0.0, 0.0]


def hidden(places: np.ndarray, labels: list[int], possible: list[int], unknown: list[int]) -> list[int]:
    """Labels of Gaussians with a spacing of 1, of which those of `unknown` are hidden."""
    mask = np.isin(np.arange(len(labels)), unknown)
    made = labels_of_hidden(
        places.astype(np.float32), np.array(labels, np.int32), np.array(possible, np.int32), mask, spacing=1.0
    )
    return [int(label) for label in made]


def test_what_is_hidden_has_the_label_of_most_of_its_eight_neighbors() -> None:
    places = line(9)
    assert hidden(places, [1] * 5 + [0] * 3 + [0], [1] * 9, [8])[-1] == 1
    # Half of them are not most.
    assert hidden(places, [1] * 4 + [0] * 4 + [0], [1] * 9, [8])[-1] == 0
    # What it had by itself does not count,
    assert hidden(places, [0] * 8 + [1], [1] * 9, [8])[-1] == 0
    # nor a word that is out of reach,
    assert hidden(places, [1] * 8 + [0], [1] * 8 + [0], [8])[-1] == 0
    # and of two words that which is within reach.
    assert hidden(places, [2] * 8 + [0], [2] * 8 + [1], [8])[-1] == 0


def test_what_is_hidden_has_no_label_where_the_nearest_known_one_is_farther_than_two_spacings() -> None:
    for distance, label in ((1.9, 1), (2.1, 0)):
        places = np.concatenate([line(8), [[7 + distance, 0, 0]]])
        assert hidden(places, [1] * 8 + [0], [1] * 9, [8])[-1] == label


def plate(side: int = 24) -> np.ndarray:
    """Points on a square grid with a step of 1, a little off it."""
    grid = np.stack(np.meshgrid(np.arange(side), np.arange(side), [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
    return grid + np.random.default_rng(4).normal(size=grid.shape) * 0.01


def by_features(
    places: np.ndarray, features: GaussianFeatures, parts: Parts, relevancy: np.ndarray, **settings: float
) -> tuple[Labels, Labels]:
    config = SelectConfig(**settings)  # type: ignore[arg-type]
    means = places.astype(np.float32)
    made = labels_by_features(features, means, parts, relevancy.astype(np.float32), config, 1.0)
    return made.labels, made.possible


def test_a_share_that_is_equal_to_the_limit_is_not_taken() -> None:
    places = plate()
    object_, rim = places[:, 0] < 10.5, (places[:, 0] > 10.5) & (places[:, 0] < 11.5)
    vectors = np.where(object_[:, None], np.eye(8)[0], np.eye(8)[1])
    vectors[rim] = (np.eye(8)[0] + np.eye(8)[1]) / 2
    # The rim is as near to the object as a spacing, so that it is no surroundings.
    places[rim, 0] = places[object_ & (places[:, 0] > 9.5), 0] + 0.9
    parts = ((np.flatnonzero(object_),),)
    members, possible = by_features(places, plain_features(vectors, SPACE), parts, vectors[None, :, 0], share=0.5)
    assert (possible[rim] == 1).all()
    assert (members[object_] == 1).all()
    assert not members[rim].any()
    members, _ = by_features(places, plain_features(vectors, SPACE), parts, vectors[None, :, 0], share=0.49)
    assert (members[rim] == 1).all()


def test_what_has_no_feature_could_be_of_the_first_of_the_words_within_reach() -> None:
    places = plate()
    left, right = places[:, 0] < 7.5, places[:, 0] > 14.5
    vectors = np.eye(8)[np.where(left, 0, np.where(right, 1, 2))]
    blind = np.abs(places - [11, 11, 0]).max(axis=1) < 0.5
    parts = ((np.flatnonzero(left),), (np.flatnonzero(right),))
    features = plain_features(vectors, SPACE, ~blind)
    for order in ([0, 1], [1, 0]):
        members, possible = by_features(
            places, features, tuple(parts[each] for each in order), vectors[:, order].T, reach=5.0
        )
        assert possible[blind].tolist() == [1]
        assert members[blind].tolist() == [0]


def test_all_boxes_of_a_word_are_one_object_whose_inside_stays() -> None:
    """A stain with the feature of the table, in the middle of an object that was found as two boxes."""
    places = plate()
    one = (np.abs(places[:, 1] - 11.5) < 6) & (places[:, 0] > 5.5) & (places[:, 0] < 11.5)
    other = (np.abs(places[:, 1] - 11.5) < 6) & (places[:, 0] > 11.5) & (places[:, 0] < 17.5)
    stain = one & (np.abs(places - [11, 11, 0]).max(axis=1) < 0.5)
    vectors = np.tile(np.eye(8)[1], (len(places), 1))
    vectors[one], vectors[other] = np.eye(8)[0], 0.5 * np.eye(8)[0] + 0.5 * np.eye(8)[1]
    relevancy = vectors[:, 0].copy()
    vectors[stain] = np.eye(8)[1]
    parts = ((np.flatnonzero(one), np.flatnonzero(other)),)
    members, _ = by_features(places, plain_features(vectors, SPACE), parts, relevancy[None])
    assert ((members == 1) == (one | other)).all()
