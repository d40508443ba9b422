"""Clusters, boxes and scores: laws, and the clusters of one, two and three points."""

import math
import sys
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from splats import gaussians_at

from gsencoder.data.seeding.points import scene_spacing
from gsencoder.infer.localize import (
    SHARE_POWER,
    Extents,
    box_around,
    cluster,
    cluster_by_gaps,
    oriented_axes,
    score_clusters,
)
from gsencoder.types import Gaussians


def splat(means: np.ndarray, scale: float = 0.01, quats: np.ndarray | None = None) -> Gaussians:
    straight = gaussians_at(means, [scale, 2 * scale, 3 * scale])
    return straight if quats is None else replace(straight, quats=quats.astype(np.float32))


def bounds(points: np.ndarray, **options: object) -> Extents:
    return box_around(splat(points), np.arange(len(points)), **options)


def inside(points: np.ndarray, box: Extents, slack: float = 1e-5) -> bool:
    turned = (points.astype(np.float64) - box.center) @ box.rotation
    axis_aligned = (points >= box.aabb_min - slack).all() and (points <= box.aabb_max + slack).all()
    return bool((np.abs(turned) <= box.size / 2 + slack).all() and axis_aligned)


def is_rotation(matrix: np.ndarray) -> bool:
    return np.allclose(matrix.T @ matrix, np.eye(3), atol=1e-9) and math.isclose(np.linalg.det(matrix), 1)


def test_the_spacing_of_a_grid_is_its_step_whatever_the_order_and_the_duplicates(rng: np.random.Generator) -> None:
    grid = np.stack(np.meshgrid(*[np.arange(12)] * 3), axis=-1).reshape(-1, 3).astype(np.float32) * np.float32(0.02)
    assert scene_spacing(grid) == pytest.approx(0.02, rel=1e-4)
    shuffled = rng.permutation(grid)
    assert scene_spacing(shuffled) == scene_spacing(grid)
    assert scene_spacing(np.concatenate([shuffled, shuffled, shuffled])) == pytest.approx(0.02, rel=1e-4)


def test_the_spacing_of_a_sample_does_not_depend_on_order(rng, monkeypatch):
    points = rng.random((4000, 3)).astype(np.float32)
    whole = scene_spacing(points)
    monkeypatch.setattr("gsencoder.data.seeding.points.SPACING_SAMPLE", 500)
    sampled = scene_spacing(points)
    assert sampled == scene_spacing(rng.permutation(points))
    assert sampled == pytest.approx(whole, rel=0.1)


def test_clusters_on_the_grid_are_those_of_dbscan_on_a_surface(rng, monkeypatch):
    centers = rng.random((30, 3)) * 4
    points = (centers[rng.integers(0, 30, 6000)] + rng.normal(0, 0.03, (6000, 3))).astype(np.float32)
    exact = cluster(points, 0.08, 3)
    monkeypatch.setattr("gsencoder.infer.localize.MAX_NEIGHBORS", 0)
    coarse = cluster(points, 0.08, 3)
    from sklearn.metrics import adjusted_rand_score

    assert adjusted_rand_score(exact, coarse) > 0.99


def test_points_that_crowd_in_few_places_are_clustered_without_their_neighbors(rng: np.random.Generator) -> None:
    """A million neighbors of each of 100,000 points would take a terabyte."""
    crowd = rng.normal(0, 0.01, (100_000, 3)).astype(np.float32)
    points = np.concatenate([crowd, crowd + np.float32(3), np.full((1, 3), 9, np.float32)])
    labels = cluster(points, 0.5, 3)
    assert (labels[:100_000] == labels[0]).all()
    assert (labels[100_000:-1] == labels[100_000]).all()
    assert labels[0] != labels[100_000]
    assert labels[-1] == -1


def test_nothing_selected_has_no_clusters() -> None:
    assert cluster(np.zeros((0, 3), np.float32), 0.1, 3).shape == (0,)
    empty = np.zeros(0, np.int64)
    assert score_clusters(empty, empty, empty.astype(np.float32), empty.astype(np.float32)) == []


def test_floaters_are_dropped_by_their_share_of_the_heaviest_clusters_weight() -> None:
    labels = np.r_[np.zeros(96, int), np.ones(4, int)]
    scores, weights = np.full(100, 0.8, np.float32), np.ones(100, np.float32)
    rows = np.arange(100) + 7
    assert len(score_clusters(labels, rows, scores, weights)) == 2
    clusters = score_clusters(labels, rows, scores, weights, min_share=0.05)
    assert [one.rows.tolist() for one in clusters] == [list(range(7, 103))]
    # A floater that is more relevant is one, too.
    scores[96:] = 0.95
    assert score_clusters(labels, rows, scores, weights)[0].rows.tolist() == [103, 104, 105, 106]
    assert len(score_clusters(labels, rows, scores, weights, min_share=0.05)) == 1


