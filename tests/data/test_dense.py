"""Plane sweeps and what is filled between them, on a wall whose depths are known."""

import numpy as np
import pytest
import torch
from walls import DEPTH, TILT, cameras, seen, wall_points, wall_views

from gsencoder.data.photographs import Photographs
from gsencoder.data.seeding.from_photographs import (
    DenseConfig,
    average_by_voxel,
    carve,
    covered_share,
    densify,
    interpolate,
    splat_depths,
)
from gsencoder.data.seeding.stereo import DepthMap, count_agreeing, source_views, sweep, window_mean, world_points

SMALL = DenseConfig(spacing=3.0, samples=1)


def pose(view: int, count: int = 4) -> torch.Tensor:
    return torch.from_numpy(cameras(count).cam_from_world[view])


@pytest.mark.parametrize(("size", "side"), [((1, 9), 5), ((7, 4), 3), ((40, 31), 5)])
def test_means_of_windows_are_those_of_pooling(size, side):
    maps = torch.rand(2, 3, *size, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    pooled = torch.nn.functional.avg_pool2d(maps, side, stride=1, padding=side // 2, count_include_pad=False)
    torch.testing.assert_close(window_mean(maps, side), pooled)


def test_a_sweep_finds_the_depth_of_a_slanted_wall():
    photographs = Photographs(wall_views())
    photos = [photographs.at_scale(view) for view in range(4)]
    estimate = sweep(photos[1], pose(1), [photos[0], photos[2], photos[3]], [pose(0), pose(2), pose(3)], 2.0, 5.0)
    truth = torch.from_numpy(seen(cameras(), 1)[1])
    known = (estimate.depth > 0) & (estimate.score > 0.8)
    assert known.float().mean() > 0.6
    error = ((estimate.depth - truth).abs() / truth)[known]
    assert error.median() < 0.01
    assert error.quantile(0.9) < 0.03


def test_depths_agree_where_they_are_true_and_nowhere_else():
    photographs = Photographs(wall_views())
    photos = [photographs.at_scale(view) for view in range(3)]
    truths = [torch.from_numpy(seen(cameras(), view)[1]) for view in range(3)]
    others = [
        (DepthMap(truths[view], torch.ones_like(truths[view]), truths[view]), photos[view], pose(view))
        for view in (0, 2)
    ]
    votes = count_agreeing(truths[1], photos[1], pose(1), others, 0.02)
    assert (votes[:, 16:-16] == 2).all()
    assert (count_agreeing(1.1 * truths[1], photos[1], pose(1), others, 0.02) == 0).all()
    assert (count_agreeing(0 * truths[1], photos[1], pose(1), others, 0.02) == 0).all()


def test_points_go_to_the_world_and_back():
    photographs = Photographs(wall_views())
    photo, truth = photographs.at_scale(2), torch.from_numpy(seen(cameras(), 2)[1])
    points = world_points(truth, photo, pose(2))
    torch.testing.assert_close(points[..., 2], DEPTH + TILT * points[..., 0])
    torch.testing.assert_close(splat_depths(points.reshape(-1, 3), photo, pose(2)), truth)


def test_views_that_share_points_at_a_good_angle_are_neighbors():
    made = cameras(6, step=0.2)
    neighbors = source_views(made, wall_points(200), range(6), 2)
    assert all(len(others) == 2 and view not in others for view, others in neighbors.items())
    assert 5 not in neighbors[0]
    alone = source_views(made, wall_points(200) + np.float32([0, 0, -100]), range(6), 2)
    assert all(others == [] for others in alone.values())


def test_holes_in_a_plane_are_filled_with_the_plane():
    truth = torch.from_numpy(seen(cameras(), 0)[1])
    holes = truth.clone()
    holes[20:40, 30:50] = 0
    filled = interpolate(holes)
    assert torch.equal(filled[holes > 0], truth[holes > 0])
    assert ((filled - truth).abs() / truth).max() < 0.05
    assert not interpolate(torch.zeros(5, 7)).any()


def test_a_voxel_gives_the_mean_of_enough_samples_and_nothing_beside_others():
    points = np.array([[0.1, 0.1, 0.1], [0.3, 0.1, 0.1], [5.5, 0, 0], [9.1, 0, 0], [9.3, 0, 0]], np.float32)
    colors = np.array([[0] * 3, [10] * 3, [20] * 3, [30] * 3, [40] * 3], np.uint8)
    places, tints = average_by_voxel(points, colors, 1.0, 2)
    np.testing.assert_allclose(places, [[0.2, 0.1, 0.1], [9.2, 0, 0]], atol=1e-6)
    assert tints.tolist() == [[5] * 3, [35] * 3]
    places, _ = average_by_voxel(points, colors, 1.0, 2, occupied=np.array([[9.9, 0.5, 0.5]], np.float32))
    np.testing.assert_allclose(places, [[0.2, 0.1, 0.1]], atol=1e-6)
    assert average_by_voxel(points[:0], colors[:0], 1.0, 1)[0].shape == (0, 3)


def test_what_stands_in_the_way_is_carved_out():
    photographs = Photographs(wall_views())
    photos = {view: photographs.at_scale(view) for view in range(4)}
    depths = {view: torch.from_numpy(seen(cameras(), view)[1]) for view in range(4)}
    poses = {view: pose(view) for view in range(4)}
    on = np.array([[0.2, 0.1, DEPTH + 0.2 * TILT], [0.0, 0.0, DEPTH]], np.float32)
    floating, hidden, elsewhere = ([[0.2, 0.1, 2.0]], [[0.2, 0.1, 4.0]], [[50.0, 0.0, 2.0]])
    points = np.concatenate((on, np.array(floating + hidden + elsewhere, np.float32)))
    colors = np.arange(15, dtype=np.uint8).reshape(5, 3)
    remaining, tints = carve(points, colors, depths, photos, poses)
    np.testing.assert_array_equal(remaining, points[[0, 1, 3, 4]])
    np.testing.assert_array_equal(tints, colors[[0, 1, 3, 4]])
    unknown = {view: torch.zeros_like(depth) for view, depth in depths.items()}
    assert len(carve(points, colors, unknown, photos, poses)[0]) == 5


def test_few_points_on_a_wall_become_many_that_lie_on_it():
    photographs, points = Photographs(wall_views()), wall_points()
    cloud = densify(photographs, range(4), points, np.full((len(points), 3), 128, np.uint8), SMALL)
    # What fewer than three of the views show stays bare.
    assert cloud.coverage[0] < 0.2 < 0.65 < cloud.coverage[1]
    assert cloud.swept > 500
    new = cloud.points[len(points) :]
    off = np.abs(new[:, 2] - DEPTH - TILT * new[:, 0]) / DEPTH
    assert np.median(off) < 0.01
    assert np.quantile(off, 0.95) < 0.05


def test_points_that_cover_the_pictures_are_left_alone():
    points = wall_points(20_000)
    assert covered_share(Photographs(wall_views()), range(4), points) > 0.95
    assert densify(Photographs(wall_views()), range(4), points, np.zeros((len(points), 3), np.uint8), SMALL) is None
