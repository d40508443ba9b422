"""Faults of poses, depth and photographs are named with their cause, and what the numbers of a check mean."""

from collections.abc import Callable
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from textured_box import HALF, box_cameras, box_views

from gsencoder.core.errors import SceneWarning
from gsencoder.data.check.agreement import (
    CLIP,
    MIN_SAMPLES,
    MIN_SHARED,
    SAMPLES,
    agreement,
    agreement_map,
    color_correlations,
    depth_views,
    fit_registration,
    grey_picture,
    on_surface,
    other_orders,
    other_readings,
    residuals,
    shared_samples,
    world_samples,
)
from gsencoder.data.check.epipolar import FEATURES, check_matches, consistent_matches, judge_matches
from gsencoder.data.check.scene_check import (
    check_depth,
    check_scene,
    findings_of,
    fit_pose,
    is_decided,
    surface_normals,
    suspicious_depth,
    view_spreads,
    warn_of_faults,
    wrong_size,
)
from gsencoder.data.orbits import looking_cameras
from gsencoder.data.seeding.matches import match_photographs
from gsencoder.types import Cameras, Scene, Views
from gsencoder.types.scene import OPENCV_FROM_OPENGL, invert_rigid, transform

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
    "ray length": lambda views: with_depths(views, lambda depth: depth * np.linalg.norm(views.cameras.rays(0), axis=2)),
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
    found = {(finding.cause, finding.view) for finding in check.findings}
    assert found == {("inverse", None), ("other picture", box.names[ROW])}


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
    images, depths = ([picture[42:, 56:] for picture in pictures] for pictures in (box.images, box.depths))
    corner = replace(box, cameras=cameras, images=images, depths=depths)
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


COUNT = 6


@pytest.fixture(scope="module")
def views_of_box():
    return box_views(box_cameras(COUNT, width=96, height=72, focal=67.2))


@pytest.fixture(scope="module")
def small(views_of_box):
    return depth_views(views_of_box, np.arange(COUNT))


def test_samples_lie_where_the_depth_says_in_any_unit(small):
    known = small.values > 0
    assert known.sum(axis=1).max() == SAMPLES
    off_walls = np.abs(np.abs(world_samples(small)[known]) - HALF).min(axis=-1)
    assert off_walls.max() < 1e-4
    millimeters = replace(small, depths=1000 * small.depths, values=1000 * small.values, scale=1e-3)
    np.testing.assert_allclose(world_samples(millimeters), world_samples(small), atol=1e-6)
    np.testing.assert_allclose(residuals(millimeters), residuals(small), atol=1e-6)


def test_larger_depth_images_are_sampled_at_the_centers_of_the_smaller_pixels():
    cameras = box_cameras(2, width=960, height=720, focal=672.0)
    full = np.arange(720 * 960, dtype=np.float32).reshape(720, 960) / 1000 + 1
    large = depth_views(Views(cameras=cameras, names=("a", "b"), depths=[full, full]), np.arange(2))
    np.testing.assert_array_equal(large.depths[1], full[1::3, 1::3])
    np.testing.assert_allclose(large.Ks, box_cameras(2, width=320, height=240, focal=224.0).Ks, rtol=1e-6)


def test_surfaces_end_at_steps_at_missing_pixels_and_at_the_border():
    depth = np.ones((9, 12), np.float32)
    depth[:, 8:] = 1.06
    depth[4, 2] = 0
    use = on_surface(depth)
    expected = np.zeros((9, 12), bool)
    expected[1:-1, 1:-1] = True
    expected[:, 7:9] = False
    expected[3:6, 1:4] = False
    np.testing.assert_array_equal(use, expected)
    assert on_surface(np.where(depth > 1, np.float32(1.04), np.float32(1)))[1:-1, 1:-1].all()


def test_a_summary_of_residuals_counts_what_is_not_hidden():
    summary = agreement(np.array([np.nan, 0.0, 0.01, -0.02, 0.04, -0.3, 0.06, 9.0]))
    assert summary.compared == 7
    # Two lie further away than what is seen there.
    assert summary.share == pytest.approx(3 / 5)
    assert summary.spread == pytest.approx((0 + 0.01 + 0.02 + 0.04 + 3 * CLIP) / 7)
    assert summary.offset == pytest.approx(np.median([0, 0.01, -0.02, 0.04]))
    nothing = agreement(np.array([np.nan]))
    assert nothing.compared == 0
    assert np.isnan([nothing.share, nothing.spread, nothing.offset]).all()
    behind = agreement(np.array([7.0, 8.0]))
    assert (behind.share, behind.spread, behind.compared) == (0, CLIP, 2)
    assert np.isnan(behind.offset)


