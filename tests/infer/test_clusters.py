"""Clusters and things: DBSCAN's rule, and which clusters are one thing."""

import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsencoder.infer.localize import cluster, cluster_by_gaps

SPACING = 0.02
RADIUS = 1.5 * SPACING


def plate(low: tuple[float, float, float], high: tuple[float, float, float], step: float = SPACING) -> np.ndarray:
    """A lattice of points in a box that may be flat."""
    axes = [np.arange(a, b + 1e-9, step) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def chair(x: float = 0.0) -> np.ndarray:
    """Seat and back, 8 cm apart, and four legs that are seen from 12 cm below the seat on; 0.44 m wide."""
    legs = [plate((x + a, b, 0), (x + a + 0.04, b + 0.04, 0.32)) for a in (0, 0.4) for b in (0, 0.4)]
    seat, back = plate((x, 0, 0.44), (x + 0.44, 0.44, 0.44)), plate((x, 0.44, 0.52), (x + 0.44, 0.44, 0.9))
    return np.concatenate([seat, back, *legs])


def things(points: np.ndarray, radius: float = RADIUS) -> int:
    """The number of clusters that are not floaters."""
    labels = cluster_by_gaps(points.astype(np.float32), radius, 3)
    sizes = np.bincount(labels[labels >= 0])
    assert sizes.min() > 0
    return int((sizes >= 0.05 * sizes.max()).sum())


def test_the_parts_of_a_thing_are_one() -> None:
    """A table whose legs are hidden below its top for 24 cm, and a chair of six parts."""
    table = np.concatenate(
        [plate((0, 0, 0.8), (1.8, 0.7, 0.8)), *(plate((x, 0, 0), (x, 0.06, 0.56)) for x in (0, 1.8))]
    )
    for points, parts in ((table, 3), (chair(), 6)):
        assert cluster(points.astype(np.float32), RADIUS, 3).max() == parts - 1
        assert things(points) == 1


@pytest.mark.parametrize("gap", [0.3, 0.6, 3.0])
def test_chairs_that_stand_apart_are_as_many_as_they_are(gap: float) -> None:
    for count in (2, 3):
        assert things(np.concatenate([chair(k * (0.44 + gap)) for k in range(count)])) == count


def test_small_things_side_by_side_and_a_thing_far_from_a_large_one_stay_apart() -> None:
    mugs = [plate((x, 0, 0), (x + 0.08, 0.08, 0.1)) for x in (0, 0.14)]
    person, counter = plate((0, 0, 0), (0.4, 0.2, 1.8)), plate((0.8, 0, 0.9), (3.8, 0.6, 0.9))
    assert things(np.concatenate(mugs)) == 2
    assert things(np.concatenate([person, counter])) == 2


def test_strays_in_front_of_a_door_stay_apart_and_its_handle_does_not() -> None:
    """One in fifty of the points of the door is the limit, also of one that was seen in two parts."""
    door = plate((0, 0, 0), (0.9, 0, 2.0))
    parts = door[np.abs(door[:, 2] - 0.5) > 0.035]
    assert (len(door), len(parts)) == (46 * 101, 46 * 98)
    for points in (door, parts):
        for size, count in ((0.14, 2), (0.18, 1)):
            near = plate((0.4, 0.1, 1), (0.4 + size, 0.1, 1 + size))
            labels = cluster_by_gaps(np.concatenate([points, near]).astype(np.float32), RADIUS, 3)
            assert labels.max() + 1 == count


def test_a_gap_is_small_beside_the_wider_one_of_two_parts_whichever_has_more_points() -> None:
    """A dense knob 16 cm in front of a thin pole."""
    pole, knob = plate((0, 0, 0), (0, 0, 2.4)), plate((0, 0.16, 1), (0.06, 0.22, 1.06), SPACING / 2)
    assert len(pole) < len(knob)
    for points in (np.concatenate([pole, knob]), np.concatenate([knob, pole])):
        assert cluster(points.astype(np.float32), RADIUS, 3).max() == 1
        assert things(points) == 1


def test_a_thing_that_is_sparser_than_its_scene_is_one(rng: np.random.Generator) -> None:
    """Points by chance, one in six of those that the spacing stands for."""
    seat, back = rng.random((200, 3)) * (0.44, 0.44, 0), rng.random((200, 3)) * (0.44, 0, 0.44)
    points = np.concatenate([seat, back]).astype(np.float32)
    spacing = 0.01
    assert cluster(points, 1.5 * spacing, 3).max() > 10
    labels = cluster_by_gaps(points, 1.5 * spacing, 3)
    assert np.bincount(labels[labels >= 0])[0] >= 390


def test_turning_moving_scaling_and_reordering_change_no_thing(rng: np.random.Generator) -> None:
    points = np.concatenate([chair(), chair(0.74), plate((4, 0, 0), (4.2, 0.1, 0))])
    expected = cluster_by_gaps(points.astype(np.float32), 1.02 * RADIUS, 3)
    order = rng.permutation(len(points))
    moved = (3 * Rotation.random(random_state=1).apply(points) + (7, -5, 2))[order].astype(np.float32)
    found = cluster_by_gaps(moved, 3 * 1.02 * RADIUS, 3)
    assert expected.max() == 2
    assert len(set(zip(found.tolist(), expected[order].tolist(), strict=True))) == 3


@pytest.mark.parametrize("library", ["open3d", "scikit-learn"])
@pytest.mark.parametrize(("step", "min_samples"), [(1, 3), (1, 7), (3, 4), (1000, 5)])
def test_points_of_a_lattice_exactly_the_radius_apart_are_neighbors_as_in_scikit_learn(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, library: str, step: int, min_samples: int
) -> None:
    from sklearn.cluster import DBSCAN

    if library == "scikit-learn":
        monkeypatch.setitem(sys.modules, "open3d", None)
    cells = np.unique(rng.integers(0, 10, (1200, 3)), axis=0)
    points = (step * cells).astype(np.float32)
    expected = DBSCAN(eps=step, min_samples=min_samples).fit_predict(points)
    core = DBSCAN(eps=step, min_samples=min_samples).fit(points).core_sample_indices_
    labels = cluster(points, float(step), min_samples)
    assert len(core) > 10
    np.testing.assert_array_equal(labels < 0, expected < 0)
    pairs = set(zip(labels[core].tolist(), expected[core].tolist(), strict=True))
    assert len(pairs) == len({ours for ours, _ in pairs}) == len({theirs for _, theirs in pairs}) == expected.max() + 1
