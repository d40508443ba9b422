"""B against an implementation of its definition that shares no code with it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from splats import EXTREMES, dense, front_camera, one_gaussian, random_gaussians

from gsencoder.core.errors import InputError
from gsencoder.render import BlendConfig, blend, blend_torch
from gsencoder.render.blend_cpu import _stable_order
from gsencoder.types import Cameras, FeatureMap, FeatureSpace, Gaussians


def brute_force(g: Gaussians, cameras: Cameras, stop: float = 1e-4) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Every pixel against every Gaussian in float64, straight from the definition in Kerbl et al. 2023.

    Returns:
        Weights [P, N], depths [N], and for each pixel whether some decision (alpha at 1/255 or 0.999, the stop of the
        ray, the order of two depths) falls within float32 rounding of its threshold.
    """
    pose, K = cameras.cam_from_world[0].astype(np.float64), cameras.Ks[0].astype(np.float64)
    w, h = int(cameras.widths[0]), int(cameras.heights[0])
    p = g.means.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
    qw, qx, qy, qz = (g.quats / np.linalg.norm(g.quats.astype(np.float64), axis=1, keepdims=True)).T
    R = np.array(
        [
            [1 - 2 * (qy**2 + qz**2), 2 * (qx * qy - qw * qz), 2 * (qx * qz + qw * qy)],
            [2 * (qx * qy + qw * qz), 1 - 2 * (qx**2 + qz**2), 2 * (qy * qz - qw * qx)],
            [2 * (qx * qz - qw * qy), 2 * (qy * qz + qw * qx), 1 - 2 * (qx**2 + qy**2)],
        ]
    ).transpose(2, 0, 1)
    sigma = pose[:3, :3] @ R @ (g.scales.astype(np.float64)[:, :, None] ** 2 * R.transpose(0, 2, 1)) @ pose[:3, :3].T
    ys, xs = np.mgrid[:h, :w].reshape(2, -1) + 0.5
    weights, doubt = np.zeros((h * w, len(g))), np.zeros(h * w, bool)
    light, stopped = np.ones(h * w), np.zeros(h * w, bool)
    order = np.argsort(p[:, 2], kind="stable")
    for i in order:
        x, y, z = p[i]
        if z <= 0.01:
            continue
        fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
        u = min(max(x / z, -cx / fx - 0.15 * w / fx), (w - cx) / fx + 0.15 * w / fx)
        v = min(max(y / z, -cy / fy - 0.15 * h / fy), (h - cy) / fy + 0.15 * h / fy)
        J = np.array([[fx / z, 0, -fx * u / z], [0, fy / z, -fy * v / z]])
        conic = np.linalg.inv(J @ sigma[i] @ J.T + 0.3 * np.eye(2))
        d = np.stack((xs - (fx * x / z + cx), ys - (fy * y / z + cy)))
        alpha = np.minimum(0.999, float(g.opacities[i]) * np.exp(-0.5 * np.einsum("ip,ij,jp->p", d, conic, d)))
        doubt |= ~stopped & (np.abs(alpha * 255 - 1) < 1e-7)
        hit = (alpha >= 1 / 255) & ~stopped
        after = np.where(hit, light * (1 - alpha), light)
        doubt |= hit & (np.abs(after / stop - 1) < 1e-7)
        stopped |= hit & (after <= stop)
        hit &= ~stopped
        weights[hit, i] = (alpha * light)[hit]
        light = np.where(hit, after, light)
    return weights, p[:, 2], doubt


BACKENDS = ["cpu", "torch", "reference"]
# The numba backend computes in float64 and stores float32; the others are asked for float64, so that all decide alike.
DTYPE = {"cpu": torch.float32, "torch": torch.float64, "reference": torch.float64}
FAST = ["cpu", "torch"]


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(("seed", "log_scale"), [(0, -4.0), (1, -2.5), (2, -0.5)])
def test_weights_colors_and_depths_agree_with_the_definition(backend: str, seed: int, log_scale: float) -> None:
    g, camera = random_gaussians(300, seed, log_scale=log_scale), front_camera()
    expected, depths, doubt = brute_force(g, camera)
    b = blend(g, camera, config=BlendConfig(backend=backend), dtype=DTYPE[backend])
    assert doubt.mean() <= 1e-4
    sure = ~doubt
    np.testing.assert_allclose(dense(b)[sure], expected[sure], atol=1e-5)
    colors = np.random.default_rng(seed).uniform(size=(len(g), 3))
    got = b.render(torch.from_numpy(colors)).numpy()
    np.testing.assert_allclose(got[sure], (expected @ colors)[sure], atol=1e-4)
    alpha = expected.sum(axis=1)
    there = sure & (alpha > 0.01)
    expected_depth = (expected @ depths)[there] / alpha[there]
    np.testing.assert_allclose(b.depth.numpy()[there], expected_depth, rtol=1e-4)
    np.testing.assert_allclose(b.alpha.numpy()[sure], alpha[sure], atol=1e-4)