def test_spread_of_a_view_counts_both_directions():
    residual = np.full((3, 3, 2), np.nan)
    residual[0, 1] = 0.01, -0.03
    residual[1, 0] = 0.02, 7.0
    np.testing.assert_allclose(view_spreads(residual)[:2], (0.01 + 0.03 + 0.02 + CLIP) / 4)
    assert np.isnan(view_spreads(residual)[2])


def test_residuals_of_exact_depth_are_zero_and_the_map_shows_the_piece_that_is_wrong(small):
    known = residuals(small)
    assert np.isnan(known[np.arange(COUNT), np.arange(COUNT)]).all()
    assert np.nanmedian(np.abs(known)) < 2e-3
    depths = small.depths.copy()
    depths[3, 30:42, 30:45] *= 0.8
    share, piece = agreement_map(replace(small, depths=depths), 3), np.zeros((72, 96), bool)
    piece[30:42, 30:45] = True
    assert np.nanmean(share[piece]) < 0.1
    assert np.nanmean(share[~piece]) > 0.97


def test_a_place_that_nobody_else_sees_has_no_share_and_hidden_ones_do_not_count(small):
    alone = agreement_map(replace(small, depths=np.where(np.arange(COUNT)[:, None, None] == 2, small.depths, 0)), 2)
    assert np.isnan(alone).all()
    closer = small.depths.copy()
    closer[1:] *= 0.5
    assert np.isnan(agreement_map(replace(small, depths=closer), 0)).all()
    further = small.depths.copy()
    further[1:] *= 2
    assert np.nanmax(agreement_map(replace(small, depths=further), 0)) == 0


def test_shared_samples_are_one_place_in_the_axes_of_both_views(small):
    pairs = list(shared_samples(small, MIN_SAMPLES))
    assert len({(view, other) for view, other, _, _ in pairs}) == len(pairs) > COUNT
    world_from_cam = invert_rigid(small.cam_from_world)
    for view, other, here, there in pairs:
        assert view != other
        assert len(here) >= MIN_SAMPLES
        ours, theirs = transform(world_from_cam[view], here), transform(world_from_cam[other], there)
        np.testing.assert_allclose(ours, theirs, atol=1e-6)
    most = max(len(here) for _, _, here, _ in pairs)
    assert len(list(shared_samples(small, most))) >= 1
    assert not list(shared_samples(small, most + 1))


def test_colors_of_one_place_correlate_wherever_they_are_seen_from(views_of_box, small):
    grey = np.stack([grey_picture(views_of_box, row, 96, 72) for row in range(COUNT)])
    light = views_of_box.images[0].astype(float) @ (0.299, 0.587, 0.114) / 255
    np.testing.assert_allclose(grey[0], light, atol=0.01)
    known = color_correlations(small, grey, small.Ks)
    assert np.isnan(np.diag(known)).all()
    assert np.nanmedian(known) > 0.9
    # What is brighter or has less contrast correlates as well; a negative correlates the other way round.
    dim = grey.copy()
    dim[0] = 0.2 + 0.5 * dim[0]
    np.testing.assert_allclose(color_correlations(small, dim, small.Ks), known, atol=1e-4)
    dim[0] = 1 - grey[0]
    np.testing.assert_allclose(color_correlations(small, dim, small.Ks)[0], -known[0], atol=1e-4)
    dim[0] = 0.5
    assert np.isnan(color_correlations(small, dim, small.Ks)[0]).all()


def test_orders_move_every_pose_by_one_or_two_places_either_way():
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 0, 3] = np.arange(5)
    moved = {places: order[:, 0, 3].tolist() for places, order in other_orders(poses)}
    assert moved == {places: [(number - places) % 5 for number in range(5)] for places in (-2, -1, 1, 2)}
    assert not list(other_orders(poses[:2]))


