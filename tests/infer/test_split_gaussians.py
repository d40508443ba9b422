"""Large Gaussians cut into patches: they cover what the Gaussian covers, and rays and distances meet them."""

import numpy as np
import pytest
import torch
from rooms import merged, sheet, splat

from gsencoder.geometry import rotmats_from_quats
from gsencoder.infer.views.candidates import FreeSpace, patches
from gsencoder.infer.views.targets import CONSTANTS
from gsencoder.types import Gaussians


def one(
    scales: tuple[float, float, float], quat: np.ndarray, mean: tuple[float, float, float] = (0, 0, 0)
) -> Gaussians:
    return Gaussians(
        means=np.array([mean], np.float32),
        quats=(quat / np.linalg.norm(quat)).astype(np.float32)[None],
        scales=np.array([scales], np.float32),
        opacities=np.ones(1, np.float32),
        sh=np.zeros((1, 1, 3), np.float32),
    )


def test_small_gaussians_stay_as_they_are(rng: np.random.Generator) -> None:
    small = splat(rng.normal(size=(50, 3)), 0.4)
    parts = patches(small, 1.0)
    np.testing.assert_array_equal(parts.centers, small.means)
    np.testing.assert_array_equal(parts.scales, small.scales)
    assert parts.rows.tolist() == list(range(50))


@pytest.mark.parametrize("scales", [(1.0, 1.0, 0.001), (1.0, 0.01, 0.01), (1.0, 0.5, 0.25)])
def test_every_point_of_a_gaussian_is_near_a_patch_and_no_patch_leaves_it(
    scales: tuple[float, float, float], rng: np.random.Generator
) -> None:
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
