"""Laws of the pinhole and of rigid transforms in numpy, and what pycolmap and scipy say of the same cameras."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from splats import front_camera, random_cameras

from gsencoder.data.readers.posed import load_pycolmap
from gsencoder.types import Cameras
from gsencoder.types.scene import (
    intrinsic_matrix,
    invert_rigid,
    look_at,
    look_rotation,
    move_origin,
    perpendicular,
    pixel_centers,
    project_points,
    transform,
    unproject_points,
)

EXTREME = (1e-6, 1.0, 1e6, 1e12)
"""Lengths at which laws must hold alike."""


def random_poses(count: int, seed: int = 0, length: float = 3.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, rng=rng).as_matrix()
    poses[:, :3, 3] = length * rng.normal(size=(count, 3))
    return poses


def some_points(count: int = 50, seed: int = 0, length: float = 3.0) -> np.ndarray:
    return length * np.random.default_rng(seed).normal(size=(count, 3))


def colmap_cameras(cameras: Cameras) -> Iterator[tuple[Any, Any]]:
    """Each camera as pycolmap's Camera and Rigid3d."""
    pycolmap = load_pycolmap()
    for pose, K, width, height in zip(
        cameras.cam_from_world.astype(np.float64), cameras.Ks, cameras.widths, cameras.heights, strict=True
    ):
        params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
        camera = pycolmap.Camera(model="PINHOLE", width=int(width), height=int(height), params=list(map(float, params)))
        yield camera, pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:3, :3]), pose[:3, 3])


@pytest.mark.parametrize("length", EXTREME)
def test_unprojecting_what_was_projected_gives_the_points_again_also_behind_the_camera(length):
    cameras = random_cameras(spread=length)
    points = some_points(length=length)
    behind = 0
    for view in range(len(cameras)):
        pixels, depths = cameras.project(points, view)
        # Rotations are float32 and orthonormal to its rounding, which is how exactly Rᵀ inverts R.
        np.testing.assert_allclose(cameras.unproject(pixels, depths, view), points, rtol=0, atol=3e-6 * length)
        behind += np.count_nonzero(depths < 0)
    assert behind > 100


@given(st.integers(0, 10_000), st.sampled_from(EXTREME), st.sampled_from([np.float32, np.float64]))
def test_projecting_what_was_unprojected_gives_the_pixels_and_depths_again(seed, depth, kind):
    rng = np.random.default_rng(seed)
    K = intrinsic_matrix(*rng.uniform(10, 2000, 2), *rng.uniform(-100, 2000, 2)).astype(kind)
    pixels = rng.uniform(-2000, 4000, (30, 2)).astype(kind)
    depths = (depth * rng.uniform(0.5, 2, 30) * rng.choice([-1, 1], 30)).astype(kind)
    points = unproject_points(pixels, depths, K)
    assert points.dtype == kind
    np.testing.assert_array_equal(points[:, 2], depths)
    again = project_points(points, K)
    assert again.dtype == kind
    np.testing.assert_allclose(again, pixels, rtol=0, atol=2e4 * np.finfo(kind).eps)


def test_projection_is_that_of_colmap():
    """COLMAP's pixel centers lie at .5, too, so that nothing is added or taken off."""
    cameras, points = random_cameras(), some_points(200)
    compared = 0
    for view, (camera, cam_from_world) in enumerate(colmap_cameras(cameras)):
        expected = np.asarray(cam_from_world.inverse().matrix())
        np.testing.assert_allclose(cameras.world_from_cam[view, :3], expected, atol=1e-5)
        np.testing.assert_allclose(cameras.centers[view], expected[:, 3], atol=1e-5)
        turned = transform(cameras.world_from_cam[view], points) - cameras.centers[view]
        np.testing.assert_allclose(cameras.rotate_to_world(points, view), turned, atol=1e-12)
        local = np.asarray(cam_from_world * points)
        pixels, depths = cameras.project(points, view)
        np.testing.assert_allclose(depths, local[:, 2], atol=1e-5)
        front = local[:, 2] > 0.1
        expected = np.asarray(camera.img_from_cam(local[front]))
        np.testing.assert_allclose(pixels[front], expected, rtol=1e-5, atol=1e-2)
        np.testing.assert_allclose(project_points(local[front], cameras.Ks[view].astype(np.float64)), expected)
        back = np.asarray(camera.cam_from_img(expected))
        ones = np.ones(len(back))
        rays = unproject_points(expected, ones, cameras.Ks[view].astype(np.float64))
        np.testing.assert_allclose(rays, np.column_stack((back, ones)), atol=1e-12)
        compared += len(back)
    assert compared > 1000