@pytest.mark.parametrize("factor", [1e-3, 0.2, 0.83, 4.0, 1e3])
def test_a_depth_scale_that_is_off_by_any_usual_factor_is_read_right(small, factor):
    wrong = replace(small, depths=(small.depths / factor).astype(np.float32), values=small.values / factor)
    readings = {reading.cause: reading for reading in other_readings(wrong, np.arange(COUNT), small.cam_from_world)}
    depth_reading = readings["depth scale"]
    assert depth_reading.factor == pytest.approx(factor, rel=2e-3)
    assert depth_reading.views.scale == depth_reading.factor
    assert depth_reading.agreement.share > 0.99


def test_the_focal_length_of_the_depth_is_refined_between_the_factors_that_are_tried(small):
    wrong = small.with_focal_times(1 / 0.87)
    readings = {reading.cause: reading for reading in other_readings(wrong, np.arange(COUNT), small.cam_from_world)}
    assert readings["depth focal length"].factor == pytest.approx(0.87, rel=2e-3)
    assert {reading.factor for cause, reading in readings.items() if cause not in ("depth scale", "order")} >= {None}


def test_normals_of_a_box_are_those_of_its_walls_and_there_are_none_beside_missing_depth(small):
    normals = surface_normals(small, 1)
    assert np.median(np.abs(normals).max(axis=2)) > 0.9999
    np.testing.assert_allclose(np.linalg.norm(normals[1:-1, 1:-1], axis=2), 1, atol=1e-9)
    holes = replace(small, depths=small.depths.copy())
    holes.depths[1, 20, 30] = 0
    missing = np.isnan(surface_normals(holes, 1)).any(axis=2)
    assert {(int(row), int(column)) for row, column in np.argwhere(missing)} == {(19, 30), (21, 30), (20, 29), (20, 31)}


@pytest.mark.parametrize("turn", [0.0, 2.0])
def test_a_view_that_was_moved_is_moved_back_by_as_much(small, turn):
    noise = np.eye(4)
    noise[:3, :3] = Rotation.from_rotvec(np.deg2rad(turn) * np.array([0.6, 0, 0.8])).as_matrix()
    noise[:3, 3] = 0.02, -0.01, 0.02
    poses = small.cam_from_world.copy()
    poses[2] = noise @ poses[2]
    wrong = replace(small, cam_from_world=poses)
    fit = fit_pose(wrong, 2, [surface_normals(wrong, view) for view in range(COUNT)])
    # A pixel at 2 m is 30 mm wide.
    assert fit.moved == pytest.approx(0.03, abs=4e-3)
    assert np.rad2deg(fit.turned) == pytest.approx(turn, abs=0.1)
    assert fit.spread < 0.5 * view_spreads(residuals(wrong))[2]


def test_a_camera_below_and_beside_the_depth_camera_is_fitted_in_both_directions():
    cameras = box_cameras(5, width=160, height=120, focal=112.0)
    poses = cameras.cam_from_world.copy()
    poses[:, 0, 3] -= 0.02
    poses[:, 1, 3] += 0.03
    beside = replace(box_cameras(5, width=160, height=120, focal=1.1 * 112), cam_from_world=poses)
    views_of_box = box_views(cameras, color_cameras=beside)
    fit = fit_registration(views_of_box, np.arange(5), depth_views(views_of_box, np.arange(5)))
    assert fit.differs
    assert fit.focal_factor == pytest.approx(1.1, abs=0.01)
    # Half a pixel at 2 m is 9 mm.
    np.testing.assert_allclose(fit.shift, (-0.02, 0.03), atol=0.009)
    assert fit.best > 0.8 > fit.given


def test_registration_says_nothing_without_shared_places_or_details(views_of_box, small):
    grey = replace(views_of_box, images=[np.full_like(image, 128) for image in views_of_box.images])
    fit = fit_registration(grey, np.arange(COUNT), small)
    assert (fit.focal_factor, fit.differs) == (1.0, False)
    assert np.isnan([fit.given, fit.best]).all()
    few = replace(small, values=np.where(np.arange(SAMPLES) < MIN_SHARED - 1, small.values, 0))
    assert fit_registration(views_of_box, np.arange(COUNT), few).pairs == 0


def test_a_check_looks_at_as_many_views_as_it_says(views_of_box):
    check = check_depth(views_of_box, limit=3)
    assert check.views.tolist() == [0, 2, 5]
    assert len(check.depth) == 3
    assert check.depth.min_compared == pytest.approx(0.02 * 3 * 2 * SAMPLES)
    assert check.comparable == (check.best.compared >= check.depth.min_compared)