@pytest.mark.parametrize("backend", FAST)
@pytest.mark.parametrize("rays", [1, 9])
def test_the_fast_backends_agree_with_their_float64_twin_on_patches(rays: int, backend: str) -> None:
    g, camera = random_gaussians(400, 5), front_camera(90, 70)
    config = BlendConfig(rays_per_patch=rays, backend=backend)
    fast = blend(g, camera, patch=7, config=config, dtype=DTYPE[backend])
    slow = blend(g, camera, patch=7, config=replace(config, backend="reference"), dtype=torch.float64)
    np.testing.assert_allclose(dense(fast), dense(slow), atol=1e-6)


@pytest.mark.parametrize("backend", FAST)
@pytest.mark.parametrize(("side", "stop"), [(1, 1e-4), (2, 0.1), (4, 1e-4)])
def test_rays_that_stop_in_any_order_agree_with_the_twin(side: int, stop: float, backend: str) -> None:
    """Opaque Gaussians no larger than a tile: its rays end one after the other, at its borders and inside."""
    g = random_gaussians(500, 8, log_scale=-2.0)
    g = replace(g, opacities=np.float32(0.5) + g.opacities / 2)
    config = BlendConfig(rays_per_patch=side * side, stop_transmittance=stop, backend=backend)
    fast = blend(g, front_camera(64, 48), patch=side, config=config, dtype=DTYPE[backend])
    slow = blend(g, front_camera(64, 48), patch=side, config=replace(config, backend="reference"), dtype=torch.float64)
    assert (fast.alpha > 1 - 2 * stop).float().mean() > 0.2
    np.testing.assert_allclose(dense(fast), dense(slow), atol=1e-6)


def test_depths_are_sorted_stably(rng: np.random.Generator) -> None:
    for depths in (rng.random(1000), rng.integers(0, 30, 1000).astype(np.float64), np.ones(50), np.empty(0)):
        np.testing.assert_array_equal(_stable_order(depths), np.argsort(depths, kind="stable"))


def test_patches_with_a_ray_for_each_pixel_are_the_mean_of_their_pixels() -> None:
    g, camera = random_gaussians(200, 1), front_camera(60, 40)
    pixels = dense(blend(g, camera)).reshape(8, 5, 12, 5, -1).mean(axis=(1, 3)).reshape(96, -1)
    patches = dense(blend(g, camera, patch=5, config=BlendConfig(rays_per_patch=25)))
    np.testing.assert_allclose(patches, pixels, atol=1e-7)


def test_a_grid_that_is_no_whole_ratio_follows_the_affine_of_the_feature_map() -> None:
    """A 7×5 grid over 61×43 pixels: each cell's rays lie where the affine puts them, so alphas match the twin's."""
    g, camera = random_gaussians(300, 2), front_camera()
    grid, space = np.array([[7 / 61, 0, 0.1], [0, 5 / 43, -0.2]]), FeatureSpace(name="s", channels=1)
    like = FeatureMap(features=np.zeros((5, 7, 1), np.float32), grid_from_image=grid, space=space)
    fast = blend(g, camera, like=like)
    slow = blend(g, camera, like=like, config=BlendConfig(backend="reference"), dtype=torch.float64)
    assert fast.shape == (5, 7)
    np.testing.assert_allclose(dense(fast), dense(slow), atol=1e-6)


def test_a_reference_blend_multiplies_like_the_fast_one() -> None:
    g, camera = random_gaussians(150, 4), front_camera(20, 16)
    b = blend(g, camera, config=BlendConfig(backend="reference"), dtype=torch.float64)
    values = torch.randn(150, 20)
    torch.testing.assert_close(blend_torch.product(b.crow, b.col, b.weight, values.double()), b.render(values.double()))
    columns, crow, row, weight = blend_torch.transpose(b.crow, b.col, b.weight)
    for mine, twin in zip(b.transposed, (columns, crow, row, weight), strict=True):
        torch.testing.assert_close(mine, twin)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", EXTREMES)
def test_extremes_are_finite_and_right(name: str, backend: str) -> None:
    g, camera = EXTREMES[name], front_camera(24, 18)
    b = blend(g, camera, config=BlendConfig(backend=backend))
    expected, _, doubt = brute_force(g, camera)
    np.testing.assert_allclose(dense(b)[~doubt], expected[~doubt], atol=1e-4)
    for quantity in (b.alpha, b.depth, b.median_depth):
        assert torch.isfinite(quantity).all()
    assert b.render(torch.ones(len(g), 2)).shape == (24 * 18, 2)
    assert b.lift(torch.ones(b.rows, 2)).shape == (len(g), 2)


def test_wrong_knobs_and_views_are_refused_by_name() -> None:
    g, camera = one_gaussian(), front_camera()
    with pytest.raises(InputError, match="view: expected 0 to 0, got 5"):
        blend(g, camera, 5)
    with pytest.raises(InputError, match="rays_per_patch: expected a square"):
        blend(g, camera, patch=4, config=BlendConfig(rays_per_patch=5))
