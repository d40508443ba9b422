"""Pictures: colors mean the same everywhere, lines land where pinholes put them, labels stay inside."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsencoder.core.errors import InputError
from gsencoder.infer.draw import (
    box_corners,
    color_bar,
    contact_sheet,
    depth_picture,
    draw_boxes,
    fit_pca_colors,
    legible_factor,
    pca_picture,
    relevancy_overlay,
)
from gsencoder.types import Box

K = np.array([[600, 0, 320], [0, 600, 240], [0, 0, 1]], np.float32)
POSE = np.eye(4, dtype=np.float32)


def make_box(center: tuple[float, ...], size: tuple[float, ...] = (1, 1, 1), query: str = "mug", rank: int = 0) -> Box:
    middle, sides = np.array(center, float), np.array(size, float)
    return Box(
        query=query,
        rank=rank,
        score=0.75,
        probability=1.0,
        aabb_min=middle - sides / 2,
        aabb_max=middle + sides / 2,
        obb_center=middle,
        obb_rotation=np.eye(3),
        obb_size=sides,
        rows=np.arange(3),
    )


def test_relevancy_goes_from_blue_to_red_and_leaves_unseen_pixels_grey() -> None:
    rgb = np.full((2, 3, 3), 100, np.uint8)
    values = np.array([[0, 0.5, 1], [np.nan, -5, 9]], np.float32)
    shown = relevancy_overlay(rgb, values).astype(int)
    assert shown[0, 0, 2] > shown[0, 0, 0]
    assert shown[0, 2, 0] > shown[0, 2, 2]
    assert shown[1, 0].tolist() == [100, 100, 100]
    assert np.array_equal(shown[1, 1:], shown[0, [0, 2]])


def test_corners_of_a_box_land_where_the_pinhole_puts_them() -> None:
    grey = np.full((480, 640, 3), 90, np.uint8)
    box = make_box((0.2, 0.1, 4.0))
    drawn = draw_boxes(grey, [box], POSE, K)
    changed = (drawn != 90).any(axis=2)
    corners = box_corners(box)
    for pixel in (corners @ K.T.astype(float))[:, :2] / corners[:, 2:]:
        x, y = np.round(pixel).astype(int)
        assert changed[y - 2 : y + 3, x - 2 : x + 3].any()
    assert not changed[200:215, 345:355].any()


def test_a_small_picture_shows_the_box_at_the_same_place() -> None:
    large = draw_boxes(np.full((480, 640, 3), 90, np.uint8), [make_box((0, 0, 4.0))], POSE, K)
    half = K.copy()
    half[:2] /= 2
    small = draw_boxes(np.full((240, 320, 3), 90, np.uint8), [make_box((0, 0, 4.0))], POSE, half)
    assert np.array_equal(large, small)


def test_the_origin_is_taken_off_before_projecting() -> None:
    grey = np.full((480, 640, 3), 90, np.uint8)
    origin = np.array([1e6, -1e6, 5.0])
    far = make_box(tuple(np.array([0, 0, 4.0]) + origin))
    expected = draw_boxes(grey, [make_box((0, 0, 4.0))], POSE, K)
    assert np.abs(draw_boxes(grey, [far], POSE, K, origin=origin).astype(int) - expected).max() == 0


def test_a_box_behind_the_camera_draws_nothing() -> None:
    grey = np.full((480, 640, 3), 90, np.uint8)
    assert np.array_equal(draw_boxes(grey, [make_box((0, 0, -3.0))], POSE, K), grey)
    assert np.array_equal(draw_boxes(grey, [make_box((500.0, 0, 3.0))], POSE, K), grey)


def test_a_box_around_the_camera_is_cut_at_the_near_plane() -> None:
    grey = np.full((480, 640, 3), 90, np.uint8)
    drawn = draw_boxes(grey, [make_box((0, 0, 0), (1, 1, 8))], POSE, K)
    assert (drawn != 90).any()


@given(
    st.tuples(*[st.floats(-1e6, 1e6)] * 3),
    st.tuples(*[st.floats(0, 1e6)] * 3),
    st.text(max_size=60),
    st.integers(1, 80),
    st.integers(1, 80),
)
@settings(deadline=None, max_examples=25)
def test_any_box_and_any_word_can_be_drawn_on_any_picture(center, size, query, width, height):
    drawn = draw_boxes(np.zeros((height, width, 3), np.uint8), [make_box(center, size, query)], POSE, K)
    factor = legible_factor(width)
    assert drawn.shape == (height * factor, width * factor, 3)


@pytest.mark.parametrize("size", [1e20, 1e300])
def test_a_box_larger_than_numbers_can_place_does_not_stop_the_picture(size: float) -> None:
    draw_boxes(np.zeros((48, 64, 3), np.uint8), [make_box((0.1, 0.2, 4.0), (size, size, size))], POSE, K)


def test_labels_of_boxes_in_one_place_do_not_cover_each_other() -> None:
    grey = np.full((480, 640, 3), 90, np.uint8)
    boxes = [make_box((0, 0, 6.0), query=word) for word in ("one", "two", "three", "four")]
    drawn = draw_boxes(grey, boxes, POSE, K)
    labels = [np.array(color) for color in ((31, 119, 180), (255, 127, 14), (44, 160, 44), (214, 39, 40))]
    heights = [(np.abs(drawn.astype(int) - color).max(axis=2) == 0).sum() for color in labels]
    assert min(heights) > 60 * 12


def test_pca_colors_are_the_same_for_the_same_feature_in_every_view(rng: np.random.Generator) -> None:
    features = rng.normal(size=(400, 6)).astype(np.float32) * np.float32([5, 4, 3, 1, 1, 1])
    colors = fit_pca_colors(features)
    a = pca_picture(features[:100].reshape(10, 10, 6), colors)
    b = pca_picture(features[50:150].reshape(20, 5, 6), colors)
    assert np.array_equal(a.reshape(-1, 3)[50:], b.reshape(-1, 3)[:50])
    assert a.std(axis=(0, 1)).min() > 20


def test_composited_features_are_divided_by_alpha_and_fade_to_white(rng: np.random.Generator) -> None:
    features = rng.normal(size=(64, 5)).astype(np.float32)
    colors = fit_pca_colors(features)
    whole = pca_picture(features.reshape(8, 8, 5), colors)
    half = pca_picture(features.reshape(8, 8, 5) * np.float32(0.5), colors, np.full((8, 8), 0.5, np.float32))
    assert np.abs(half.astype(int) - (whole.astype(int) + 255) / 2).max() <= 1
    nothing = pca_picture(np.zeros((2, 2, 5), np.float32), colors, np.zeros((2, 2), np.float32))
    assert (nothing == 255).all()


@pytest.mark.parametrize("columns", [1, 2])
def test_few_channels_and_constant_features_have_colors(columns: int) -> None:
    constant = np.ones((5, columns), np.float32)
    assert pca_picture(constant[None], fit_pca_colors(constant)).shape == (1, 5, 3)
    ramp = np.linspace(0, 1, 50, dtype=np.float32)[:, None] * np.ones(columns, np.float32)
    assert pca_picture(ramp[None], fit_pca_colors(ramp))[0, :, 0].std() > 50
    with pytest.raises(InputError, match="no features"):
        fit_pca_colors(constant[:0])


def test_near_depth_is_bright_and_missing_depth_is_grey() -> None:
    depth = np.array([[0, np.nan, np.inf, 1.0, 2, 3]], np.float32)
    shown = depth_picture(depth).astype(int)
    assert (shown[0, :3] == 48).all()
    brightness = shown[0, 3:].sum(axis=1)
    assert brightness[0] > brightness[1] > brightness[2]
    assert (depth_picture(np.zeros((2, 2), np.float32)) == 48).all()


def test_a_color_bar_marks_the_threshold() -> None:
    assert not np.array_equal(color_bar(200, 0.0, 1.0, mark=0.4), color_bar(200, 0.0, 1.0))
    assert np.array_equal(color_bar(200, 0.0, 1.0, mark=2.0), color_bar(200, 0.0, 1.0))


def test_a_sheet_holds_every_picture_at_one_width() -> None:
    pictures = [np.full((40 + 10 * k, 80, 3), 10 * k, np.uint8) for k in range(5)]
    sheet = contact_sheet(pictures, [f"picture {k} " * 9 for k in range(5)], columns=2, width=160)
    assert sheet.shape == (12 + (28 + 100 + 12) + (28 + 140 + 12) + (28 + 160 + 12), 12 + 2 * 172, 3)
    for k in range(5):
        assert (sheet == 10 * k).all(axis=2).sum() >= 160 * (2 * (40 + 10 * k)) * 0.99
    with pytest.raises(InputError, match="2 titles"):
        contact_sheet(pictures, ["a", "b"], columns=2)
