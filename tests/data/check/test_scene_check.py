"""Faults of poses, depth and photographs are named with their cause; scenes without faults raise none."""

from collections.abc import Callable
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from textured_box import box_cameras, box_views

from gsencoder.core.errors import SceneWarning
from gsencoder.data.check.epipolar import FEATURES, check_matches, consistent_matches, judge_matches
from gsencoder.data.check.scene_check import (
    check_depth,
    check_scene,
    findings_of,
    is_decided,
    suspicious_depth,
    warn_of_faults,
    wrong_size,
)
from gsencoder.data.orbits import looking_cameras
from gsencoder.data.seeding.matches import match_photographs
from gsencoder.types import Cameras, Scene, Views
from gsencoder.types.scene import OPENCV_FROM_OPENGL, invert_rigid

ROW = 3
"""The view that alone is wrong."""


def few_cameras(count: int = 5, focal: float = 156.8) -> Cameras:
    """The first of an arc of ten: what a check takes grows with the square of their number."""
    return box_cameras(width=224, height=168, focal=focal).select(range(count))


@pytest.fixture(scope="module")
def box():
    return box_views(few_cameras())


@pytest.fixture(scope="module")
def checked(box):
    return check_depth(box)


@pytest.fixture(scope="module")
def matches(box):
    """Of the photographs, which no fault of their poses changes."""
    pairs = list(combinations(range(len(box)), 2))
    found = match_photographs(replace(box, depths=None), box.cameras, pairs, features=FEATURES)
    return consistent_matches(found)


def with_poses(views: Views, change: Callable[[np.ndarray], np.ndarray]) -> Views:
    poses = change(views.cameras.cam_from_world.astype(np.float64))
    return replace(views, cameras=replace(views.cameras, cam_from_world=poses.astype(np.float32)))


def with_focal(views: Views, factor: float) -> Views:
    Ks = views.cameras.Ks.copy()
    Ks[:, :2, :2] *= np.float32(factor)
    return replace(views, cameras=replace(views.cameras, Ks=Ks))


def with_depths(views: Views, change: Callable[[np.ndarray], np.ndarray]) -> Views:
    return replace(views, depths=[change(depth).astype(np.float32) for depth in views.depths])


def with_stray(views: Views, size: float = 1.0) -> Views:
    """One view turned by 1° and moved by 3 cm, times `size`."""
    noise = np.eye(4)
    noise[:3, :3] = Rotation.from_rotvec(np.deg2rad([0.6 * size, 0.6 * size, 0.5 * size])).as_matrix()
    noise[:3, 3] = 0.02 * size, -0.02 * size, 0.01 * size
    return with_poses(views, lambda poses: np.stack([*poses[:ROW], noise @ poses[ROW], *poses[ROW + 1 :]]))


def with_other_picture(views: Views) -> Views:
    images = list(views.images)
    images[ROW] = images[0]
    return replace(views, images=images)


def ray_lengths(views: Views) -> np.ndarray:
    rays = views.cameras.rays(0)
    return np.asarray(np.linalg.norm(rays, axis=2))


def other_sensor(depth: np.ndarray, factor: float = 1.1) -> np.ndarray:
    """The depth image of a sensor with a longer focal length, as if it had the stated one."""
    height, width = depth.shape
    rows, columns = ((np.arange(n) + 0.5 - n / 2) / factor + n / 2 for n in (height, width))
    return depth[rows.astype(int)][:, columns.astype(int)]


POSE_FAULTS: dict[str, Callable[[Views], Views]] = {
    "axes": lambda views: with_poses(views, lambda poses: OPENCV_FROM_OPENGL @ poses),
    "inverse": lambda views: with_poses(views, invert_rigid),
    "inverse and axes": lambda views: with_poses(views, lambda poses: invert_rigid(OPENCV_FROM_OPENGL @ poses)),
    "order": lambda views: with_poses(views, lambda poses: np.roll(poses, 1, axis=0)),
    "focal length": lambda views: with_focal(views, 1.1),
}
DEPTH_FAULTS: dict[str, Callable[[Views], Views]] = {
    "depth scale": lambda views: with_depths(views, lambda depth: 1.03 * depth),
    "ray length": lambda views: with_depths(views, lambda depth: depth * ray_lengths(views)),
    "depth focal length": lambda views: with_depths(views, other_sensor),
}
VIEW_FAULTS: dict[str, Callable[[Views], Views]] = {"stray view": with_stray, "other picture": with_other_picture}
FACTORS = {"depth scale": 1 / 1.03, "depth focal length": 1.1, "focal length": 1 / 1.1, "order": -1.0}


