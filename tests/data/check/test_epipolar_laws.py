"""Matches of projected points, without photographs: distances from epipolar lines, readings, views astray."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from textured_box import box_cameras

from gsencoder.data.check.epipolar import (
    CLIP,
    FOCAL_FACTORS,
    MIN_MATCHES,
    _best_reading,
    _spread_triples,
    _stray_views,
    consistent_matches,
    pair_errors,
)
from gsencoder.data.check.pose_readings import other_poses
from gsencoder.data.seeding.feature_matches import PairMatches, epipolar_distances, fundamental_matrix
from gsencoder.types import Cameras

NAMES = tuple(f"{view}.png" for view in range(6))


@pytest.fixture(scope="module")
def cameras() -> Cameras:
    return box_cameras(6, width=320, height=240, focal=200.0)


@pytest.fixture(scope="module")
def matches(cameras: Cameras) -> list[PairMatches]:
    """Points in the middle, seen by every view."""
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (60, 3)) + cameras.centers.mean(axis=0)
    pixels = cameras.project(points)[0].astype(np.float64)
    return [
        PairMatches(first=first, second=second, first_pixels=pixels[first], second_pixels=pixels[second])
        for first in range(6)
        for second in range(first + 1, 6)
    ]


def with_poses(cameras: Cameras, poses: np.ndarray) -> Cameras:
    return replace(cameras, cam_from_world=poses.astype(np.float32))


def test_matches_of_one_point_lie_on_their_lines_and_errors_are_clipped(
    cameras: Cameras, matches: list[PairMatches]
) -> None:
    assert pair_errors(cameras, matches).max() < 0.01
    far = replace(
        matches[0], second_pixels=matches[0].second_pixels + np.random.default_rng(0).normal(size=(60, 2)) * 1e4
    )
    assert pair_errors(cameras, [far])[0] > 0.9 * CLIP
    assert pair_errors(cameras, [far])[0] <= CLIP


def test_the_distance_from_a_line_is_the_larger_of_both() -> None:
    """Views side by side: lines are rows, and in the second picture, of twice the focal length, twice as far apart."""
    cameras = replace(box_cameras(2), cam_from_world=np.tile(np.eye(4, dtype=np.float32), (2, 1, 1)))
    cameras.cam_from_world[1, 0, 3] = -1
    cameras.Ks[1, :2, :2] *= 2
    middle = cameras.Ks[0, :2, 2].astype(np.float64)
    matrix = fundamental_matrix(cameras, 0, 1)
    first, second = middle[None] + (10, 5), middle[None] + (30, 16)
    np.testing.assert_allclose(epipolar_distances(matrix, first, second), [6.0], rtol=1e-5)
    np.testing.assert_allclose(epipolar_distances(matrix.T, second, first), [6.0], rtol=1e-5)
    assert epipolar_distances(np.zeros((3, 3)), first, second).tolist() == [0]


@pytest.mark.parametrize("cause", ["axes", "inverse", "inverse and axes"])
def test_poses_that_were_exchanged_are_read_back(cameras: Cameras, matches: list[PairMatches], cause: str) -> None:
    wrong = with_poses(cameras, other_poses(cameras.cam_from_world.astype(np.float64))[cause])
    if cause == "inverse and axes":
        # The inverse of a turned inverse: what the reading of that name undoes.
        flip = np.diag([1.0, -1, -1, 1])
        wrong = with_poses(cameras, np.linalg.inv(flip @ cameras.cam_from_world.astype(np.float64)))
    reading, factor, best, error = _best_reading(wrong, wrong, np.arange(6), matches)
    assert (reading, factor) == (cause, None)
    assert error < 0.05
    np.testing.assert_allclose(best.cam_from_world, cameras.cam_from_world, atol=1e-5)


@pytest.mark.parametrize("places", [-2, -1, 1, 2])
def test_poses_of_the_next_photographs_are_read_back(cameras: Cameras, matches: list[PairMatches], places: int) -> None:
    wrong = with_poses(cameras, np.roll(cameras.cam_from_world, -places, axis=0))
    cause, factor, _, error = _best_reading(wrong, wrong, np.arange(6), matches)
    assert (cause, factor) == ("order", places)
    assert error < 0.01


@pytest.mark.parametrize("factor", [FOCAL_FACTORS[0], FOCAL_FACTORS[11], FOCAL_FACTORS[-3]])
def test_another_focal_length_is_read_back(cameras: Cameras, matches: list[PairMatches], factor: float) -> None:
    Ks = cameras.Ks.copy()
    Ks[:, :2, :2] /= np.float32(factor)
    wrong = replace(cameras, Ks=Ks)
    cause, read, best, error = _best_reading(wrong, wrong, np.arange(6), matches)
    assert (cause, read) == ("focal length", factor)
    assert error < 0.01
    np.testing.assert_allclose(best.Ks, cameras.Ks, rtol=1e-5)


def test_two_views_astray_are_both_named_the_worse_one_first(cameras: Cameras, matches: list[PairMatches]) -> None:
    poses = cameras.cam_from_world.astype(np.float64)
    for view, size in ((1, 3.0), (4, 6.0)):
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_rotvec(np.deg2rad([size, size, 0])).as_matrix()
        poses[view] = turn @ poses[view]
    errors = pair_errors(with_poses(cameras, poses), matches)
    assert [finding.view for finding in _stray_views(errors, matches, NAMES)] == ["4.png", "1.png"]
    assert _stray_views(pair_errors(cameras, matches), matches, NAMES) == []


@pytest.mark.parametrize(("error", "named"), [(2.9, False), (3.1, True)])
def test_a_view_is_astray_above_three_pixels(matches: list[PairMatches], error: float, named: bool) -> None:
    errors = np.array([error if 2 in (pair.first, pair.second) else 0.5 for pair in matches])
    assert bool(_stray_views(errors, matches, NAMES)) == named


@pytest.mark.parametrize(("usual", "named"), [(2.0, True), (3.5, False)])
def test_a_view_is_astray_above_three_times_what_is_usual(
    matches: list[PairMatches], usual: float, named: bool
) -> None:
    errors = np.array([10.0 if 2 in (pair.first, pair.second) else usual for pair in matches])
    assert bool(_stray_views(errors, matches, NAMES)) == named


def test_of_few_views_none_is_astray(matches: list[PairMatches]) -> None:
    """With three views each has two pairs, and the others one."""
    three = [pair for pair in matches if pair.second < 3]
    assert _stray_views(np.array([9.0, 9.0, 0.1]), three, NAMES) == []
    four = [pair for pair in matches if pair.second < 4]
    errors = np.array([9.0 if pair.first == 0 else 0.1 for pair in four])
    assert [finding.view for finding in _stray_views(errors, four, NAMES)] == ["0.png"]


def test_two_pairs_are_enough_to_call_a_view_astray_and_one_is_not(matches: list[PairMatches]) -> None:
    two = [pair for pair in matches if pair.second < 4 and (pair.first, pair.second) != (0, 3)]
    errors = np.array([9.0 if pair.first == 0 else 0.1 for pair in two])
    assert [finding.view for finding in _stray_views(errors, two, NAMES)] == ["0.png"]
    one = [pair for pair in two if (pair.first, pair.second) != (0, 2)]
    assert _stray_views(np.array([9.0 if pair.first == 0 else 0.1 for pair in one]), one, NAMES) == []


def test_groups_of_three_neighbors_are_spread_over_all_views() -> None:
    assert _spread_triples(24, 24).tolist() == list(range(24))
    assert _spread_triples(25, 6).tolist() == [0, 1, 2, 22, 23, 24]
    rows = _spread_triples(100, 24)
    assert len(rows) == 24
    assert (rows[0], rows[-1]) == (0, 99)
    assert (np.diff(rows.reshape(-1, 3), axis=1) == 1).all()
    assert _spread_triples(10, 2).tolist() == [0, 1, 2]


def test_matches_that_fit_no_fundamental_matrix_are_left_out(matches: list[PairMatches]) -> None:
    made = np.random.default_rng(0)
    pair = matches[0]
    noisy = pair.second_pixels.copy()
    noisy[:15] = made.uniform(0, 240, (15, 2))
    (pair_matches,) = consistent_matches([replace(pair, second_pixels=noisy)])
    assert 45 <= len(pair_matches.first_pixels) <= 50
    few = slice(0, MIN_MATCHES - 1)
    assert consistent_matches([replace(pair, first_pixels=pair.first_pixels[few], second_pixels=noisy[few])]) == []
    exactly = slice(60 - MIN_MATCHES, 60)
    again = replace(pair, first_pixels=pair.first_pixels[exactly], second_pixels=pair.second_pixels[exactly])
    assert len(consistent_matches([again])) == 1
    for right, wrong, stays in ((40, 40, True), (30, 70, False)):
        first = np.concatenate((pair.first_pixels[:right], made.uniform(0, 240, (wrong, 2))))
        second = np.concatenate((pair.second_pixels[:right], made.uniform(0, 240, (wrong, 2))))
        assert bool(consistent_matches([replace(pair, first_pixels=first, second_pixels=second)])) == stays
