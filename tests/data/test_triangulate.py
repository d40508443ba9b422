"""Points, depths and seeds of posed photographs that came without any, on walls whose depths are known."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from walls import DEPTH, TILT, cameras, seen, wall_points, wall_views

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.orbits import looking_cameras
from gsencoder.data.photographs import Photographs
from gsencoder.data.scenes import SceneConfig, load_scene
from gsencoder.data.seeding.from_photographs import (
    DenseConfig,
    average_by_voxel,
    carve,
    covered_share,
    densify,
    interpolate,
    seed_from_photographs,
    seeds_of_photographs,
    splat_depths,
)
from gsencoder.data.seeding.matches import triangulate, typical_distance
from gsencoder.data.seeding.seed import SeedConfig, choose_source, seed
from gsencoder.data.seeding.stereo import DepthMap, count_agreeing, source_views, sweep, window_mean, world_points
from gsencoder.types import Scene


def off_wall(points: np.ndarray) -> np.ndarray:
    """Distances from the wall."""
    return np.abs(points[:, 2] - DEPTH - TILT * points[:, 0]) / np.hypot(1, TILT)


def test_parallel_cameras_look_ten_baselines_away_and_one_camera_one_unit():
    centers = np.stack((0.2 * np.arange(5.0), np.zeros(5), np.zeros(5)), axis=1)
    forward = np.tile([0.0, 1.0, 0.0], (5, 1))
    row = looking_cameras(centers, forward, np.array([0.0, 0, 1]), width=64, height=48, focal=60.0)
    assert typical_distance(row) == pytest.approx(2.0, rel=1e-5)
    assert typical_distance(row.select([0])) == 1.0
    assert typical_distance(row.select([0, 0])) == 1.0


def test_points_of_a_wall_lie_on_it_and_masked_pixels_give_none():
    points, colors = triangulate(wall_views(4))
    assert len(points) > 20
    assert np.median(off_wall(points)) < 0.05
    again = triangulate(wall_views(4))
    np.testing.assert_array_equal(points, again[0])
    np.testing.assert_array_equal(colors, again[1])
    assert not len(triangulate(replace(wall_views(4), masks=[np.zeros((72, 96), bool)] * 4))[0])


def test_photographs_that_do_not_fit_their_poses_are_warned_of():
    views = wall_views(8)
    poses = views.cameras.cam_from_world.copy()
    poses[:, [0, 1], 3] = poses[:, [1, 0], 3]  # The cameras went along x, and the poses say along y.
    wrong = replace(views, cameras=replace(views.cameras, cam_from_world=poses))
    with pytest.warns(SceneWarning, match=r"do not seem to fit their poses: of [0-9,]+ matched features [0-9]+ lie on"):
        triangulate(wrong)


def test_a_scene_without_depth_and_points_is_seeded_from_its_photographs():
    views = wall_views(4)
    scene = Scene(name="wall", views=replace(views, depths=None))
    assert choose_source(scene) == "photographs"
    made = seed(scene)
    assert len(made) > 300
    assert np.median(off_wall(made.means)) < 0.05
    assert choose_source(replace(scene, sfm_points=wall_points())) == "points"
    assert choose_source(scene, SeedConfig(source="depth")) == "depth"


def test_one_photograph_and_views_that_look_away_from_each_other_are_refused(no_jaxtyping):
    with pytest.raises(InputError, match="1 photograph without depth and points says nothing about where surfaces are"):
        seed(Scene(name="one", views=wall_views(1)), SeedConfig(source="photographs"))
    views = wall_views(4)
    turns = np.pi / 2 * np.arange(4)
    outward = np.stack((np.cos(turns), np.sin(turns), np.zeros(4)), axis=1)
    away = looking_cameras(3 * outward, outward, np.array([0.0, 0, 1]), width=96, height=72, focal=80.0)
    with pytest.raises(InputError, match="no two of the 4 photographs show the same surface from different places"):
        seed_from_photographs(replace(views, cameras=away))


@pytest.mark.slow
def test_a_room_is_seeded_on_its_surfaces_although_few_features_match(shared):
    scene = load_scene(shared / "scenes" / "house" / "train_041", options=SceneConfig(max_views=8))
    made = seeds_of_photographs(Photographs(scene.views), replace(scene.views, depths=None))
    assert len(made.points) > 1000
    distance = cKDTree(seed(scene).means).query(made.points)[0]
    assert np.median(distance) < 0.04


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
    maps = [DepthMap(truth, torch.ones_like(truth), truth) for truth in truths]
    others = [(maps[view], photos[view], pose(view)) for view in (0, 2)]
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
