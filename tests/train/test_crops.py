"""Which Gaussians a sample holds."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from splats import front_camera

from gsencoder.core.errors import InputError
from gsencoder.render import blend
from gsencoder.train.samples import (
    SamplingConfig,
    choose_crop,
    crop_size,
    drop_random,
    in_frusta,
    nearest_rows,
    seen_by,
)
from gsencoder.types import Cameras, Gaussians

RNG = np.random.default_rng


def test_the_frustum_of_a_camera_is_what_its_pixels_look_at() -> None:
    camera = front_camera()
    points = np.random.default_rng(0).uniform(-4, 4, (2000, 3)).astype(np.float32)
    pose, K = camera.cam_from_world[0].astype(np.float64), camera.Ks[0]
    x, y, z = (points.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]).T
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]
    expected = (z > 0.01) & (u >= 0) & (u < camera.widths[0]) & (v >= 0) & (v < camera.heights[0])
    inside = in_frusta(points, camera)
    assert (inside == expected).mean() > 0.999  # Rounding may move a point on the border.
    assert 0 < inside.sum() < len(points)


def test_the_union_of_frusta_is_what_any_camera_sees() -> None:
    one = front_camera()
    turned = one.cam_from_world.copy()
    turned[0, :3, :3] = np.diag([1, -1, -1]).astype(np.float32) @ turned[0, :3, :3]
    two = type(one)(
        cam_from_world=np.concatenate((one.cam_from_world, turned)),
        Ks=np.repeat(one.Ks, 2, axis=0),
        widths=np.repeat(one.widths, 2),
        heights=np.repeat(one.heights, 2),
    )
    points = np.random.default_rng(1).uniform(-4, 4, (500, 3)).astype(np.float32)
    both = in_frusta(points, two.select([0])) | in_frusta(points, two.select([1]))
    assert np.array_equal(in_frusta(points, two), both)


def test_almost_nothing_that_a_view_shows_lies_outside_its_frustum() -> None:
    """Small Gaussians whose center lies beside the picture reach into it at its edge alone."""
    camera = front_camera()
    rng = np.random.default_rng(2)
    cloud = Gaussians(
        means=rng.uniform(-3, 3, (3000, 3)).astype(np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (3000, 1)),
        scales=np.full((3000, 3), 0.02, np.float32),
        opacities=np.full(3000, 0.9, np.float32),
        sh=np.zeros((3000, 1, 3), np.float32),
    )
    b = blend(cloud, camera)
    inside = in_frusta(cloud.means, camera)
    weight_inside = b.weight[inside[b.col.numpy()]].sum()
    assert weight_inside > 0.9 * b.weight.sum()


@given(st.integers(1, 50), st.integers(1, 60))
def test_a_crop_holds_the_nearest(count: int, wanted: int) -> None:
    means = RNG(count).normal(size=(count, 3)).astype(np.float32)
    rows = nearest_rows(means, means[0], wanted)
    assert len(rows) == min(count, wanted)
    assert (np.diff(rows) > 0).all()
    distances = np.linalg.norm(means - means[0], axis=1)
    outside = np.setdiff1d(np.arange(count), rows)
    if len(outside):
        assert distances[rows].max() <= distances[outside].min() + 1e-6


def cameras(count: int) -> Cameras:
    """Cameras in a row that look along +z."""
    one = front_camera()
    poses = np.repeat(one.cam_from_world, count, axis=0)
    poses[:, 0, 3] = -10.0 * np.arange(count)
    return Cameras(
        cam_from_world=poses,
        Ks=np.repeat(one.Ks, count, axis=0),
        widths=np.repeat(one.widths, count),
        heights=np.repeat(one.heights, count),
    )


def cloud(count: int = 1000, places: int = 1) -> np.ndarray:
    """Points before the first cameras of a row."""
    points = RNG(0).uniform(-1, 1, (count, 3)) + np.array([0, 0, 3])
    points[:, 0] += 10 * (np.arange(count) % places)
    return points.astype(np.float32)


def test_without_a_limit_a_sample_is_all_that_its_views_see() -> None:
    points, row = cloud(1000, 4), cameras(4)
    config = SamplingConfig(views=2, gaussians=0)
    views, rows = choose_crop(points, row, np.ones(1000, np.float32), config, 0, RNG(0))
    assert len(set(views)) == 2
    assert np.array_equal(rows, np.flatnonzero(in_frusta(points, row.select(views))))


def test_the_views_of_a_crop_look_at_its_center() -> None:
    points, row = cloud(1000, 4), cameras(4)
    for seed in range(8):
        config = SamplingConfig(views=2)
        views, rows = choose_crop(points, row, np.ones(1000, np.float32), config, 50, RNG(seed))
        assert len(views) == 1  # No other camera of the row sees the same place.
        assert len(rows) == 50
        assert in_frusta(points[rows], row.select(views)).all()
        assert (np.diff(rows) > 0).all()


def test_a_crop_holds_the_gaussians_nearest_to_its_center_that_the_views_see() -> None:
    points, camera = cloud(), front_camera()
    chances = np.zeros(1000, np.float32)
    visible = np.flatnonzero(in_frusta(points, camera))
    chances[visible[7]] = 1
    config = SamplingConfig(views=1, rare_centers=1.0)
    _, rows = choose_crop(points, camera, chances, config, 20, RNG(0))
    distances = np.linalg.norm(points[visible] - points[visible[7]], axis=1)
    assert set(rows) == set(visible[np.argsort(distances)[:20]])


def test_a_rare_target_is_often_the_center_of_a_crop() -> None:
    points, camera = cloud(), front_camera()
    chances = np.full(1000, 1e-3, np.float32)
    visible = np.flatnonzero(in_frusta(points, camera))
    chances[visible[0]] = 1e3
    config = SamplingConfig(views=1, rare_centers=1.0)
    for seed in range(5):
        assert visible[0] in choose_crop(points, camera, chances, config, 5, RNG(seed))[1]


def test_where_no_gaussian_has_a_target_any_may_be_the_center() -> None:
    config = SamplingConfig(views=1)
    assert len(choose_crop(cloud(), cameras(1), np.zeros(1000, np.float32), config, 5, RNG(0))[1])


def test_the_whole_scene_may_be_taken() -> None:
    config = SamplingConfig(scope="scene")
    for size, expected in ((0, 100), (30, 30), (500, 100)):
        assert len(choose_crop(cloud(100), cameras(2), np.ones(100, np.float32), config, size, RNG(0))[1]) == expected


def test_a_camera_that_looks_into_the_void_gives_way_to_one_that_sees_something() -> None:
    points, row = cloud(50), cameras(3)  # All before the first camera.
    for size in (0, 5):
        for seed in range(6):
            views, rows = choose_crop(points, row, np.ones(50, np.float32), SamplingConfig(views=1), size, RNG(seed))
            assert len(rows)
            assert 0 in views


def test_one_point_is_seen_by_the_cameras_in_whose_frusta_it_lies() -> None:
    row, points = cameras(4), cloud(60, 4)
    for point in points:
        expected = [bool(in_frusta(point[None], row.select([view]))[0]) for view in range(4)]
        assert seen_by(point, row).tolist() == expected


def test_a_scene_behind_its_cameras_is_an_error() -> None:
    behind = cloud(10) - np.array([0, 0, 9], np.float32)
    for size in (0, 5):
        with pytest.raises(InputError, match="no Gaussian lies in the frustum of any view"):
            choose_crop(behind, cameras(2), np.ones(10, np.float32), SamplingConfig(), size, RNG(0))


@given(st.integers(1, 40), st.floats(0, 0.9), st.integers(0, 50))
def test_thinning_out_leaves_something(count: int, most: float, seed: int) -> None:
    rows = np.arange(count) * 2
    remaining = drop_random(rows, most, RNG(seed))
    assert len(remaining) >= 1
    assert np.isin(remaining, rows).all()


def test_crops_are_of_sizes_in_equal_ratios() -> None:
    config = SamplingConfig(gaussians=400, smallest=25)
    sizes = [crop_size(config, RNG(seed)) for seed in range(99)]
    assert min(sizes) >= 25
    assert max(sizes) <= 400
    assert 70 < np.median(sizes) < 140  # 100 is as far from 25 as from 400.
    assert crop_size(SamplingConfig(gaussians=400, smallest=0), RNG(0)) == 400
    assert crop_size(SamplingConfig(gaussians=0), RNG(0)) == 0


@pytest.mark.parametrize("change", [{"views": 0}, {"gaussians": -1}, {"rare_centers": 1.2}, {"smallest": -5}])
def test_sizes_out_of_range_are_refused(change: dict) -> None:
    with pytest.raises(InputError, match=next(iter(change))):
        replace(SamplingConfig(), **change)
