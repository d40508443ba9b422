"""Matches of projected points, without photographs: distances from epipolar lines, readings, views astray, evidence."""

from collections.abc import Iterable
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from textured_box import box_cameras

from gsencoder.data.check.agreement import other_poses
from gsencoder.data.check.epipolar import (
    CLIP,
    MIN_MATCHES,
    _best_reading,
    _spread_triples,
    _stray_views,
    _usual_error,
    consistent_matches,
    fit_pose_to_matches,
    judge_matches,
    mean_error,
    near_pairs,
)
from gsencoder.data.seeding.matches import PairMatches, epipolar_distances, fundamental_matrix
from gsencoder.types import Cameras

NAMES = tuple(f"{view}.png" for view in range(6))


@pytest.fixture(scope="module")
def cameras():
    return box_cameras(6, width=320, height=240, focal=200.0)


@pytest.fixture(scope="module")
def matches(cameras):
    """Points in the middle, seen by every view."""
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (60, 3)) + cameras.centers.mean(axis=0)
    pixels = cameras.project(points)[0].astype(np.float64)
    return pairs_of(pixels, combinations(range(6), 2))


def pairs_of(pixels: np.ndarray, pairs: Iterable[tuple[int, int]]) -> list[PairMatches]:
    return [PairMatches(first=a, second=b, first_pixels=pixels[a], second_pixels=pixels[b]) for a, b in pairs]


def test_views_without_a_pair_that_fits_are_named_as_unmatched(cameras, matches):
    alone = [pair for pair in matches if 5 not in (pair.first, pair.second)]
    check = judge_matches(alone, cameras, cameras, np.arange(6), NAMES)
    assert check.decided
    assert check.unmatched == (NAMES[5],)
    # A pair that does not fit says as little.
    moved = turned(cameras, {5: 10})
    with_one = [*alone, next(pair for pair in matches if pair.second == 5)]
    assert judge_matches(with_one, moved, moved, np.arange(6), NAMES).unmatched == (NAMES[5],)
    assert judge_matches(matches, cameras, cameras, np.arange(6), NAMES).unmatched == ()


def with_poses(cameras: Cameras, poses: np.ndarray) -> Cameras:
    return replace(cameras, cam_from_world=poses.astype(np.float32))


def turned(cameras: Cameras, degrees: dict[int, float]) -> Cameras:
    """Some views turned about the diagonal of their pictures."""
    poses = cameras.cam_from_world.astype(np.float64)
    for view, size in degrees.items():
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_rotvec(np.deg2rad([size, size, 0])).as_matrix()
        poses[view] = turn @ poses[view]
    return with_poses(cameras, poses)


def turned_to_error(cameras: Cameras, matches: list[PairMatches], view: int, error: float) -> Cameras:
    """A view turned so far that the pairs by which it is judged have this mean error."""
    own = [pair for pair in matches if view in (pair.first, pair.second)]
    degrees, wrong = 1.0, cameras
    for _ in range(20):
        wrong = turned(cameras, {view: degrees})
        degrees *= error / mean_error(wrong, near_pairs(wrong, own, view))
    return wrong


def shifted(pair: PairMatches, cameras: Cameras, pixels: float) -> PairMatches:
    """The matches with half of those of the second view moved to the right, the others to the left: a median error."""
    size, moved = pixels, pair
    for _ in range(20):
        moved = replace(pair, second_pixels=pair.second_pixels + size * np.resize([1, -1], 60)[:, None] * (1, 0))
        size *= pixels / _usual_error(cameras, [moved])
    return moved


def astray(cameras: Cameras, matches: list[PairMatches], limit: float = 1.0) -> list[str | None]:
    return [finding.view for finding in _stray_views(cameras, matches, NAMES, limit)]


def judged(cameras: Cameras, matches: list[PairMatches]) -> tuple[list[tuple[str, str | None]], bool]:
    check = judge_matches(matches, cameras, cameras, np.arange(6), NAMES)
    return [(finding.cause, finding.view) for finding in check.findings], check.decided


def test_matches_of_one_point_lie_on_their_lines_and_errors_are_clipped(cameras, matches):
    assert max(mean_error(cameras, [pair]) for pair in matches) < 0.01
    noise = np.random.default_rng(0).normal(size=(60, 2)) * 1e4
    far = replace(matches[0], second_pixels=matches[0].second_pixels + noise)
    assert 0.9 * CLIP < mean_error(cameras, [far]) <= CLIP
    assert mean_error(cameras, [far, matches[1]]) == pytest.approx(mean_error(cameras, [far]) / 2, abs=0.01)


