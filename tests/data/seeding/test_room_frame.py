"""Seeds turn and move with their scene, whatever the world's axes are."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from textured_box import box_cameras, box_views

from gsencoder.data.seeding.depth import room_frame
from gsencoder.data.seeding.seed import SeedConfig, seed
from gsencoder.data.synthetic import make_room
from gsencoder.types import Scene, Views
from gsencoder.types.scene import invert_rigid


def moved(views: Views, other_from_world: np.ndarray) -> Views:
    """The views in another world."""
    poses = views.cameras.cam_from_world.astype(np.float64) @ invert_rigid(other_from_world)
    return replace(views, cameras=replace(views.cameras, cam_from_world=poses.astype(np.float32)))


def some_transform(number: int) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.random(random_state=number).as_matrix()
    matrix[:3, 3] = np.random.default_rng(number).uniform(-3, 3, 3)
    return matrix


def test_seeds_of_a_turned_room_are_its_turned_seeds():
    number = 0
    views = make_room(number, objects=6, views=6, width=96, height=72).views
    config = SeedConfig(voxel=0.04)
    other_from_world = some_transform(number)
    here = seed(Scene(name="room", views=views, metres_per_unit=1.0), config)
    there = seed(Scene(name="room", views=moved(views, other_from_world), metres_per_unit=1.0), config)
    assert abs(len(there) - len(here)) < 0.01 * len(here)
    expected = here.means @ other_from_world[:3, :3].T + other_from_world[:3, 3]
    distance, nearest = cKDTree(there.means).query(expected)
    same = distance < 1e-3
    assert same.mean() > 0.99
    assert np.isclose(there.scales[nearest], here.scales, rtol=0.05).all(axis=1)[same].mean() > 0.98
    normals = [
        Rotation.from_quat(each.quats, scalar_first=True).as_matrix()[:, :, 2] for each in (here, there)
    ]  # fmt: skip
    cosines = np.einsum("ni,ni->n", normals[0] @ other_from_world[:3, :3].T, normals[1][nearest])
    assert np.mean(np.abs(cosines[same]) > 0.999) > 0.99


@pytest.mark.parametrize("number", range(2))
def test_the_axes_of_a_box_are_those_of_its_walls_and_the_origin_is_among_the_cameras(number):
    other_from_world = some_transform(number)
    views = moved(box_views(box_cameras(5, width=96, height=72, focal=67.2)), other_from_world)
    frame = room_frame(views)
    cosines = np.abs(frame[:3, :3] @ other_from_world[:3, :3])
    np.testing.assert_allclose(np.sort(cosines, axis=1), [[0, 0, 1]] * 3, atol=2e-3)
    np.testing.assert_allclose(frame[:3, :3] @ frame[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(frame[:3, :3]) == pytest.approx(1)
    center = views.cameras.centers.mean(axis=0)
    np.testing.assert_allclose(frame[:3, :3] @ center + frame[:3, 3], 0, atol=1e-5)


def test_depth_without_surfaces_has_no_frame():
    views = box_views(box_cameras(2, width=32, height=24, focal=22.0))
    for value in (0.0, np.nan, np.inf, 1e-30):
        depths = [np.full_like(depth, value) for depth in views.depths]
        frame = room_frame(replace(views, depths=depths))
        assert frame is None or np.isfinite(frame).all()
    assert room_frame(replace(views, depths=[np.zeros_like(depth) for depth in views.depths])) is None
