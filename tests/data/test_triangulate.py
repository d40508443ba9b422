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
from gsencoder.data.seeding.matches import triangulate, typical_distance
from gsencoder.data.seeding.seed import SeedConfig, choose_source, seed
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


def test_points_of_a_wall_lie_on_it():
    points, colors = triangulate(wall_views(4))
    assert len(points) > 20
    assert np.median(off_wall(points)) < 0.05
    again = triangulate(wall_views(4))
    np.testing.assert_array_equal(points, again[0])
    np.testing.assert_array_equal(colors, again[1])


def test_photographs_that_do_not_fit_their_poses_are_warned_of():
    views = wall_views(8)
    poses = views.cameras.cam_from_world.copy()
    poses[:, [0, 1], 3] = poses[:, [1, 0], 3]  # The cameras went along x, and the poses say along y.
    wrong = replace(views, cameras=replace(views.cameras, cam_from_world=poses))
    with pytest.warns(SceneWarning, match=r"do not seem to fit their poses: of [0-9,]+ matched features [0-9]+ lie on"):
        triangulate(wrong)


def test_masked_pixels_give_no_points():
    views = wall_views(4)
    masks = [np.zeros((int(h), int(w)), bool) for h, w in zip(views.cameras.heights, views.cameras.widths, strict=True)]
    assert not len(triangulate(replace(views, masks=masks))[0])


def test_a_scene_without_depth_and_points_is_seeded_from_its_photographs():
    views = wall_views(4)
    scene = Scene(name="wall", views=replace(views, depths=None))
    assert choose_source(scene) == "photographs"
    made = seed(scene)
    assert len(made) > 300
    assert np.median(off_wall(made.means)) < 0.05
    assert choose_source(replace(scene, sfm_points=wall_points())) == "points"
    assert choose_source(scene, SeedConfig(source="depth")) == "depth"


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


@pytest.mark.slow
def test_a_room_is_seeded_on_its_surfaces_although_few_features_match(shared):
    scene = load_scene(shared / "scenes" / "house" / "train_041", options=SceneConfig(max_views=8))
    made = seeds_of_photographs(Photographs(scene.views), replace(scene.views, depths=None))
    assert len(made.points) > 1000
    distance = cKDTree(seed(scene).means).query(made.points)[0]
    assert np.median(distance) < 0.04