def test_a_scene_without_faults_has_no_findings(checked):
    assert checked.findings == ()
    assert checked.given.share > 0.99
    assert abs(checked.given.offset) < 1e-4
    assert checked.color > 0.98


@pytest.mark.parametrize("fault", [*POSE_FAULTS, *DEPTH_FAULTS])
def test_a_fault_of_all_views_is_named_with_its_factor(box, fault):
    check = check_depth((POSE_FAULTS | DEPTH_FAULTS)[fault](box))
    assert [(finding.cause, finding.view) for finding in check.findings] == [(fault, None)]
    if fault in FACTORS:
        assert check.findings[0].factor == pytest.approx(FACTORS[fault], rel=0.01)
    assert check.best.share > 0.95
    assert check.best.spread < 0.6 * check.given.spread


@pytest.mark.parametrize("fault", VIEW_FAULTS)
def test_a_view_that_is_wrong_alone_is_named(box, fault):
    check = check_depth(VIEW_FAULTS[fault](box))
    assert [(finding.cause, finding.view) for finding in check.findings] == [(fault, box.names[ROW])]


def test_two_faults_at_once_are_both_named(box):
    check = check_depth(with_other_picture(POSE_FAULTS["inverse"](box)))
    assert {(finding.cause, finding.view) for finding in check.findings} == {
        ("inverse", None),
        ("other picture", box.names[ROW]),
    }


def test_photographs_of_a_camera_beside_the_depth_camera_are_not_registered():
    cameras, beside = few_cameras(8), few_cameras(8, 0.9 * 156.8)
    poses = beside.cam_from_world.copy()
    poses[:, 0, 3] += 0.03
    check = check_depth(box_views(cameras, color_cameras=replace(beside, cam_from_world=poses)))
    assert [finding.cause for finding in check.findings] == ["color registration"]
    assert check.registration.focal_factor == pytest.approx(0.9, abs=0.005)
    np.testing.assert_allclose(check.registration.shift, (0.03, 0), atol=0.004)


@pytest.mark.parametrize("fault", POSE_FAULTS)
def test_without_depth_matched_features_name_faults_of_the_poses(box, matches, fault):
    cameras = POSE_FAULTS[fault](box).cameras
    check = judge_matches(matches, cameras, cameras, np.arange(len(box)), box.names)
    assert [(finding.cause, finding.view) for finding in check.findings] == [(fault, None)]
    assert check.best_error < 0.7 < check.error


@pytest.mark.parametrize("wrong", [lambda views: with_stray(views, 3.0), with_other_picture])
def test_without_depth_a_view_that_is_wrong_alone_is_astray(box, wrong):
    check = check_matches(wrong(replace(box, depths=None)))
    assert [(finding.cause, finding.view) for finding in check.findings] == [("stray view", box.names[ROW])]


def test_poses_at_random_are_named_as_such(box):
    made = np.random.default_rng(0)

    def scatter(poses: np.ndarray) -> np.ndarray:
        turned = poses.copy()
        turned[:, :3, :3] = Rotation.random(len(poses), random_state=0).as_matrix()
        turned[:, :3, 3] = made.normal(size=(len(poses), 3))
        return turned

    astray = with_poses(box, scatter)
    assert [finding.cause for finding in check_depth(astray).findings] == ["unknown"]
    assert [finding.cause for finding in check_matches(replace(astray, depths=None)).findings] == ["unknown"]
    with pytest.warns(SceneWarning, match="inspect says more$"):
        warn_of_faults(Scene(name="box", views=astray))


def test_depth_that_no_other_view_sees_leaves_the_judgement_to_matches():
    """Views from one place that look away from each other share nothing, whatever is wrong with them."""
    turns = np.linspace(0, 2 * np.pi, 4, endpoint=False)
    forward = np.stack((np.cos(turns), np.sin(turns), np.zeros(4)), axis=1)
    away = looking_cameras(0.3 * forward, forward, np.array([0.0, 0, 1]), width=64, height=48, focal=80.0)
    depth, matches = check_scene(box_views(away))
    assert not depth.comparable
    assert depth.findings == ()
    assert (matches.pairs, matches.findings) == (0, ())