def test_the_distance_from_a_line_is_the_larger_of_both():
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


def test_the_next_photographs_are_those_of_the_scene_and_not_of_the_views_that_were_looked_at():
    right, rows = box_cameras(9, width=320, height=240, focal=200.0), np.array([1, 3, 4, 7])
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (60, 3)) + right.centers.mean(axis=0)
    pixels = right.project(points)[0].astype(np.float64)[rows]
    pairs = pairs_of(pixels, ((0, 1), (0, 2), (1, 2), (2, 3)))
    wrong = with_poses(right, np.roll(right.cam_from_world, 1, axis=0))
    cause, places, best, error = _best_reading(wrong.select(rows), wrong, rows, pairs)
    assert (cause, places) == ("order", -1)
    assert error < 0.01
    np.testing.assert_array_equal(best.cam_from_world, right.cam_from_world[rows])


def test_the_figures_of_a_check_are_means_of_pairs_a_share_of_matches_and_the_worst_pair(cameras, matches):
    rough = shifted(matches[1], cameras, 9.0)
    rough = replace(rough, first_pixels=rough.first_pixels[:20], second_pixels=rough.second_pixels[:20])
    errors = [mean_error(cameras, [pair]) for pair in (matches[0], rough, matches[2])]
    assert errors[1] > 5
    check = judge_matches([matches[0], rough, matches[2]], cameras, cameras, np.arange(6), NAMES)
    assert (check.pairs, check.matches, check.worst) == (3, 140, rough)
    assert check.error == pytest.approx(np.mean(errors))
    fundamental = fundamental_matrix(cameras, rough.first, rough.second)
    near = epipolar_distances(fundamental, rough.first_pixels, rough.second_pixels) <= 2
    assert 0 < near.sum() < 10
    assert check.share == pytest.approx((120 + near.sum()) / 140)


def test_once_all_poses_are_read_rightly_a_view_is_astray_by_what_is_usual_then(cameras, matches):
    wrong = turned_to_error(cameras, matches, 2, 4.5)
    axes = with_poses(wrong, other_poses(wrong.cam_from_world.astype(np.float64))["axes"])
    assert judged(axes, matches) == ([("axes", None), ("stray view", "2.png")], True)


def test_two_views_astray_are_both_named_the_worse_one_first(cameras, matches):
    assert astray(turned(cameras, {1: 3.0, 4: 6.0}), matches) == ["4.png", "1.png"]
    assert astray(cameras, matches) == []


@pytest.mark.parametrize(("error", "named"), [(1.9, False), (2.1, True)])
def test_a_view_is_astray_above_two_pixels(cameras, matches, error, named):
    assert astray(turned_to_error(cameras, matches, 2, error), matches, limit=0.5) == ["2.png"] * named


@pytest.mark.parametrize(("usual", "named"), [(2.2, True), (2.7, False)])
def test_a_view_is_astray_above_three_times_what_is_usual(cameras, matches, usual, named):
    rough = [pair if 2 in (pair.first, pair.second) else shifted(pair, cameras, usual) for pair in matches]
    assert astray(turned_to_error(cameras, matches, 2, 7.5), rough, limit=4.0) == ["2.png"] * named


def test_two_pairs_are_enough_to_call_a_view_astray_and_one_is_not(cameras, matches):
    wrong = turned(cameras, {0: 5.0})
    # With three views each has two pairs, and the others one.
    assert astray(wrong, [pair for pair in matches if pair.second < 3]) == []
    two = [pair for pair in matches if pair.second < 4 and (pair.first, pair.second) != (0, 3)]
    assert astray(wrong, two) == ["0.png"]
    assert astray(wrong, [pair for pair in two if (pair.first, pair.second) != (0, 2)]) == []


def test_a_view_without_a_pose_that_fits_is_not_astray(cameras, matches):
    """Each of its pairs fits a fundamental matrix, but they fit no one pose: a motif that repeats itself."""
    motif = []
    for index, pair in enumerate(matches):
        if 2 in (pair.first, pair.second):
            # What this pair shows is where it would be from a pose of its own.
            points = np.random.default_rng(index).uniform(-0.5, 0.5, (60, 3)) + cameras.centers.mean(axis=0)
            own = turned(cameras, {2: (-12.0, 4.0, 12.0, -4.0, 8.0)[(pair.first + pair.second - 2) % 5]})
            pixels = own.project(points)[0].astype(np.float64)
            pair = replace(pair, first_pixels=pixels[pair.first], second_pixels=pixels[pair.second])
        motif.append(pair)
    assert mean_error(cameras, [pair for pair in motif if 2 in (pair.first, pair.second)]) > 5
    assert len(consistent_matches(motif)) == len(motif)
    assert astray(cameras, motif) == []


