"""The laws that make B useful: sums, adjoints, permutations, movements, ranges of depth."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from rooms import merged
from splats import EXTREMES, dense, front_camera, one_gaussian, random_gaussians, random_rotation

from gsencoder.core.errors import InputError
from gsencoder.render import BlendConfig, blend
from gsencoder.render.images import render_image


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
    assert torch.autograd.gradcheck(b.render, (values,), fast_mode=True)
    assert torch.autograd.gradgradcheck(b.render, (values,), fast_mode=True)


def test_lifting_codes_equals_lifting_their_one_hot_maps() -> None:
    b = blend(random_gaussians(150, 4), front_camera(20, 16))
    codes = torch.randint(-1, 5, (b.rows,), dtype=torch.int32)
    sums = torch.zeros(150, 5)
    b.lift_codes_into(codes, sums)
    one_hot = torch.nn.functional.one_hot(codes.long() + 1, 6)[:, 1:].float()
    torch.testing.assert_close(sums, b.lift(one_hot))


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
    quats = turned.as_quat()[:, [3, 0, 1, 2]].astype(np.float32)
    moved = replace(g, means=(g.means @ rotation.T + shift).astype(np.float32), quats=quats)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.T, -rotation.T @ shift
    seen = replace(camera, cam_from_world=pose[None].astype(np.float32))
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


def test_median_depth_is_where_half_the_light_is_lost() -> None:
    near, far = one_gaussian((0, 0, 1), 0.5, opacity=0.3), one_gaussian((0, 0, 4), 2.0, opacity=0.9)
    both = merged(near, far)
    b = blend(both, front_camera())
    assert float(b.median_depth[b.rows // 2]) == pytest.approx(4)
    assert float(blend(near, front_camera()).median_depth.max()) == 0
    with pytest.raises(InputError, match="one ray"):
        _ = blend(both, front_camera(), patch=4).median_depth


def test_dropping_small_weights_loses_at_most_its_bound() -> None:
    g, camera = random_gaussians(400, 9), front_camera()
    full, cut = blend(g, camera), blend(g, camera, config=BlendConfig(min_weight=0.01))
    assert float(cut.weight.min()) >= 0.01
    dropped = full.crow.diff() - cut.crow.diff()
    assert (full.alpha - cut.alpha <= dropped * 0.01 + 1e-6).all()
    assert int(dropped.sum()) > 0


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
    kept, part = (z >= least[row]) & (z <= most[row]), b.keep_between(least, most)
    assert 0 < len(part.col) < len(b.col)
    assert torch.equal(part.col, b.col[kept])
    assert torch.equal(part.weight, b.weight[kept])
    assert torch.equal(part.crow.diff(), torch.bincount(row[kept], minlength=b.rows))
    nothing = b.keep_between(torch.full((b.rows,), torch.inf), torch.zeros(b.rows))
    assert len(nothing.col) == 0
    assert nothing.crow.tolist() == [0] * (b.rows + 1)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
@pytest.mark.parametrize(("patch", "rays"), [(None, 1), (7, 16)])
def test_a_blend_of_a_range_of_depths_is_the_whole_one_with_the_entries_inside_it(backend, patch, rays, rng):
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
