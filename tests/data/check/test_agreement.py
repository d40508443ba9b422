"""What the numbers of a check mean: residuals, offsets, correlations, and the readings that are tried."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from textured_box import HALF, box_cameras, box_views

from gsencoder.data.check.agreement import (
    CLIP,
    MIN_SAMPLES,
    MIN_SHARED,
    SAMPLES,
    _details,
    agreement,
    agreement_map,
    color_correlations,
    depth_views,
    fit_registration,
    grey_pictures,
    on_surface,
    pair_offsets,
    residuals,
    shared_samples,
    view_correlations,
    world_samples,
)
from gsencoder.data.check.findings import _best_factor, other_orders, other_readings
from gsencoder.data.check.scene_check import _needed, check_depth, check_scene, fit_pose, surface_normals, view_spreads
from gsencoder.types import Views
from gsencoder.types.checks import invert_rigid, transform

COUNT = 6


@pytest.fixture(scope="module")
def views():
    return box_views(box_cameras(COUNT, width=96, height=72, focal=67.2))


@pytest.fixture(scope="module")
def small(views):
    return depth_views(views, np.arange(COUNT))


def off_walls(points: np.ndarray) -> np.ndarray:
    return np.asarray(np.abs(np.abs(points) - HALF).min(axis=-1))


def test_samples_lie_where_the_depth_says_in_any_unit(small):
    known = small.values > 0
    assert known.sum(axis=1).max() == SAMPLES
    assert off_walls(world_samples(small)[known]).max() < 1e-4
    millimeters = replace(small, depths=1000 * small.depths, values=1000 * small.values, scale=1e-3)
    np.testing.assert_allclose(world_samples(millimeters), world_samples(small), atol=1e-6)
    np.testing.assert_allclose(residuals(millimeters), residuals(small), atol=1e-6)


def test_samples_are_read_at_the_pixels_that_they_are_said_to_be_at(small):
    columns, rows = np.floor(small.pixels).astype(int).transpose(2, 0, 1)
    for view in range(COUNT):
        np.testing.assert_array_equal(small.depths[view, rows[view], columns[view]], small.values[view])


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


def test_offsets_of_views_near_and_far_are_told_apart():
    count = 10
    residual = np.full((count, count, MIN_SAMPLES), np.nan)
    for view, other in np.ndindex(count, count):
        distance = abs(view - other)
        if distance:
            size = 0.001 if distance <= 3 else 0.02 if distance >= count / 2 else 0.04
            residual[view, other] = size * (-1) ** view
    assert pair_offsets(residual) == pytest.approx((0.001, 0.02))
    residual[:, :, 0] = np.nan
    assert np.isnan(pair_offsets(residual)).all()


def test_spread_of_a_view_counts_both_directions():
    residual = np.full((3, 3, 2), np.nan)
    residual[0, 1] = 0.01, -0.03
    residual[1, 0] = 0.02, 7.0
    np.testing.assert_allclose(view_spreads(residual)[:2], (0.01 + 0.03 + 0.02 + CLIP) / 4)
    assert np.isnan(view_spreads(residual)[2])


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
        np.testing.assert_allclose(
            transform(world_from_cam[view], here), transform(world_from_cam[other], there), atol=1e-6
        )
    most = max(len(here) for _, _, here, _ in pairs)
    assert len(list(shared_samples(small, most))) >= 1
    assert not list(shared_samples(small, most + 1))


def test_colors_of_one_place_correlate_wherever_they_are_seen_from(views, small):
    grey = grey_pictures(views, np.arange(COUNT), small.depths.shape[1:])
    light = views.images[0].astype(float) @ (0.299, 0.587, 0.114) / 255
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


def test_colors_are_compared_where_both_photographs_show_the_place(small):
    """Photographs of a longer focal length leave out the edges of the depth images."""
    narrow = box_views(box_cameras(COUNT, width=96, height=72, focal=1.5 * 67.2))
    grey = grey_pictures(narrow, np.arange(COUNT), small.depths.shape[1:])
    known = color_correlations(small, grey, small.with_focal_times(1.5).Ks)
    assert np.nanmedian(known) > 0.9
    assert np.nanmin(known) > 0.6


def test_the_correlation_of_a_view_is_its_median_in_both_directions():
    nan = np.nan
    correlations = view_correlations(np.array([[nan, 0.1, 0.2], [0.3, nan, nan], [nan, nan, nan]]))
    np.testing.assert_allclose(correlations, (0.2, 0.2, 0.2))
    assert np.isnan(view_correlations(np.full((2, 2), nan))).all()


def test_orders_move_every_pose_by_one_or_two_places_either_way():
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 0, 3] = np.arange(5)
    moved = {places: order[:, 0, 3].tolist() for places, order in other_orders(poses)}
    assert moved == {places: [(number - places) % 5 for number in range(5)] for places in (-2, -1, 1, 2)}
    assert not list(other_orders(poses[:2]))


@pytest.mark.parametrize("factor", [1e-3, 1e-2, 0.1, 0.2, 0.25, 0.5, 0.83, 1.2, 2.0, 4.0, 5.0, 10.0, 1e2, 1e3])
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


def test_a_factor_under_which_hardly_anything_is_compared_says_nothing(small):
    wrong = small.with_focal_times(1.2)
    few = replace(small, values=np.where(np.arange(SAMPLES) < 5, small.values, 0))
    assert agreement(residuals(few)).spread < agreement(residuals(wrong)).spread
    reading = _best_factor("depth scale", lambda factor: few if factor == 2.0 else wrong, (1.0, 2.0))
    assert reading.factor != 2.0


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


def test_a_view_that_stands_right_stays(small):
    fit = fit_pose(small, 0, [surface_normals(small, view) for view in range(COUNT)])
    assert fit.moved < 0.008
    assert np.rad2deg(fit.turned) < 0.2
    assert fit.spread > 0.9 * view_spreads(residuals(small))[0]


def test_a_camera_below_and_beside_the_depth_camera_is_fitted_in_both_directions():
    cameras = box_cameras(5, width=160, height=120, focal=112.0)
    poses = cameras.cam_from_world.copy()
    poses[:, 0, 3] -= 0.02
    poses[:, 1, 3] += 0.03
    beside = replace(box_cameras(5, width=160, height=120, focal=1.1 * 112), cam_from_world=poses)
    views = box_views(cameras, color_cameras=beside)
    fit = fit_registration(views, np.arange(5), depth_views(views, np.arange(5)))
    assert fit.differs
    assert fit.focal_factor == pytest.approx(1.1, abs=0.01)
    # Half a pixel at 2 m is 9 mm.
    np.testing.assert_allclose(fit.shift, (-0.02, 0.03), atol=0.009)
    assert fit.best > 0.8 > fit.given


def test_registration_says_nothing_without_shared_places_or_details(views, small):
    grey = replace(views, images=[np.full_like(image, 128) for image in views.images])
    fit = fit_registration(grey, np.arange(COUNT), small)
    assert (fit.focal_factor, fit.differs) == (1.0, False)
    assert np.isnan([fit.given, fit.best]).all()
    few = replace(small, values=np.where(np.arange(SAMPLES) < MIN_SHARED - 1, small.values, 0))
    assert fit_registration(views, np.arange(COUNT), few).pairs == 0


def test_details_are_what_is_between_two_blurs(views):
    one = _details(views, 0, 96, 72)
    flat = _details(replace(views, images=[np.full_like(image, 77) for image in views.images]), 0, 96, 72)
    assert np.abs(flat).max() < 1e-9
    assert abs(one.mean()) < 0.02
    assert one.std() > 0.05
    negative = _details(replace(views, images=[255 - image for image in views.images]), 0, 96, 72)
    np.testing.assert_allclose(negative, -one, atol=0.01)


def test_a_check_looks_at_as_many_views_as_it_says(views):
    check = check_depth(views, limit=3)
    assert check.views.tolist() == [0, 2, 5]
    assert len(check.depth) == 3
    assert check.comparable == (check.best.compared >= 0.02 * 3 * 2 * SAMPLES)
    assert _needed(check.depth) == pytest.approx(0.02 * 3 * 2 * SAMPLES)
    depth, matches = check_scene(views)
    assert (depth.views.tolist(), matches) == (list(range(COUNT)), None)