def test_a_pose_with_more_than_a_third_of_the_error_is_none_of_a_view_astray(cameras, matches):
    """Two of three pairs fit it; the third, ten pixels off, fits neither."""
    pairs = {(pair.first, pair.second): pair for pair in matches if pair.second < 4}
    far = np.random.default_rng(0).normal(size=(60, 2)) * 16
    pairs[0, 3] = replace(pairs[0, 3], second_pixels=pairs[0, 3].second_pixels + far)
    for error, named in ((8.5, []), (17.0, ["0.png"])):
        wrong = turned_to_error(cameras, [pairs[0, 1], pairs[0, 2]], 0, error)
        assert astray(wrong, [*pairs.values()]) == named


def test_far_pairs_that_do_not_fit_accuse_nobody(cameras, matches):
    near = {(pair.first, pair.second) for pair in near_pairs(cameras, matches)}
    assert 3 <= len(near) < len(matches)
    moved = [replace(pair, second_pixels=pair.second_pixels + np.array([40, 25])) for pair in matches]
    wallpaper = [a if (a.first, a.second) in near else b for a, b in zip(matches, moved, strict=True)]
    assert judged(cameras, wallpaper) == ([], True)
    assert judge_matches(wallpaper, cameras, cameras, np.arange(6), NAMES).error > 3


def test_a_view_is_judged_by_the_pairs_with_the_views_next_to_it(matches):
    """Places on a line that look the same way: the nearest three of the first one are those next to it."""
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, 0, 3] = -np.array([0, 1, 2, 4, 8, 16])
    line = with_poses(box_cameras(6, width=320, height=240, focal=200.0), poses)
    assert [(pair.first, pair.second) for pair in near_pairs(line, matches, 0)] == [(0, 1), (0, 2), (0, 3)]
    assert [(pair.first, pair.second) for pair in near_pairs(line, matches, 5)] == [(2, 5), (3, 5), (4, 5)]
    poses[1, :3, :3] = Rotation.from_euler("y", 120, degrees=True).as_matrix()
    line = with_poses(line, poses)
    assert (0, 1) not in [(pair.first, pair.second) for pair in near_pairs(line, matches, 0)]


def test_a_pose_is_found_from_matches(cameras, matches):
    poses = turned(cameras, {3: 12.0}).cam_from_world.astype(np.float64)
    poses[3, :3, 3] += 0.3
    own = [pair for pair in matches if 3 in (pair.first, pair.second)]
    wrong = with_poses(cameras, poses)
    assert mean_error(wrong, own) > 5
    found = fit_pose_to_matches(wrong, 3, own)
    assert mean_error(found, own) < 0.05
    np.testing.assert_allclose(found.cam_from_world[3], cameras.cam_from_world[3], atol=2e-3)
    others = np.arange(6) != 3
    np.testing.assert_array_equal(found.cam_from_world[others], wrong.cam_from_world[others])


def test_nothing_is_said_on_little_evidence(cameras, matches):
    wrong = turned(cameras, {0: 9.0, 2: -9.0, 4: 5.0})
    assert judged(wrong, []) == ([], False)
    assert judged(wrong, matches[:2]) == judged(cameras, matches[:2]) == ([], False)
    assert judged(cameras, matches[:3]) == ([], True)


def test_poses_that_fit_nowhere_are_called_wrong_by_six_pairs_and_not_by_five(cameras, matches):
    poses = cameras.cam_from_world.astype(np.float64)
    poses[:, :3, :3] = Rotation.random(6, random_state=3).as_matrix() @ poses[:, :3, :3]
    wrong = with_poses(cameras, poses)
    path = [pair for pair in matches if pair.second - pair.first == 1]
    assert judged(wrong, path) == ([], False)
    (last,) = [pair for pair in matches if (pair.first, pair.second) == (0, 5)]
    assert judged(wrong, [*path, last]) == ([("unknown", None)], True)


def test_groups_of_three_neighbors_are_spread_over_all_views():
    assert _spread_triples(24, 24).tolist() == list(range(24))
    assert _spread_triples(25, 6).tolist() == [0, 1, 2, 22, 23, 24]
    rows = _spread_triples(100, 24)
    assert len(rows) == 24
    assert (rows[0], rows[-1]) == (0, 99)
    assert (np.diff(rows.reshape(-1, 3), axis=1) == 1).all()
    assert _spread_triples(10, 2).tolist() == [0, 1, 2]


def test_matches_that_fit_no_fundamental_matrix_are_left_out(matches):
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
