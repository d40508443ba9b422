"""Pairs, neighbors and depth ranges of cameras, and features on pictures: laws that no picture's content decides."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from textured_box import box_cameras, box_views

from gsencoder.core.errors import InputError
from gsencoder.data.orbits import looking_cameras
from gsencoder.data.seeding.from_photographs import MIN_COVERAGE, _spread_neighbors
from gsencoder.data.seeding.matches import (
    DEPTHS,
    choose_pairs,
    fundamental_matrix,
    match_photographs,
    nearest_distances,
    overlaps,
    triangulate,
    typical_distance,
)
from gsencoder.types import Cameras

UP = np.array([0.0, 0.0, 1.0])


def arc(count: int, step: float = 10.0, radius: float = 2.0) -> Cameras:
    """Cameras `step` degrees apart that look at the origin."""
    turns = np.deg2rad(step) * np.arange(count)
    centers = radius * np.stack((np.cos(turns), np.sin(turns), np.zeros(count)), axis=1)
    return looking_cameras(centers, -centers / radius, UP, width=64, height=48, focal=60.0)


def test_distances_and_overlaps_do_not_depend_on_the_world():
    cameras = arc(6)
    poses = cameras.cam_from_world.copy()
    poses[:, :3, :3] = poses[:, :3, :3] @ Rotation.random(random_state=0).as_matrix().T
    poses[:, :3, 3] *= 7
    other = replace(cameras, cam_from_world=poses)
    assert typical_distance(other) == pytest.approx(7 * typical_distance(cameras), rel=1e-4)
    np.testing.assert_allclose(overlaps(other, 14.0), overlaps(cameras, 2.0), atol=0.02)
    assert choose_pairs(other, 2) == choose_pairs(cameras, 2)


def test_the_overlap_is_the_share_of_points_that_both_see_from_similar_directions():
    """The oracle: each of the 125 points by itself."""
    cameras = arc(3, 40.0)
    shares = overlaps(cameras, 1.5)
    for view, other in np.ndindex(3, 3):
        count = 0
        for depth in DEPTHS:
            for column in (6.4, 19.2, 32.0, 44.8, 57.6):
                for row in (4.8, 14.4, 24.0, 33.6, 43.2):
                    ray = cameras.rays(view, np.array([[column, row]]))[0]
                    point = cameras.centers[view] + 1.5 * depth * ray
                    pixels, z = cameras.project(point[None])
                    u, v = pixels[other, 0]
                    one, two = point - cameras.centers[view], point - cameras.centers[other]
                    angle = np.arctan2(np.linalg.norm(np.cross(one, two)), one @ two)
                    count += z[other, 0] > 0 and 0 <= u < 64 and 0 <= v < 48 and np.rad2deg(angle) < 75
        assert shares[view, other] == pytest.approx(0 if view == other else count / 125)


def test_each_view_is_paired_with_those_that_overlap_most():
    cameras = arc(5, 20.0)
    assert choose_pairs(cameras, 1) == [(0, 1), (1, 2), (2, 3), (3, 4)]
    assert choose_pairs(cameras, 0) == []


def test_cameras_that_look_apart_are_taken_to_look_ten_neighbors_away():
    cameras = arc(8, 45.0)
    outward = cameras.cam_from_world.copy()
    outward[:, [0, 2]] *= -1
    away = replace(cameras, cam_from_world=outward)
    assert typical_distance(away) == pytest.approx(10 * 2 * 2 * np.sin(np.deg2rad(22.5)), rel=1e-4)
    # One that looks away among eight changes nothing.
    mixed = cameras.cam_from_world.copy()
    mixed[0] = outward[0]
    assert typical_distance(replace(cameras, cam_from_world=mixed)) == pytest.approx(2, rel=0.05)


def test_distances_between_neighbors_count_each_place_once():
    assert nearest_distances(np.array([[0.0, 0, 0]])).tolist() == []
    centers = np.array([[0.0, 0, 0], [1, 0, 0], [1, 0, 0], [4, 0, 0]])
    assert sorted(nearest_distances(centers).tolist()) == [1, 1, 3]


def test_neighbors_of_a_sweep_stand_an_eighth_of_the_distance_apart_if_they_can():
    """Along an arc of 1.8° steps, an eighth is 7.2°: the fourth camera to each side comes first, the next one last."""
    cameras = arc(21, 1.8)
    neighbors = _spread_neighbors(cameras, np.ones(21), 10)
    assert set(neighbors[:2]) == {6, 14}
    assert set(neighbors[2:]) == {5, 15}
    hidden = np.where(np.arange(21) < 10, 0.5, 1.0)
    assert _spread_neighbors(cameras, hidden, 10)[:2] == [14, 15]
    assert _spread_neighbors(cameras, np.zeros(21), 10) == []
    # A hundredth of the points is the least to share.
    assert _spread_neighbors(cameras, np.where(np.arange(21) == 6, 0.011, 0.008), 10) == [6]
    twins = cameras.select([0, 0, 0])
    assert _spread_neighbors(twins, overlaps(twins, 1.0)[0], 0) == []
    assert 0 < MIN_COVERAGE < 1


def test_the_fundamental_matrix_has_the_epipoles_of_both_cameras():
    """F e = 0 for the picture of the other camera's center (Hartley and Zisserman, section 9.2.4)."""
    cameras = box_cameras(3)
    matrix = fundamental_matrix(cameras, 0, 2)
    assert np.linalg.matrix_rank(matrix, tol=1e-9 * np.abs(matrix).max()) == 2
    for view, other, each in ((0, 2, matrix), (2, 0, matrix.T)):
        pixel = cameras.project(cameras.centers[other][None].astype(np.float64))[0][view, 0]
        direction = each @ np.array([*pixel, 1.0])
        assert np.linalg.norm(direction) < 1e-3 * np.linalg.norm(each) * np.linalg.norm([*pixel, 1.0])
    np.testing.assert_allclose(fundamental_matrix(cameras, 2, 0) / matrix.T, 1, rtol=1e-3)


def test_features_are_found_where_the_smaller_picture_and_its_mask_show_something():
    views = box_views(box_cameras(2, width=320, height=240, focal=224.0).select([0, 0]))
    views = replace(views, names=("a", "b"))
    half = np.zeros((240, 320), bool)
    half[:, :160] = True
    small = views.cameras.resized(200)
    masked = replace(views, masks=[half, half])
    (pair,) = match_photographs(masked, small, [(0, 1)], features=300)
    assert (pair.first, pair.second) == (0, 1)
    assert 30 < len(pair.first_pixels) <= 300
    np.testing.assert_allclose(pair.first_pixels, pair.second_pixels)
    assert pair.first_pixels[:, 0].max() < 101
    assert pair.first_pixels[:, 1].max() < 150
    assert match_photographs(views, small, [], features=300) == []


def test_triangulation_needs_two_photographs():
    views = box_views(box_cameras(1, width=32, height=24, focal=22.0))
    for wrong in (views, replace(views, images=None)):
        with pytest.raises(InputError, match="two posed photographs or more, got 1"):
            triangulate(wrong)