@given(
    st.integers(1, 40),
    st.sampled_from(["volume", "plane", "line", "place", "tilted plane"]),
    st.integers(0, 10_000),
    st.booleans(),
    st.sampled_from([1e-4, 1.0, 1e3]),
)
@settings(max_examples=60)
def test_boxes_hold_their_points_and_have_sides_of_no_negative_length(count, shape, seed, upright, size):
    rng = np.random.default_rng(seed)
    flat = {"volume": [1, 1, 1], "plane": [1, 1, 0], "line": [1, 0, 0], "place": [0, 0, 0], "tilted plane": [1, 1, 0]}
    points = rng.normal(size=(count, 3)) * flat[shape]
    if shape == "tilted plane":
        points = points @ Rotation.random(rng=seed).as_matrix()
    points = (points * size + 1).astype(np.float32)
    box = bounds(points, up=np.array([0.0, 0, 1]) if upright else None)
    assert is_rotation(box.rotation)
    assert (box.size >= 0).all()
    assert (box.aabb_max >= box.aabb_min).all()
    assert inside(points, box, slack=1e-5 * max(size, 1))
    if upright:
        np.testing.assert_allclose(box.rotation[:, 2], [0, 0, 1], atol=1e-12)


def test_the_upright_box_of_a_brick_turned_about_up_is_the_brick(rng: np.random.Generator) -> None:
    corners = np.array([[x, y, z] for x in (-1.5, 1.5) for y in (-1, 1) for z in (-0.5, 0.5)])
    for up in np.array([[0.0, 0, 1], [0, -1, 0], [0.6, 0, 0.8]]):
        stand = Rotation.align_vectors(up[None], [[0, 0, 1]])[0]
        points = stand.apply(Rotation.from_euler("z", 0.4).apply(corners)).astype(np.float32)
        box = bounds(points, up=up)
        np.testing.assert_allclose(np.sort(box.size), [1, 2, 3], rtol=1e-4)
        np.testing.assert_allclose(box.rotation[:, 2], up, atol=1e-12)
        assert box.size[2] == pytest.approx(1, rel=1e-4)


def test_points_on_a_line_have_a_box_along_it() -> None:
    direction = np.array([1.0, 2, 2]) / 3
    points = (np.linspace(0, 3, 7)[:, None] * direction).astype(np.float32)
    box = bounds(points)
    np.testing.assert_allclose(np.sort(box.size), [0, 0, 3], atol=1e-5)
    assert abs(box.rotation[:, box.size.argmax()] @ direction) == pytest.approx(1)