def test_all_cameras_at_once_are_each_camera_after_the_other():
    cameras, points = random_cameras(), some_points(30).astype(np.float32)
    for min_depth in (None, 0.5):
        pixels, depths = cameras.project(points, min_depth=min_depth)
        inside = cameras.in_image(pixels, depths, near=0.2)
        assert pixels.shape == (20, 30, 2)
        for view in range(len(cameras)):
            each, z = cameras.project(points, view, min_depth=min_depth)
            np.testing.assert_allclose(pixels[view], each, rtol=1e-5)
            np.testing.assert_allclose(depths[view], z, rtol=1e-5)
            assert each.dtype == z.dtype == pixels.dtype == np.float32
            assert np.array_equal(inside[view], cameras.in_image(pixels[view], depths[view], view, near=0.2))


def test_points_far_from_the_origin_keep_float64():
    """A camera that is known exactly, 10⁶ m away from the points' origin, tells millimetres apart."""
    pose = np.eye(4, dtype=np.float32)[None]
    pose[0, :3, 3] = -(2.0**20)
    cameras = replace(front_camera(640, 480, 500.0), cam_from_world=pose)
    points = 2.0**20 + np.array([[0.0, 0, 1], [0.001, 0, 1]])
    pixels, _ = cameras.project(points, 0)
    np.testing.assert_allclose(pixels, [[320, 240], [320.5, 240]], atol=1e-6)
    np.testing.assert_allclose(cameras.unproject(pixels, np.ones(2), 0), points, rtol=0, atol=1e-9)


def test_a_point_in_the_plane_of_the_lens_is_in_no_image_and_warns_of_nothing():
    cameras = front_camera(60, 40, 50.0)
    points = np.array([[0.0, 0, 0], [1, 1, 0], [1e300, 0, 1e-300], [0, 0, -1], [0, 0, 1]])
    pixels, depths = cameras.project(points, 0)
    assert cameras.in_image(pixels, depths, 0).tolist() == [False, False, False, False, True]
    raised, _ = cameras.project(points, 0, min_depth=1e-3)
    assert np.isfinite(raised).all()
    np.testing.assert_array_equal(raised[1], [50 / 1e-3 + 30, 50 / 1e-3 + 20])
    np.testing.assert_array_equal(raised[4], pixels[4])


def test_an_image_holds_its_left_and_upper_border_and_not_the_others():
    cameras = random_cameras(1)
    width, height = int(cameras.widths[0]), int(cameras.heights[0])
    pixels = np.array([[0.0, 0], [width, 0], [0, height], [np.nextafter(width, 0), np.nextafter(height, 0)], [-1, 0]])
    assert cameras.in_image(pixels, np.ones(5), 0).tolist() == [True, False, False, True, False]
    assert not cameras.in_image(pixels, np.full(5, 0.5), 0, near=0.5).any()
    assert cameras.in_image(pixels, np.full(5, 0.51), 0, near=0.5).sum() == 2


def test_rays_have_depth_one_and_go_through_the_pixel_centers():
    cameras = random_cameras(3, seed=5).resized(40)
    for view in range(3):
        width, height = int(cameras.widths[view]), int(cameras.heights[view])
        rays = cameras.rays(view)
        assert rays.shape == (height, width, 3)
        for depth in (-2.0, 0.5, 1e4):
            points = cameras.centers[view] + depth * rays.reshape(-1, 3)
            pixels, depths = cameras.project(points, view)
            np.testing.assert_allclose(depths, depth, rtol=1e-5)
            np.testing.assert_allclose(pixels.reshape(height, width, 2), pixel_centers(width, height), atol=1e-2)
        corner = cameras.rays(view, np.array([[0.5, 0.5], [width - 0.5, height - 0.5]]))
        np.testing.assert_array_equal(corner, [rays[0, 0], rays[-1, -1]])


