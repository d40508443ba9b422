"""Points and seeds of posed photographs that came without any."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from walls import DEPTH, TILT, wall_points, wall_views

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.orbits import looking_cameras
from gsencoder.data.photographs import Photographs
from gsencoder.data.scenes import SceneConfig, load_scene
from gsencoder.data.seeding.from_photographs import seed_from_photographs, seeds_of_photographs
from gsencoder.data.seeding.matches import (
    choose_pairs,
    depth_range_of_cameras,
    fundamental_matrix,
    on_epipolar_lines,
    triangulate,
    typical_distance,
)
from gsencoder.data.seeding.seed import SeedConfig, choose_source, seed
from gsencoder.types import Cameras, Scene


def ring(count: int, radius: float = 3.0) -> Cameras:
    """Cameras around the origin that look at it, z up."""
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    centers = radius * np.stack((np.cos(angle), np.sin(angle), np.full(count, 0.3)), axis=1)
    return looking_cameras(
        centers,
        -centers / np.linalg.norm(centers, axis=1)[:, None],
        np.array([0.0, 0, 1]),
        width=64,
        height=48,
        focal=60.0,
    )


def off_wall(points: np.ndarray) -> np.ndarray:
    """Distances from the wall."""
    return np.abs(points[:, 2] - DEPTH - TILT * points[:, 0]) / np.hypot(1, TILT)


def test_what_pixels_of_one_point_satisfy_is_the_fundamental_matrix():
    views = ring(6)
    points = np.random.default_rng(0).normal(size=(50, 3)) * 0.3
    first, second = (views.project(points, view)[0] for view in (0, 1))
    matrix = fundamental_matrix(views, 0, 1)
    ones = np.ones((50, 1))
    lines = np.hstack((first, ones)) @ matrix.T
    distance = np.abs((np.hstack((second, ones)) * lines).sum(axis=1)) / np.linalg.norm(lines[:, :2], axis=1)
    assert distance.max() < 1e-3
    assert on_epipolar_lines(views, 0, 1, first, second).all()
    aside = second + 5 * lines[:, :2] / np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
    assert not on_epipolar_lines(views, 0, 1, first, aside).any()


def test_parallel_cameras_look_ten_baselines_away_and_one_camera_one_unit():
    centers = np.stack((0.2 * np.arange(5.0), np.zeros(5), np.zeros(5)), axis=1)
    forward = np.tile([0.0, 1.0, 0.0], (5, 1))
    row = looking_cameras(centers, forward, np.array([0.0, 0, 1]), width=64, height=48, focal=60.0)
    assert typical_distance(row) == pytest.approx(2.0, rel=1e-5)
    assert typical_distance(row.select([0])) == 1.0
    assert typical_distance(row.select([0, 0])) == 1.0
    near, far = depth_range_of_cameras(row)
    assert (near, far) == pytest.approx((0.4, 8.0), rel=1e-5)


def test_views_away_from_each_other_have_no_pairs():
    views = ring(4, radius=1e-3)
    turned = views.cam_from_world.copy()
    turned[:, 0] *= -1
    turned[:, 2] *= -1
    assert choose_pairs(replace(views, cam_from_world=turned), 3) == []


def test_points_of_a_wall_lie_on_it():
    views = wall_views(6)
    made = triangulate(views, size=2000)
    assert len(made.points) > 20
    assert made.error < 1.0
    assert made.points.dtype == np.float32
    assert np.median(off_wall(made.points)) < 0.05


def test_photographs_that_do_not_fit_their_poses_are_warned_of():
    views = wall_views(8)
    poses = views.cameras.cam_from_world.copy()
    poses[:, [0, 1], 3] = poses[:, [1, 0], 3]  # The cameras went along x, and the poses say along y.
    wrong = replace(views, cameras=replace(views.cameras, cam_from_world=poses))
    with pytest.warns(SceneWarning, match=r"do not seem to fit their poses: of [0-9,]+ matched features [0-9]+ lie on"):
        triangulate(wrong)


def test_a_rerun_gives_the_same_points():
    views = wall_views(4)
    one, other = triangulate(views), triangulate(views)
    np.testing.assert_array_equal(one.points, other.points)
    np.testing.assert_array_equal(one.colors, other.colors)


def test_masked_pixels_give_no_points():
    views = wall_views(4)
    masks = [np.zeros((int(h), int(w)), bool) for h, w in zip(views.cameras.heights, views.cameras.widths, strict=True)]
    assert not len(triangulate(replace(views, masks=masks)).points)


def test_a_scene_without_depth_and_points_is_seeded_from_its_photographs():
    views = wall_views(6)
    scene = Scene(name="wall", views=replace(views, depths=None))
    assert choose_source(scene) == "photographs"
    made = seed(scene)
    assert len(made) > 300
    assert np.median(off_wall(made.means)) < 0.05
    assert choose_source(replace(scene, sfm_points=wall_points())) == "points"
    assert choose_source(scene, SeedConfig(source="depth")) == "depth"


def test_grey_pictures_are_refused_with_what_may_be_wrong(no_jaxtyping):
    views = wall_views(4)
    grey = [np.full_like(np.asarray(image), 128) for image in views.images or ()]
    with pytest.raises(InputError, match="4 of 4 photographs are of one color all over"):
        seed_from_photographs(replace(views, images=grey))


def test_views_that_look_away_from_each_other_are_refused(no_jaxtyping):
    views = wall_views(4)
    turns = np.pi / 2 * np.arange(4)
    outward = np.stack((np.cos(turns), np.sin(turns), np.zeros(4)), axis=1)
    away = looking_cameras(3 * outward, outward, np.array([0.0, 0, 1]), width=96, height=72, focal=80.0)
    with pytest.raises(InputError, match="no two of the 4 photographs show the same surface from different places"):
        seed_from_photographs(replace(views, cameras=away))


def test_one_photograph_is_refused():
    with pytest.raises(InputError, match="1 photograph without depth and points says nothing about where surfaces are"):
        seed(Scene(name="one", views=wall_views(1)), SeedConfig(source="photographs"))


def test_views_in_one_place_are_refused(no_jaxtyping):
    views = wall_views(4)
    poses = np.repeat(views.cameras.cam_from_world[:1], 4, axis=0)
    image = np.asarray((views.images or ())[0])
    same = replace(views, cameras=replace(views.cameras, cam_from_world=poses), images=[image] * 4)
    with pytest.raises(InputError, match="all 4 cameras stand in one place by their poses"):
        seed_from_photographs(same)


@pytest.mark.slow
def test_a_room_is_seeded_on_its_surfaces_although_few_features_match(shared):
    scene = load_scene(shared / "scenes" / "house" / "train_041", options=SceneConfig(max_views=8))
    views = scene.views
    made = seeds_of_photographs(Photographs(views), replace(views, depths=None))
    assert made.rough > 1000
    surface = seed(scene).means
    distance = cKDTree(surface).query(made.dense.points)[0]
    assert np.median(distance) < 0.04


@pytest.mark.slow
def test_the_plush_is_triangulated_where_its_own_model_has_points(shared):
    scene = load_scene(shared / "scenes" / "plush", options=SceneConfig(image_scale=0.5, max_views=16))
    made = triangulate(scene.views)
    assert len(made.points) > 200
    distance = cKDTree(scene.sfm_points).query(made.points)[0]
    extent = np.ptp(np.quantile(scene.sfm_points, (0.05, 0.95), axis=0), axis=0).max()
    assert np.median(distance) < 0.01 * extent
