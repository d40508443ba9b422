"""The share of an object in a feature: who is asked, and what stands for the object and for its surroundings."""

import numpy as np
from feature_fields import plain_features
from scipy.spatial.distance import cdist
from selected_rooms import SPACE

from gsencoder.infer.select import object_shares

REACH, SPACING = 3.0, 1.1
"""The spacing is a little more than the step of the grid, so that the row beside a part is its rim."""
OBJECT, TABLE, OTHER = np.eye(8)[0], np.eye(8)[1], np.eye(8)[2]


def plate(side: int = 31) -> np.ndarray:
    """Points on a square grid with a step of 1 around the origin, a little off it."""
    steps = np.arange(side) - side // 2
    grid = np.stack(np.meshgrid(steps, steps, [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
    return grid + np.random.default_rng(6).normal(size=grid.shape) * 0.01


PLACES = plate()
PART = np.abs(PLACES).max(axis=1) < 4.5
"""Nine by nine Gaussians."""
RIM = ~PART & (cdist(PLACES, PLACES[PART]).min(axis=1) < SPACING)
VECTORS = np.where(PART[:, None], OBJECT, np.where(RIM[:, None], 0.3 * OBJECT + 0.7 * TABLE, TABLE))


def shares(
    places: np.ndarray = PLACES,
    vectors: np.ndarray = VECTORS,
    part: np.ndarray = PART,
    *,
    seen: np.ndarray | None = None,
    relevancy: np.ndarray | None = None,
    same: np.ndarray | None = None,
    blank: float = np.nan,
) -> np.ndarray:
    """The share of each Gaussian; −1 for those that are not asked. What was not seen has the relevancy `blank`."""
    seen = np.ones(len(places), bool) if seen is None else seen
    relevancy = vectors[:, 0] if relevancy is None else relevancy
    candidates, values = object_shares(
        plain_features(vectors * seen[:, None], SPACE, seen),
        places.astype(np.float32),
        np.flatnonzero(part),
        np.where(seen, relevancy, blank).astype(np.float32),
        spacing=SPACING,
        reach=REACH,
        same=np.flatnonzero(part if same is None else same),
    )
    assert (np.diff(candidates) > 0).all()
    made = np.full(len(places), -1.0)
    made[candidates] = values
    return made


def test_all_within_reach_of_the_part_are_asked_and_none_else() -> None:
    near = cdist(PLACES, PLACES[PART]).min(axis=1) <= REACH * SPACING
    made = shares()
    assert ((made > -1) == near).all()
    assert (made[PART] == 1).all()
    np.testing.assert_allclose(made[RIM], 0.3, atol=0.02)


def test_what_was_not_seen_has_no_share_and_changes_no_other_one() -> None:
    """Some of the part, of the rim and of the surroundings are blind, and more are added."""
    rng = np.random.default_rng(8)
    places = np.concatenate([PLACES, rng.uniform(-9, 9, (200, 3)) * [1, 1, 0] + [0, 0, 0.4]])
    added = np.arange(len(places)) >= len(PLACES)
    part = np.concatenate([PART, np.abs(places[len(PLACES) :, :2]).max(axis=1) < 4])
    vectors = np.concatenate([VECTORS, np.tile(TABLE, (200, 1))])
    for blank in (np.nan, -1.0):
        made = shares(places, vectors, part, seen=~added, blank=blank)
        assert np.isnan(made[added & (made != -1) & ~part]).all()
        np.testing.assert_allclose(made[:-200], shares(), atol=1e-6)


def test_surroundings_lie_between_one_spacing_and_twice_the_reach() -> None:
    """Objects with nothing around them but one patch of the table."""
    alone = PLACES[PART | RIM]
    vectors, part = VECTORS[PART | RIM], PART[PART | RIM]
    rim = len(alone) - part.sum()
    for distance, counts in ((1.5 * REACH, True), (1.9 * REACH, True), (2.1 * REACH, False)):
        for direction in ([1.0, 0.0, 0.0], [0.6, 0.8, 0.0]):
            # Seen from a corner of the part, so that the patch lies as far from all of it.
            corner = np.array([4.0, 4.0, 0.0])
            patch = corner + np.array(direction) * distance * SPACING + np.array([[0.01, 0, 0], [0, 0.01, 0]])
            with_patch = np.concatenate([vectors, [TABLE, TABLE]]), np.concatenate([part, [False, False]])
            made = shares(np.concatenate([alone, patch]), *with_patch)
            expected = 0.3 if counts else 1.0
            np.testing.assert_allclose(made[: len(alone)][~part], np.full(rim, expected), atol=0.02)
    without = shares(alone, vectors, part, seen=np.arange(len(alone)) > 0)
    assert np.isnan(without[0])
    assert (without[1:] == 1).all()


def test_other_parts_of_the_word_are_no_surroundings_whatever_their_features_and_relevancy() -> None:
    second = (PLACES[:, 0] > 6.5) & (PLACES[:, 0] < 9.5) & (np.abs(PLACES[:, 1]) < 4.5)
    made = []
    for vector in (OBJECT, OTHER):
        vectors = VECTORS.copy()
        vectors[second] = vector
        made.append(shares(vectors=vectors, relevancy=np.where(second, 0.5, VECTORS[:, 0]), same=PART | second))
    np.testing.assert_allclose(made[0][~second], made[1][~second], atol=1e-6)
    np.testing.assert_allclose(made[0][RIM], 0.3, atol=0.02)


def test_what_is_as_relevant_as_the_least_relevant_of_the_part_is_no_surroundings() -> None:
    spot = (PLACES[:, 0] > 5.5) & (PLACES[:, 0] < 8.5) & (np.abs(PLACES[:, 1]) < 3.5)
    relevancy = np.where(PART, np.where(PLACES[:, 0] > 0, 0.7, 1.0), np.where(spot, 0.8, 0.0))
    vectors = VECTORS.copy()
    vectors[spot] = OTHER
    np.testing.assert_allclose(
        shares(vectors=vectors, relevancy=relevancy)[~spot], shares(relevancy=relevancy * ~spot)[~spot], atol=0.03
    )


def test_the_purest_quarter_of_a_part_stands_for_the_object() -> None:
    """A strip without an inside: three of four of its Gaussians are mixtures, which are told apart by relevancy."""
    strip = (np.abs(PLACES[:, 1]) < 0.5) & (np.abs(PLACES[:, 0]) < 8.5)
    pure = strip & (np.round(PLACES[:, 0]) % 4 == 0)
    vectors = np.where(pure[:, None], OBJECT, np.where(strip[:, None], 0.6 * OBJECT + 0.4 * TABLE, TABLE))
    made = shares(vectors=vectors, part=strip)
    np.testing.assert_allclose(made[pure], 1, atol=0.02)
    np.testing.assert_allclose(made[strip & ~pure], 0.6, atol=0.02)
    # Where all are as relevant, all stand for it.
    same = shares(vectors=np.where(strip[:, None], OBJECT, TABLE), part=strip)
    np.testing.assert_allclose(same[strip], 1)


def test_the_inside_of_a_part_stands_for_the_object_near_it_even_where_others_are_purer() -> None:
    """A part of two materials, of which the left one answers the word better."""
    right = PLACES[:, 0] > 0.5
    vectors = np.where(
        right[:, None], np.where(VECTORS[:, :1] > 0, VECTORS @ np.eye(8)[[3, 1, 2, 0, 4, 5, 6, 7]], TABLE), VECTORS
    )
    relevancy = np.where(PART, np.where(right, 0.9, 1.0), 0.0)
    made = shares(vectors=vectors, relevancy=relevancy)
    np.testing.assert_allclose(made[RIM & (PLACES[:, 0] > 4.5)], 0.3, atol=0.02)
    np.testing.assert_allclose(made[RIM & (PLACES[:, 0] < -4.5)], 0.3, atol=0.02)


def test_where_object_and_surroundings_have_one_feature_all_stays_as_it_started() -> None:
    one = np.tile(OBJECT + TABLE, (len(PLACES), 1)).astype(np.float32)
    # Or features that differ by rounding alone.
    nearly = np.where(PART[:, None], np.nextafter(one, np.float32(2)), one)
    nearly[RIM] = np.nextafter(np.nextafter(one, np.float32(2)), np.float32(2))[RIM]
    for vectors in (one, nearly):
        made = shares(vectors=vectors, relevancy=PART.astype(float))
        assert (made[PART] == 1).all()
        assert (made[(made > -1) & ~PART] == 0).all()


def test_a_part_without_any_feature_has_itself_alone_and_no_shares() -> None:
    made = shares(seen=~PART)
    assert np.isnan(made[PART]).all()
    assert (made[~PART] == -1).all()