@pytest.mark.parametrize("length", EXTREME)
def test_the_inverse_of_a_rigid_transform_is_that_of_linear_algebra_and_of_scipy(length):
    poses = random_poses(50, length=length)
    inverse, back = invert_rigid(poses), Rotation.from_matrix(poses[:, :3, :3]).inv()
    room = 1e-14 * max(1, length)
    np.testing.assert_allclose(inverse[:, :3, :3], back.as_matrix(), rtol=0, atol=1e-14)
    np.testing.assert_allclose(inverse[:, :3, 3], -back.apply(poses[:, :3, 3]), rtol=0, atol=room)
    np.testing.assert_allclose(inverse, np.linalg.inv(poses), rtol=1e-9, atol=1e-9 * length)
    np.testing.assert_allclose(invert_rigid(inverse), poses, rtol=0, atol=room)
    np.testing.assert_array_equal(inverse[7], invert_rigid(poses[7]))
    assert (inverse[:, 3] == [0, 0, 0, 1]).all()


@pytest.mark.parametrize("length", EXTREME)
def test_a_moved_origin_changes_coordinates_and_no_camera(length):
    poses, origin = random_poses(20), length * np.array([1.0, -2.0, 0.5])
    moved = move_origin(poses, origin)
    centers = invert_rigid(poses)[:, :3, 3]
    room = 1e-14 * max(1, length)
    np.testing.assert_allclose(invert_rigid(moved)[:, :3, 3], centers - origin, rtol=0, atol=room)
    np.testing.assert_array_equal(moved[:, :3, :3], poses[:, :3, :3])
    np.testing.assert_allclose(move_origin(moved, -origin), poses, rtol=0, atol=room)
    np.testing.assert_array_equal(move_origin(poses[4], origin), moved[4])
    points = some_points()
    seen = transform(moved[0], points - origin)
    np.testing.assert_allclose(seen, transform(poses[0], points), rtol=0, atol=2 * room + 1e-12)


def test_cameras_look_at_what_is_before_them_and_stand_upright():
    rng = np.random.default_rng(0)
    forward = rng.normal(size=(50, 3))
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    up, centers = np.array([0.2, 3.0, -0.5]), rng.normal(size=(50, 3))
    poses = look_at(centers, forward, up)
    np.testing.assert_allclose(invert_rigid(poses)[:, :3, 3], centers, atol=1e-12)
    rotations = poses[:, :3, :3]
    np.testing.assert_array_equal(rotations, look_rotation(forward, up))
    np.testing.assert_allclose(rotations @ rotations.mT, np.tile(np.eye(3), (50, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotations), 1, atol=1e-12)
    np.testing.assert_allclose(rotations[:, 2], forward)
    # Level: up has no part to the right in the image; upright: it points against y, which goes down.
    np.testing.assert_allclose(rotations[:, 0] @ up, 0, atol=1e-12)
    assert (rotations[:, 1] @ up < 0).all()
    ahead = transform(poses[3], (centers + 2 * forward)[3:4])
    np.testing.assert_allclose(ahead, [[0, 0, 2]], atol=1e-12)


@given(st.lists(st.floats(-1, 1), min_size=3, max_size=3), st.sampled_from((1e-150, 1.0, 1e150)))
def test_a_perpendicular_vector_is_perpendicular_and_of_unit_length(direction, length):
    norm = float(np.linalg.norm(direction))
    assume(norm > 1e-6)
    unit = np.array(direction) / norm
    normal = perpendicular(unit * length)
    assert abs(normal @ unit) < 1e-15
    assert abs(np.linalg.norm(normal) - 1) < 1e-15