def test_sigma_boxes_bound_the_ellipsoids(rng: np.random.Generator) -> None:
    quats = Rotation.random(20, rng=1).as_quat()[:, [3, 0, 1, 2]]
    gaussians = splat(rng.random((20, 3)), 0.05, quats)
    box = box_around(gaussians, np.arange(20), extent="sigma")
    directions = rng.normal(size=(20_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    turns = Rotation.from_quat(gaussians.quats[:, [1, 2, 3, 0]]).as_matrix()
    surface = np.concatenate(
        [m + (directions * s) @ r.T for m, s, r in zip(gaussians.means, gaussians.scales, turns, strict=True)]
    )
    assert inside(surface, box, slack=1e-6)
    np.testing.assert_allclose(surface.min(axis=0), box.aabb_min, atol=2e-3)
    np.testing.assert_allclose(surface.max(axis=0), box.aabb_max, atol=2e-3)
    turned = (surface - box.center) @ box.rotation
    np.testing.assert_allclose(np.ptp(turned, axis=0), box.size, atol=4e-3)


@pytest.mark.parametrize("mean", [0.5, 0.0, -0.5])
def test_clusters_are_scored_by_their_weighted_mean_and_a_power_of_their_share(rng, mean):
    """A negative mean is divided by the power: a small share is never an advantage."""
    labels, rows = rng.integers(-1, 4, 300), 10 + rng.permutation(300)
    scores, weights = (mean + rng.normal(0, 0.1, 300)).astype(np.float32), rng.random(300).astype(np.float32)
    expected = {}
    for label in range(4):
        own = labels == label
        average = np.average(scores[own].astype(float), weights=weights[own].astype(float))
        power = (weights[own].sum(dtype=float) / weights.sum(dtype=float)) ** SHARE_POWER
        expected[tuple(sorted(rows[own].tolist()))] = average * power if average >= 0 else average / power
    clusters = score_clusters(labels, rows, scores, weights)
    assert {tuple(one.rows.tolist()) for one in clusters} == set(expected)
    for one in clusters:
        assert one.score == pytest.approx(expected[tuple(one.rows.tolist())], rel=1e-6)
    assert [one.score for one in clusters] == sorted((one.score for one in clusters), reverse=True)


def test_equal_clusters_come_in_the_order_of_their_rows_and_a_share_may_just_be_reached() -> None:
    labels, rows = np.array([1, 1, 0, 0, 2]), np.array([4, 5, 8, 9, 2])
    clusters = score_clusters(labels, rows, np.ones(5, np.float32), np.ones(5, np.float32), min_share=0.5)
    assert [one.rows.tolist() for one in clusters] == [[4, 5], [8, 9], [2]]
    assert clusters[2].weight == 0.5 * clusters[0].weight


@pytest.mark.parametrize(("thickness", "flat"), [(1e-3, False), (1e-4, False), (1e-6, True)])
def test_a_thickness_below_rounding_does_not_turn_a_box(rng: np.random.Generator, thickness: float, flat: bool) -> None:
    """A turned rectangle with its smallest area, and as a slab with its smallest volume."""
    corners = np.array([[x, y, z] for x in (-1.5, 1.5) for y in (-1, 1) for z in (-0.5, 0.5)])
    turn = Rotation.from_euler("xyz", [0.3, -0.7, 1.1]).as_matrix()
    axes = oriented_axes(corners * [1, 1, thickness] @ turn.T)
    assert is_rotation(axes)
    spans = np.ptp(corners * [1, 1, thickness] @ turn.T @ axes, axis=0)
    np.testing.assert_allclose(np.sort(spans), [thickness, 2, 3], rtol=1e-3)
    # What is flat has its plane's normal as its last axis.
    assert not flat or spans.argmin() == 2


@pytest.mark.parametrize("up", [None, [0.0, 0, 1], [0.0, 0.6, -0.8]])
def test_no_other_turn_gives_a_smaller_rectangle(rng: np.random.Generator, up: list[float] | None) -> None:
    """Tried in steps of half a degree, for hulls of many sides; without `up` the points lie in a plane."""
    axis = np.array([0.0, 0, 1] if up is None else up)
    for count in (3, 5, 12):
        points = rng.normal(size=(count, 3)) * [1, 0.6, 0.0 if up is None else 1.0]
        first, second, third = oriented_axes(points, None if up is None else axis).T
        assert abs(third @ axis) == pytest.approx(1)
        turns = np.radians(np.arange(0, 90, 0.5))
        along = points @ (np.outer(first, np.cos(turns)) + np.outer(second, np.sin(turns)))
        across = points @ (np.outer(second, np.cos(turns)) - np.outer(first, np.sin(turns)))
        areas = np.ptp(along, axis=0) * np.ptp(across, axis=0)
        assert areas[0] <= areas.min() * (1 + 1e-9)
        assert areas.max() > 1.01 * areas[0]


def test_of_equally_small_rectangles_the_least_turned_one_is_taken() -> None:
    """A regular octagon with sides along x, y and both diagonals."""
    near = np.sqrt(2) - 1
    corners = np.array([[a * x, b * y, 0] for a in (1, -1) for b in (1, -1) for x, y in ((1, near), (near, 1))])
    np.testing.assert_allclose(oriented_axes(corners, np.array([0.0, 0, 1])), np.eye(3), atol=1e-9)


def test_a_box_far_from_the_origin_is_as_exact_as_one_near_it() -> None:
    """A turned brick whose corners are exact in float32 here and there."""
    corners = [np.array([4 * x - 3 * y, 3 * x + 4 * y, z]) / 8 for x in (0, 2) for y in (0, 1) for z in (0, 1)]
    points, offset = np.array(corners), np.array([2.0**17, -(2.0**17), 2.0**18])
    near, far = (bounds(part, up=np.array([0.0, 0, 1])) for part in (points, points + offset))
    np.testing.assert_allclose(np.sort(near.size), [0.125, 0.625, 1.25], rtol=0, atol=1e-12)
    np.testing.assert_allclose(far.size, near.size, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(far.aabb_max - offset, near.aabb_max)


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


def test_the_parts_of_a_thing_are_one_and_chairs_that_stand_apart_are_as_many_as_they_are() -> None:
    """A table whose legs are hidden below its top for 24 cm, and a chair of six parts."""
    table = np.concatenate(
        [plate((0, 0, 0.8), (1.8, 0.7, 0.8)), *(plate((x, 0, 0), (x, 0.06, 0.56)) for x in (0, 1.8))]
    )
    for points, parts in ((table, 3), (chair(), 6)):
        assert cluster(points.astype(np.float32), RADIUS, 3).max() == parts - 1
        assert things(points) == 1
    for gap in (0.3, 3.0):
        assert things(np.concatenate([chair(k * (0.44 + gap)) for k in range(3)])) == 3


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