@pytest.mark.parametrize("count", [1, 2])
def test_few_views_are_checked_as_far_as_they_go(box, count):
    few = replace(box_views(box.cameras.select(range(count))), names=box.names[:count])
    depth, matches = check_scene(few)
    assert (depth is None) == (count == 1)
    assert matches is None
    if depth is not None:
        assert depth.findings == ()


def test_views_from_one_place_are_no_fault():
    turns = np.linspace(0, 0.6, 4)
    forward = np.stack((np.cos(turns), np.sin(turns), np.zeros(4)), axis=1)
    tripod = looking_cameras(np.zeros((4, 3)), forward, np.array([0.0, 0, 1]), width=160, height=120, focal=112.0)
    depth = check_depth(box_views(tripod))
    assert depth.comparable
    assert depth.findings == ()
    matches = check_matches(replace(box_views(tripod), depths=None))
    assert matches.decided
    assert matches.findings == ()


def test_photographs_of_something_else_are_one_finding(box):
    made = np.random.default_rng(0)
    noise = [made.integers(0, 255, image.shape, np.uint8) for image in box.images]
    check = check_depth(replace(box, images=noise))
    assert [(finding.cause, finding.view) for finding in check.findings] == [("photographs", None)]


def test_a_quick_look_warns_of_what_the_check_names(box):
    assert suspicious_depth(box)[1] is None
    wrong = POSE_FAULTS["axes"](box)
    _, finding = suspicious_depth(wrong)
    assert finding.cause == "axes"
    with pytest.warns(SceneWarning, match=r"scene box: the poses are in OpenGL's camera axes.*gsencoder inspect"):
        warn_of_faults(Scene(name="box", views=wrong))
    warn_of_faults(Scene(name="box", views=box))
    warn_of_faults(Scene(name="box", views=replace(wrong, depths=None)))


@pytest.mark.parametrize("factor", [0.5, 4.0])
def test_a_principal_point_of_pictures_of_another_size_is_named(box, factor):
    assert wrong_size(box.cameras) is None
    Ks = box.cameras.Ks.copy()
    Ks[:, :2] *= np.float32(factor)
    wrong = replace(box, cameras=replace(box.cameras, Ks=Ks))
    (finding,) = findings_of(wrong, None, None)
    assert (finding.cause, finding.factor) == ("picture size", pytest.approx(1 / factor))
    with pytest.warns(SceneWarning, match="intrinsics are those of pictures of another size"):
        warn_of_faults(Scene(name="box", views=replace(wrong, depths=None)))
    # With depth that does not fit it is the cause, and the only finding.
    assert findings_of(wrong, check_depth(wrong), None) == [finding]


def test_a_corner_cut_out_of_a_larger_picture_is_right_where_the_views_fit(box):
    """Without a quarter of its rows and columns the principal point lies as that of a smaller picture does."""
    Ks = box.cameras.Ks.copy()
    Ks[:, :2, 2] -= (56, 42)
    cameras = replace(box.cameras, Ks=Ks, widths=box.cameras.widths - 56, heights=box.cameras.heights - 42)
    corner = replace(
        box,
        cameras=cameras,
        images=[image[42:, 56:] for image in box.images],
        depths=[depth[42:, 56:] for depth in box.depths],
    )
    assert wrong_size(corner.cameras) is not None
    depth = check_depth(corner)
    assert depth.comparable
    assert findings_of(corner, depth, None) == []


def test_too_little_is_no_judgement(box, checked):
    """Photographs without features say neither that all is well nor that it is not."""
    grey = replace(box, images=[np.full_like(image, 128) for image in box.images])
    depth, matches = check_depth(grey), check_matches(replace(grey, depths=None))
    assert depth.findings == ()
    assert np.isnan(depth.color)
    assert matches.pairs == 0
    assert np.isnan(matches.error)
    assert not is_decided(None, matches)
    assert is_decided(checked, None)
    assert not is_decided(None, None)
