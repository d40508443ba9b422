"""Choosing frames: motion is measured in full and counted once, and of frames that show the same the sharp one wins."""

import numpy as np
import pytest
from pans import HEIGHT, WALL, WIDTH, blurred, looking_at, wallpaper
from scipy.ndimage import gaussian_filter

from gsencoder.core.errors import InputError
from gsencoder.data.video import BLOCK, Course, choose_frames, follow, laplacian_variance, median_motion


@pytest.mark.parametrize(("right", "down"), [(0, 0), (5, 0), (-7, 11), (20, -3), (0, 25)])
def test_the_motion_of_a_picture_is_its_shift(right, down):
    before = WALL[200 : 200 + HEIGHT, 200 : 200 + WIDTH]
    after = WALL[200 - down : 200 - down + HEIGHT, 200 - right : 200 - right + WIDTH]
    assert median_motion(before, after) == pytest.approx(np.hypot(right, down), abs=0.5)


def test_what_cannot_be_followed_counts_as_far_and_what_shows_nothing_as_no_motion():
    other = wallpaper(1).astype(np.float32)
    assert median_motion(WALL[:HEIGHT, :WIDTH], other[:HEIGHT, :WIDTH]) == BLOCK / 2
    grey = np.full((HEIGHT, WIDTH), 128, np.float32)
    assert median_motion(grey, grey + 40) == 0
    assert median_motion(WALL[:20, :30], WALL[:20, :30]) == 0


@pytest.mark.parametrize(("speed", "way"), [(0.4, 40), (1.7, 80), (12.0, 300)])
def test_slow_and_fast_motion_are_measured_in_full(speed, way):
    count = int(way / speed) + 1
    course = follow(looking_at(speed * index) for index in range(count))
    assert course.positions[-1] * WIDTH == pytest.approx(way, rel=0.06)
    assert (np.diff(course.positions) >= 0).all()


def test_a_camera_that_trembles_in_one_place_does_not_move():
    made = np.random.default_rng(0)
    course = follow(looking_at(300 + made.uniform(-2, 2), 100 + made.integers(-2, 3)) for _ in range(25))
    assert course.positions[-1] * WIDTH < 16


def test_sharpness_falls_with_blur_and_is_zero_for_one_color():
    sharp = looking_at(300).astype(np.float32)
    values = [laplacian_variance(gaussian_filter(sharp, sigma)) for sigma in (0, 0.5, 1, 2, 4)]
    assert values == sorted(values, reverse=True)
    assert laplacian_variance(np.full((40, 40), 200, np.float32)) == 0


def test_frames_are_evenly_apart_although_the_camera_paused_and_the_sharp_ones_are_taken():
    lefts = [*np.arange(0, 200, 4.0), *[200.0] * 20, *np.arange(200, 500, 4.0)]
    sharp = np.arange(len(lefts)) % 4 == 1
    both = zip(map(looking_at, lefts), sharp, strict=True)
    pictures = [picture if is_sharp else blurred(picture, 3) for picture, is_sharp in both]
    chosen = choose_frames(follow(pictures), motion=0.08, most=200, least=3)
    assert sharp[chosen].all()
    steps = np.diff(np.array(lefts)[chosen]) / WIDTH
    assert steps.mean() == pytest.approx(0.08, rel=0.1)
    assert steps.min() > 0.03
    assert steps.max() < 0.16


@pytest.mark.parametrize(("most", "least", "expected"), [(5, 3, 5), (50, 3, 11), (50, 20, 20), (50, 200, 50)])
def test_the_number_of_frames_follows_the_motion_between_the_limits(most, least, expected):
    course = Course(np.linspace(0, 1, 1001), np.ones(1001))
    chosen = choose_frames(course, motion=0.1, most=most, least=least)
    assert len(chosen) == expected
    assert (np.diff(chosen) > 0).all()


def test_a_jump_leaves_positions_without_a_frame():
    course = Course(np.concatenate((np.linspace(0, 0.1, 11), np.linspace(0.9, 1, 11))), np.ones(22))
    np.testing.assert_array_equal(choose_frames(course, motion=0.1, most=50, least=3), [0, 10, 11, 21])


def test_a_camera_that_hardly_moves_is_an_error():
    with pytest.raises(InputError, match=r"moves by 3% of its width in 9 frames; a reconstruction needs a camera that"):
        choose_frames(Course(np.linspace(0, 0.03, 9), np.ones(9)), motion=0.08, most=50, least=16)
