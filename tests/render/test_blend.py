"""B against an implementation of its definition that shares no code with it, and the laws that make it useful."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from splats import front_camera, one_gaussian, random_gaussians, random_rotation

from gsencoder.core.errors import InputError
from gsencoder.render import Blend, BlendConfig, blend
from gsencoder.render.blend_cpu import _stable_order
from gsencoder.render.images import render_image
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


def dense(b: Blend) -> np.ndarray:
    out = np.zeros((b.rows, b.gaussians))
    row = np.repeat(np.arange(b.rows), b.crow.diff().numpy())
    out[row, b.col.numpy()] = b.weight.numpy()
    return out


BACKENDS = ["cpu", "torch", "reference"]
# The numba backend computes in float64 and stores float32; the others are asked for float64, so that all decide alike.
DTYPE = {"cpu": torch.float32, "torch": torch.float64, "reference": torch.float64}
FAST = ["cpu", "torch"]


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("log_scale", [-4.0, -2.5, -0.5])
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
@pytest.mark.parametrize("rays", [1, 4, 9, 49])
def test_the_fast_backends_agree_with_their_float64_twin_on_patches(rays: int, backend: str) -> None:
    g, camera = random_gaussians(400, 5), front_camera(90, 70)
    config = BlendConfig(rays_per_patch=rays, backend=backend)
    fast = blend(g, camera, patch=7, config=config, dtype=DTYPE[backend])
    slow = blend(g, camera, patch=7, config=replace(config, backend="reference"), dtype=torch.float64)
    np.testing.assert_allclose(dense(fast), dense(slow), atol=1e-6)


@pytest.mark.parametrize("backend", FAST)
@pytest.mark.parametrize("side", [1, 2, 4])
@pytest.mark.parametrize("stop", [1e-4, 0.1])
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
    space = FeatureSpace(name="s", channels=1)
    like = FeatureMap(
        features=np.zeros((5, 7, 1), np.float32),
        grid_from_image=np.array([[7 / 61, 0, 0.1], [0, 5 / 43, -0.2]]),
        space=space,
    )
    fast = blend(g, camera, like=like)
    slow = blend(g, camera, like=like, config=BlendConfig(backend="reference"), dtype=torch.float64)
    assert fast.shape == (5, 7)
    np.testing.assert_allclose(dense(fast), dense(slow), atol=1e-6)


def test_rows_are_depth_ordered_and_sum_to_alpha() -> None:
    b = blend(random_gaussians(500, 3), front_camera())
    z = b.depths[b.col.long()].numpy()
    starts = set(b.crow.tolist())
    falls = np.flatnonzero(np.diff(z) < 0) + 1
    assert all(int(at) in starts for at in falls)
    assert float(b.alpha.max()) <= 1 + 1e-6
    assert float(b.weight.min()) > 0


@pytest.mark.slow
def test_render_and_lift_are_adjoint_and_each_is_the_others_gradient() -> None:
    b = blend(random_gaussians(150, 4), front_camera(20, 16))
    values = torch.randn(150, 3, dtype=torch.float64, requires_grad=True)
    maps = torch.randn(b.rows, 3, dtype=torch.float64, requires_grad=True)
    left, right = (b.render(values) * maps).sum(), (b.lift(maps) * values).sum()
    torch.testing.assert_close(left, right)
    (grad_values,) = torch.autograd.grad(left, values)
    (grad_maps,) = torch.autograd.grad(right, maps)
    torch.testing.assert_close(grad_values, b.lift(maps.detach()))
    torch.testing.assert_close(grad_maps, b.render(values.detach()))
    assert torch.autograd.gradcheck(b.render, (values,))
    assert torch.autograd.gradgradcheck(b.render, (values,))


def test_lifting_codes_equals_lifting_their_one_hot_maps() -> None:
    b = blend(random_gaussians(150, 4), front_camera(20, 16))
    codes = torch.randint(-1, 5, (b.rows,), dtype=torch.int32)
    sums = torch.zeros(150, 5)
    b.lift_codes_into(codes, sums)
    one_hot = torch.nn.functional.one_hot(codes.long() + 1, 6)[:, 1:].float()
    torch.testing.assert_close(sums, b.lift(one_hot))


def test_lift_into_touches_only_the_columns_that_occur() -> None:
    b = blend(random_gaussians(300, 4, center=(0, 0, 0)), front_camera(20, 16))
    sums = torch.full((300, 2), 7.0)
    b.lift_into(torch.ones(b.rows, 2), sums)
    unseen = np.setdiff1d(np.arange(300), b.columns.numpy())
    assert len(unseen) > 50
    assert (sums[unseen] == 7).all()
    torch.testing.assert_close(sums[b.columns, 0] - 7, b.lift(torch.ones(b.rows))[b.columns], rtol=1e-4, atol=1e-5)


def test_a_reference_blend_multiplies_like_the_fast_one() -> None:
    g, camera = random_gaussians(150, 4), front_camera(20, 16)
    b = blend(g, camera, config=BlendConfig(backend="reference"), dtype=torch.float64)
    values = torch.randn(150, 20)
    from gsencoder.render import reference

    torch.testing.assert_close(reference.product(b.crow, b.col, b.weight, values.double()), b.render(values.double()))
    columns, crow, row, weight = reference.transpose(b.crow, b.col, b.weight)
    for mine, twin in zip(b.transposed, (columns, crow, row, weight), strict=True):
        torch.testing.assert_close(mine, twin)


def test_permuting_gaussians_permutes_columns() -> None:
    g, camera = random_gaussians(200, 6), front_camera()
    order = np.random.default_rng(0).permutation(len(g))
    np.testing.assert_allclose(dense(blend(g.select(order), camera)), dense(blend(g, camera))[:, order], atol=1e-7)


def test_moving_scene_and_camera_together_changes_nothing() -> None:
    g, camera = random_gaussians(200, 7), front_camera()
    from scipy.spatial.transform import Rotation

    rotation = random_rotation(np.random.default_rng(1))
    shift = np.array([0.5, -1.0, 2.0])
    turned = Rotation.from_matrix(rotation) * Rotation.from_quat(g.quats[:, [1, 2, 3, 0]])
    moved = Gaussians(
        means=(g.means @ rotation.T + shift).astype(np.float32),
        quats=turned.as_quat()[:, [3, 0, 1, 2]].astype(np.float32),
        scales=g.scales,
        opacities=g.opacities,
        sh=g.sh,
    )
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.T, -rotation.T @ shift
    seen = Cameras(
        cam_from_world=pose[None].astype(np.float32), Ks=camera.Ks, widths=camera.widths, heights=camera.heights
    )
    difference = np.abs(dense(blend(moved, seen)) - dense(blend(g, camera))).max(axis=1)
    assert np.quantile(difference, 0.98) < 1e-4


def test_reruns_give_the_same_bits_on_any_number_of_threads() -> None:
    g, camera = random_gaussians(500, 8), front_camera()
    threads = torch.get_num_threads()
    results = []
    try:
        for count in (1, 2, 1):
            torch.set_num_threads(count)
            b = blend(g, camera)
            results.append((b.col, b.weight, b.lift(torch.arange(b.rows).float())))
    finally:
        torch.set_num_threads(threads)
    for other in results[1:]:
        assert all(torch.equal(mine, theirs) for mine, theirs in zip(results[0], other, strict=True))


def test_coincident_gaussians_keep_their_order() -> None:
    one = one_gaussian(opacity=0.3)
    many = one.select(np.zeros(3000, np.int64))
    b = blend(many, front_camera())
    middle = b.rows // 2
    cols = b.col[b.crow[middle] : b.crow[middle + 1]]
    assert len(cols) > 10
    assert torch.equal(cols, torch.arange(len(cols), dtype=torch.int32))


def test_median_depth_is_where_half_the_light_is_lost() -> None:
    near, far = one_gaussian((0, 0, 1), 0.5, opacity=0.3), one_gaussian((0, 0, 4), 2.0, opacity=0.9)
    both = Gaussians(
        **{name: np.concatenate((getattr(near, name), getattr(far, name))) for name in Gaussians.__dataclass_fields__}
    )
    b = blend(both, front_camera())
    assert float(b.median_depth[b.rows // 2]) == pytest.approx(4)
    assert float(blend(near, front_camera()).median_depth.max()) == 0
    with pytest.raises(InputError, match="one ray"):
        _ = blend(both, front_camera(), patch=4).median_depth


def test_dropping_small_weights_loses_at_most_what_it_promises() -> None:
    g, camera = random_gaussians(400, 9), front_camera()
    full, cut = blend(g, camera), blend(g, camera, config=BlendConfig(min_weight=0.01))
    assert float(cut.weight.min()) >= 0.01
    dropped = full.crow.diff() - cut.crow.diff()
    assert (full.alpha - cut.alpha <= dropped * 0.01 + 1e-6).all()
    assert int(dropped.sum()) > 0


EXTREMES = {
    "an empty view": random_gaussians(50, 0, center=(0, 0, -30)),
    "no Gaussians": random_gaussians(0),
    "one Gaussian": one_gaussian(),
    "scales of 1e-9": one_gaussian(scale=1e-9),
    "scales of 1e4": one_gaussian(scale=1e4),
    "opacity 0": one_gaussian(opacity=0.0),
    "opacity 1": one_gaussian(opacity=1.0),
    "on the camera": one_gaussian((0, 0, 0)),
    "at the near plane": one_gaussian((0, 0, 0.01001), scale=1.0),
    "a needle": one_gaussian((0.2, 0.1, 2), (1.0, 1e-6, 1e-6)),
    "a disc edge-on": one_gaussian((0.0, 0.0, 2), (1.0, 1e-6, 1.0)),
    "far away": one_gaussian((0, 0, 1e6), scale=1e4),
}


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


@pytest.mark.parametrize("backend", BACKENDS)
def test_an_image_of_one_pixel_works(backend: str) -> None:
    g, camera = one_gaussian(), front_camera(1, 1)
    b = blend(g, camera, config=BlendConfig(backend=backend))
    assert float(b.alpha) == pytest.approx(0.8, abs=1e-4)


def test_non_unit_quaternions_within_tolerance_are_normalised_by_both_backends() -> None:
    g = random_gaussians(100, 2)
    stretched = replace(g, quats=g.quats * np.float32(1.0005))
    np.testing.assert_allclose(dense(blend(stretched, front_camera())), dense(blend(g, front_camera())), atol=1e-5)


@pytest.mark.parametrize("magnitude", [1e-8, 1e6])
def test_rendering_scales_with_the_values(magnitude: float) -> None:
    b = blend(random_gaussians(100, 2), front_camera())
    values = torch.randn(100, 4)
    torch.testing.assert_close(
        b.render(values * magnitude), b.render(values) * magnitude, rtol=1e-4, atol=1e-5 * magnitude
    )


def test_wrong_knobs_and_views_are_refused_by_name() -> None:
    g, camera = one_gaussian(), front_camera()
    with pytest.raises(InputError, match="view: expected 0 to 0, got 5"):
        blend(g, camera, 5)
    with pytest.raises(InputError, match="rays_per_patch: expected a square"):
        blend(g, camera, patch=4, config=BlendConfig(rays_per_patch=5))
    with pytest.raises(InputError, match="min_weight"):
        BlendConfig(min_weight=1.5)
    with pytest.raises(InputError, match="stop_transmittance"):
        BlendConfig(stop_transmittance=0.0)


def test_a_white_wall_renders_white_and_the_background_shows_beside_it() -> None:
    wall = replace(one_gaussian((0, 0, 2), 5.0, opacity=1.0), sh=np.full((1, 1, 3), 10, np.float32))
    picture = render_image(wall, front_camera(), 0)
    assert picture[20, 30].tolist() == [255, 255, 255]
    empty = render_image(EXTREMES["an empty view"], front_camera(), 0, background=(0.0, 1.0, 0.0))
    assert (empty == [0, 255, 0]).all()


def test_keeping_a_range_of_depths_is_keeping_the_entries_inside_it(rng: np.random.Generator) -> None:
    b = blend(random_gaussians(200), front_camera(), 0)
    least = torch.from_numpy(rng.uniform(1, 4, b.rows).astype(np.float32))
    most = least + torch.from_numpy(rng.uniform(-0.5, 2, b.rows).astype(np.float32))
    row = torch.repeat_interleave(torch.arange(b.rows), b.crow.diff())
    z = b.depths[b.col.long()]
    expected, kept = b.keep((z >= least[row]) & (z <= most[row])), b.keep_between(least, most)
    assert 0 < len(kept.col) < len(b.col)
    for name in ("crow", "col", "weight"):
        assert torch.equal(getattr(kept, name), getattr(expected, name))
    nothing = b.keep_between(torch.full((b.rows,), torch.inf), torch.zeros(b.rows))
    assert len(nothing.col) == 0
    assert nothing.crow.tolist() == [0] * (b.rows + 1)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
@pytest.mark.parametrize(("patch", "rays"), [(None, 1), (4, 1), (4, 9), (7, 16)])
def test_a_blend_of_a_range_of_depths_is_the_whole_one_with_the_entries_inside_it(
    backend: Any, patch: int | None, rays: int, rng: np.random.Generator
) -> None:
    config = BlendConfig(rays_per_patch=rays, backend=backend)
    gaussians, camera = random_gaussians(400), front_camera(61, 40)
    whole = blend(gaussians, camera, patch=patch, config=config)
    least = rng.uniform(1, 3, whole.rows).astype(np.float32)
    most = least + rng.uniform(-0.5, 1.5, whole.rows).astype(np.float32)
    # Nothing was measured in some rows, every depth passes in others, and some end exactly at a Gaussian.
    most[::5], least[::7], most[::7] = -np.inf, -np.inf, np.inf
    most[3::11] = whole.depths.numpy()[whole.col.numpy()][rng.integers(0, len(whole.col), len(most[3::11]))]
    expected = whole.keep_between(torch.from_numpy(least), torch.from_numpy(most))
    assert 0 < len(expected.col) < len(whole.col) / 2
    b = blend(gaussians, camera, patch=patch, between=(least, most), config=config)
    for name in ("crow", "col", "weight", "depths"):
        assert torch.equal(getattr(b, name), getattr(expected, name))
