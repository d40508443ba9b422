"""What views show by a few rays, against B; and the order of views by what they show."""

from dataclasses import replace

import numpy as np
import pytest
from fixed_teachers import EXACT, FixedTeacher, make_scene
from scipy.sparse import csr_array

from gsencoder.fusion import lift
from gsencoder.fusion.budget import bisection_order, map_at_rays, mean_turn
from gsencoder.fusion.fuse import fuse
from gsencoder.fusion.lift import VisibilityConfig, coverage_order, covering_views, keep_visible, sample_view
from gsencoder.render import BlendConfig, blend
from gsencoder.render.blend_cpu import strided_lattice

OPEN = VisibilityConfig(against=())


@pytest.mark.parametrize("depth", [False, True])
def test_sampled_rays_have_the_weights_of_b_at_their_pixels(depth, rng, monkeypatch):
    monkeypatch.setattr(lift, "RAYS", 100)
    depths = [rng.uniform(1.5, 3.0, (24, 33)).astype(np.float32) for _ in range(5)]
    masks = [rng.uniform(size=(24, 33)) > 0.3 for _ in range(5)]
    scene = make_scene(n=400, masks=masks, **({"depths": depths} if depth else {}))
    config = BlendConfig(stop_transmittance=1e-6)
    visibility = VisibilityConfig(against=("sensor",), relative=0.2) if depth else OPEN
    sampled = sample_view(scene.gaussians, scene.views, 2, visibility, config)
    b = blend(scene.gaussians, scene.views.cameras, 2, config=config)
    b = keep_visible(b, depths[2][:, :32], visibility) if depth else b
    assert sampled.shape == (8, 10)
    assert len(sampled.col) > 50
    full, part = (
        csr_array((each.weight.numpy(), each.col.numpy(), each.crow.numpy()), (each.rows, each.gaussians)).toarray()
        for each in (b, sampled)
    )
    pixels = full.reshape(24, 32, -1)[1:24:3, 1:30:3].reshape(80, -1)
    share = masks[2][1:24:3, 1:30:3].reshape(80, 1)
    np.testing.assert_allclose(part, pixels * share, rtol=1e-4, atol=1e-6)


def test_the_first_views_cover_most_and_one_that_adds_nothing_comes_last() -> None:
    seen = np.array([[1, 1, 0, 0, 0], [0, 0, 0, 0, 0], [1, 1, 1, 0, 0], [0, 0, 0, 1, 1]], bool)
    # Once all are seen, the first view shows two of them a second time.
    assert coverage_order(seen).tolist() == [2, 3, 0, 1]
    assert coverage_order(seen, first=(1,)).tolist() == [1, 2, 3, 0]
    assert coverage_order(np.zeros((3, 4), bool)).tolist() == [0, 1, 2]


def test_a_view_of_the_same_gaussians_comes_after_one_that_shows_another() -> None:
    seen = np.array([[1, 1, 1, 0], [1, 1, 1, 0], [0, 0, 0, 1]], bool)
    assert coverage_order(seen).tolist() == [0, 2, 1]


def test_views_by_coverage_see_more_than_evenly_spaced_ones() -> None:
    """All but two cameras stand together and look at one end; evenly spaced ones are of these."""
    scene = make_scene(n=600, count=9)
    poses = scene.views.cameras.cam_from_world.copy()
    poses[:, 0, 3] = 2.0
    poses[[3, 5], 0, 3] = [0.0, -2.0]
    scene = replace(scene, views=replace(scene.views, cameras=replace(scene.views.cameras, cam_from_world=poses)))
    teacher = FixedTeacher([np.ones((6, 8, 6), np.float32)] * 9)
    even, covering = (
        fuse(scene, teacher, replace(EXACT, views=3, view_choice=choice)) for choice in ("even", "coverage")
    )
    assert covering.features.seen.sum() > even.features.seen.sum()
    assert {3, 5} <= set(covering.views)


def test_all_views_need_no_choice_and_rows_are_those_that_are_given() -> None:
    scene, teacher = make_scene(), FixedTeacher([np.ones((6, 8, 6), np.float32)] * 5)
    assert covering_views(scene.gaussians, scene.views, OPEN, BlendConfig(), 9) == (0, 1, 2, 3, 4)
    of_rows, even = fuse(scene, teacher, EXACT, rows=(0, 2, 4)), fuse(scene, teacher, replace(EXACT, views=3))
    assert of_rows.views == even.views == (0, 2, 4)
    np.testing.assert_array_equal(of_rows.features.features, even.features.features)


def test_views_in_the_order_of_bisection_are_spread_however_many_are_taken() -> None:
    for count in (1, 2, 7, 24, 97):
        order = bisection_order(count)
        assert sorted(order) == list(range(count))
        for taken in range(1, count + 1):
            gaps = np.diff([-1, *sorted(order[:taken]), count])
            assert gaps.max() <= 2 * count / taken + 2


def test_what_a_map_shows_at_rays_is_the_cell_that_each_ray_meets_and_nothing_outside() -> None:
    teacher = FixedTeacher([np.arange(6 * 8 * 6, dtype=np.float32).reshape(6, 8, 6)], stride=4)
    scene = make_scene()
    feature_map = teacher.feature_map(scene.views, 0)
    lattice = strided_lattice(40, 24, 3)  # The map ends after 32 pixels.
    at_rays = map_at_rays(feature_map, lattice)
    assert (at_rays.height, at_rays.width) == (lattice.height, lattice.width)
    for line in range(lattice.height):
        for column in range(lattice.width):
            x, y = int(lattice.x0 + 3 * column) // 4, int(lattice.y0 + 3 * line) // 4
            assert at_rays.has_vector[line, column] == (x < 8)
            if x < 8:
                np.testing.assert_array_equal(at_rays.features[line, column], feature_map.features[y, x])


def test_the_turn_of_means_is_that_of_independent_vectors(rng: np.random.Generator) -> None:
    """Vectors of length 1 with noise of variance s² in D dimensions: 1 − cosine is about D s² / 2 (1/k − 1/K)."""
    maps, count, channels, noise = 8, 4000, 12, 0.05
    common = rng.normal(size=(count, channels))
    common /= np.linalg.norm(common, axis=1, keepdims=True)
    sums = common + noise * rng.normal(size=(maps, count, channels))
    weights, means = np.ones((maps, count)), np.zeros((maps, channels))
    # Perpendicular to the vector, the noise has one dimension less.
    expected = (channels - 1) * noise**2 / 2
    assert mean_turn(sums, weights, means, range(maps)) == pytest.approx(expected, rel=0.05)
    # Halves of a recording that differ count, though neighbors are alike.
    drifting = sums + np.linspace(-0.4, 0.4, maps)[:, None, None] * rng.normal(size=(count, channels))
    assert mean_turn(drifting, weights, means, range(maps)) > 10 * expected
    assert mean_turn(sums[:1], weights[:1], means[:1], [0]) == 1
