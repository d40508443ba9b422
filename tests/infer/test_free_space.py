"""Where a camera can stand, in a room whose walls are known."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from rooms import HALF, HEIGHT, STEP, corner_cameras, merged, room, sheet, splat
from splats import one_gaussian

from gsencoder.geometry import rotmats_from_quats
from gsencoder.infer.views.candidates import FreeSpace, patches
from gsencoder.infer.views.targets import CONSTANTS
from gsencoder.types import Gaussians


@pytest.fixture(scope="module")
def free() -> FreeSpace:
    scene, rows = room()
    return FreeSpace(scene.gaussians).seen_by(corner_cameras()).without(rows)


def test_points_in_the_room_are_seen_empty_and_those_beyond_its_walls_are_not(free, rng):
    inside = rng.uniform((-1.2, -1.2, 0.3), (1.2, 1.2, 1.3), (200, 3))
    inside = inside[np.abs(inside - (0.3, 0.2, 0.8)).max(axis=1) > 0.5]
    assert free.seen_empty(inside).mean() > 0.97
    outside = rng.uniform(-1, 1, (300, 3)) * 4 + (0, 0, 1.2)
    outside = outside[(np.abs(outside[:, :2]) > HALF + 0.2).any(axis=1)]
    assert len(outside) > 100
    assert not free.seen_empty(outside).any()
    # Nor is the inside of a closed thing, and without cameras nobody knows.
    assert not free.seen_empty(np.array([[0.3, 0.2, 0.8]])).any()
    blind = FreeSpace(room()[0].gaussians)
    assert blind.observers is None
    assert not blind.seen_empty(inside).any()


def test_clearance_from_a_wall_is_at_most_the_distance_less_two_standard_deviations() -> None:
    wall = splat(sheet((1.0, 0, 0), (1, 2), (1.0, 1.0)))
    flat = replace(wall, scales=wall.scales * np.array([0.1, 1, 1], np.float32))
    # Straight in front of one of the Gaussians.
    away = np.array([0.5, 0.2, 0.1])
    at = np.array([[1 - d, *wall.means[600, 1:]] for d in away])
    exact = away - CONSTANTS.surface_sigmas * float(flat.scales[0, 0])
    one = FreeSpace(flat.select(np.array([600]))).clearance(at)
    np.testing.assert_allclose(one, exact, atol=1e-6)
    all_of_it = FreeSpace(flat).clearance(at)
    assert (all_of_it <= exact + 1e-9).all()
    assert (all_of_it >= exact - 0.4 * STEP).all()
    assert FreeSpace(flat).clearance(wall.means[600:601].astype(np.float64))[0] <= 0


def test_rays_end_at_walls_and_go_through_what_is_set_apart(free: FreeSpace) -> None:
    start = np.array([[0.3, 0.2, 0.8]])
    for axis, sign in ((0, 1.0), (0, -1.0), (1, 1.0), (1, -1.0), (2, 1.0), (2, -1.0)):
        direction = np.zeros((1, 3))
        direction[0, axis] = sign
        wall = (HALF if sign > 0 else -HALF) if axis < 2 else (HEIGHT if sign > 0 else 0.0)
        distance = free.first_hit(start, direction, np.array([10.0]))[0]
        assert abs(distance - abs(wall - start[0, axis])) < 2 * free.cell
    assert free.first_hit(start, np.array([[1.0, 0, 0]]), np.array([0.5]))[0] == np.inf
    scene, _ = room()
    assert FreeSpace(scene.gaussians).first_hit(start, np.array([[1.0, 0, 0]]), np.array([0.5]))[0] < 0.25


@pytest.mark.parametrize(("scale", "shift"), [(1e-4, 0.0), (1e4, 0.0), (1.0, 500.0)])
def test_what_is_free_does_not_depend_on_the_unit_or_the_place(scale: float, shift: float) -> None:
    wall = sheet((1.0, 0, 0), (1, 2), (1.0, 1.0))
    moved = FreeSpace(splat(wall * scale + shift, 0.6 * STEP * scale))
    here = FreeSpace(splat(wall))
    start, along = np.array([[0.03, 0.01, 0.02]]), np.array([[1.0, 0, 0]])
    assert moved.cell == pytest.approx(here.cell * scale, rel=1e-2)
    far = moved.first_hit(start * scale + shift, along, np.array([5.0 * scale]))[0]
    assert far == pytest.approx(here.first_hit(start, along, np.array([5.0]))[0] * scale, abs=1.5 * moved.cell)


@pytest.mark.parametrize("count", [1, 2, 50])
def test_few_gaussians_and_many_in_one_place_have_a_free_space(count: int) -> None:
    together = splat(np.zeros((count, 3)), 0.1)
    free = FreeSpace(together)
    assert free.cell == pytest.approx(0.2)
    np.testing.assert_allclose(free.clearance(np.array([[1.0, 0, 0]])), [0.8], atol=1e-6)
    assert free.first_hit(np.array([[-1.0, 0, 0]]), np.array([[1.0, 0, 0]]), np.array([3.0]))[0] < 1.01


RAY = np.full((1, 3), 0.01), np.array([[1.0, 0, 0]]), np.array([3.0])


def test_faint_gaussians_are_no_obstacle_unless_there_are_no_others() -> None:
    wall = splat(sheet((1.0, 0, 0), (1, 2), (1.0, 1.0)))
    means = wall.means - np.array([0.5, 0, 0], np.float32)
    faint = replace(wall, means=means, opacities=np.full(len(wall), 0.1, np.float32))
    both = merged(wall, faint)
    assert FreeSpace(both).first_hit(*RAY)[0] > 0.8
    assert FreeSpace(faint).first_hit(*RAY)[0] < 0.6


def test_floaters_far_away_change_nothing_in_the_room() -> None:
    wall = sheet((1.0, 0, 0), (1, 2), (1.0, 1.0))
    far, near = (FreeSpace(splat(points)) for points in (np.concatenate([wall, [[1e9, -1e9, 1e9]]]), wall))
    assert far.first_hit(*RAY) == pytest.approx(near.first_hit(*RAY), abs=2 * near.cell)


Three = tuple[float, float, float]


def one(scales: Three, quat: np.ndarray, mean: Three = (0, 0, 0)) -> Gaussians:
    return replace(one_gaussian(mean, scales, 1.0), quats=(quat / np.linalg.norm(quat)).astype(np.float32)[None])


def test_small_gaussians_stay_as_they_are(rng: np.random.Generator) -> None:
    small = splat(rng.normal(size=(50, 3)), 0.4)
    parts = patches(small, 1.0)
    np.testing.assert_array_equal(parts.centers, small.means)
    np.testing.assert_array_equal(parts.scales, small.scales)
    assert parts.rows.tolist() == list(range(50))


@pytest.mark.parametrize("scales", [(1.0, 1.0, 0.001), (1.0, 0.01, 0.01), (1.0, 0.5, 0.25)])
def test_every_point_of_a_gaussian_is_near_a_patch_and_no_patch_leaves_it(scales, rng):
    edge = 0.2
    whole = one(scales, rng.normal(size=4), (3.0, -2.0, 1.0))
    parts = patches(whole, edge)
    turn = rotmats_from_quats(torch.from_numpy(whole.quats).double())[0].numpy()
    inside = rng.normal(size=(400, 3))
    inside *= rng.uniform(0, 1, (400, 1)) ** (1 / 3) / np.linalg.norm(inside, axis=1, keepdims=True)
    points = whole.means[0] + (CONSTANTS.surface_sigmas * np.array(scales) * inside) @ turn.T
    nearest = np.linalg.norm(points[:, None] - parts.centers, axis=-1).min(axis=1)
    # Half a patch's diagonal, and the rest of those at the rim whose middles lie outside.
    assert nearest.max() < 1.5 * edge * np.sqrt(3)
    local = (parts.centers - whole.means[0]) @ turn / (CONSTANTS.surface_sigmas * np.array(scales))
    assert np.linalg.norm(local, axis=1).max() <= 1 + 1e-6
    assert (2 * CONSTANTS.surface_sigmas * parts.scales).max() <= 2 * edge + 1e-6


def test_a_sky_is_cut_into_no_more_patches_than_are_allowed() -> None:
    sky = one((1e6, 1e6, 1e6), np.array([1.0, 0, 0, 0]))
    assert len(patches(sky, 1e-3).rows) <= CONSTANTS.max_patches_per_gaussian
    many = merged(*[sky] * 3000)
    assert len(patches(many, 1e-3).rows) <= 1 << 21


def test_a_wall_of_one_gaussian_stops_rays_and_is_near_all_along() -> None:
    # The nearest centers belong to small Gaussians; the surface of the large one is nearer.
    clutter = splat(sheet((0.6, 0.0, 0.0), (1, 2), (0.05, 0.05), 0.02), 0.005)
    wall = one((0.01, 1.0, 1.0), np.array([1.0, 0, 0, 0]), (0.0, 1.5, 0.0))
    free = FreeSpace(merged(clutter, wall))
    at = np.array([[0.1, 0.0, 0.0]])
    assert free.clearance(at)[0] < 0.1
    assert free.clearance(at)[0] == pytest.approx(0.1 - CONSTANTS.surface_sigmas * 0.01, abs=0.03)
    met = free.first_hit(at, np.array([[-1.0, 0, 0]]), np.array([2.0]))[0]
    assert met == pytest.approx(0.1, abs=2 * free.cell)
    passed = free.first_hit(np.array([[0.1, 5.0, 0.0]]), np.array([[-1.0, 0, 0]]), np.array([2.0]))[0]
    assert passed == np.inf
