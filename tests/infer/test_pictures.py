"""Pictures: colors mean the same everywhere, lines land where pinholes put them, labels stay inside."""

import numpy as np
import pytest
import torch
from feature_fields import box_of
from hypothesis import given, settings
from hypothesis import strategies as st
from rooms import UP, merged, splat

from gsencoder.core.errors import InputError
from gsencoder.data.orbits import looking_cameras
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
    word_color,
)
from gsencoder.infer.views.pictures import draw_marks
from gsencoder.infer.views.targets import Target, target_of
from gsencoder.render import Blend, blend
from gsencoder.types import Box, Gaussians

K = np.array([[600, 0, 320], [0, 600, 240], [0, 0, 1]], np.float32)
POSE = np.eye(4, dtype=np.float32)
GREY = np.full((480, 640, 3), 90, np.uint8)


def make_box(center: tuple[float, ...], size: tuple[float, ...] = (1, 1, 1), query: str = "mug", rank: int = 0) -> Box:
    middle, half = np.array(center, float), np.array(size, float) / 2
    return box_of(query, rank, np.arange(3), middle - half, middle + half, score=0.75)


def test_relevancy_goes_from_blue_to_red_and_leaves_unseen_pixels_grey() -> None:
    rgb = np.full((2, 3, 3), 100, np.uint8)
    values = np.array([[0, 0.5, 1], [np.nan, -5, 9]], np.float32)
    shown = relevancy_overlay(rgb, values).astype(int)
    assert shown[0, 0, 2] > shown[0, 0, 0]
    assert shown[0, 2, 0] > shown[0, 2, 2]
    assert shown[1, 0].tolist() == [100, 100, 100]
    assert np.array_equal(shown[1, 1:], shown[0, [0, 2]])


def test_corners_of_a_box_land_where_the_pinhole_puts_them() -> None:
    box = make_box((0.2, 0.1, 4.0))
    drawn = draw_boxes(GREY, [box], POSE, K)
    changed = (drawn != 90).any(axis=2)
    corners = box_corners(box)
    for pixel in (corners @ K.T.astype(float))[:, :2] / corners[:, 2:]:
        x, y = np.round(pixel).astype(int)
        assert changed[y - 2 : y + 3, x - 2 : x + 3].any()
    assert not changed[200:215, 345:355].any()


def test_a_small_picture_shows_the_box_at_the_same_place() -> None:
    large = draw_boxes(GREY, [make_box((0, 0, 4.0))], POSE, K)
    half = K.copy()
    half[:2] /= 2
    small = draw_boxes(GREY[::2, ::2], [make_box((0, 0, 4.0))], POSE, half)
    assert np.array_equal(large, small)


def test_the_origin_is_taken_off_before_projecting() -> None:
    origin = np.array([1e6, -1e6, 5.0])
    far = make_box(tuple(np.array([0, 0, 4.0]) + origin))
    expected = draw_boxes(GREY, [make_box((0, 0, 4.0))], POSE, K)
    assert np.abs(draw_boxes(GREY, [far], POSE, K, origin=origin).astype(int) - expected).max() == 0


def test_a_box_behind_the_camera_draws_nothing() -> None:
    assert np.array_equal(draw_boxes(GREY, [make_box((0, 0, -3.0))], POSE, K), GREY)
    assert np.array_equal(draw_boxes(GREY, [make_box((500.0, 0, 3.0))], POSE, K), GREY)


def test_a_box_around_the_camera_is_cut_at_the_near_plane() -> None:
    drawn = draw_boxes(GREY, [make_box((0, 0, 0), (1, 1, 8))], POSE, K)
    assert (drawn != 90).any()


SIDE = st.integers(1, 80)


@given(st.tuples(*[st.floats(-1e6, 1e6)] * 3), st.tuples(*[st.floats(0, 1e6)] * 3), st.text(max_size=60), SIDE, SIDE)
@settings(max_examples=25)
def test_any_box_and_any_word_can_be_drawn_on_any_picture(center, size, query, width, height):
    drawn = draw_boxes(np.zeros((height, width, 3), np.uint8), [make_box(center, size, query)], POSE, K)
    factor = legible_factor(width)
    assert drawn.shape == (height * factor, width * factor, 3)


def test_labels_of_boxes_in_one_place_do_not_cover_each_other() -> None:
    boxes = [make_box((0, 0, 6.0), query=word) for word in ("one", "two", "three", "four")]
    drawn = draw_boxes(GREY, boxes, POSE, K)
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


WIDTH, HEIGHT, FOCAL, FAR = 320, 240, 300.0, 3.0
RADIUS = 7


def scene(*places: tuple[float, float], half: int = 20) -> tuple[Gaussians, list[Target], Blend]:
    """Square plates of 2·half pixels about places in the picture, all at one depth."""
    steps = np.arange(-half, half + 1) * FAR / FOCAL
    plates = []
    for x, y in places:
        grid = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
        middle = (np.array([x, y]) - (WIDTH / 2, HEIGHT / 2)) * FAR / FOCAL
        plates.append(np.column_stack([np.full(len(grid), FAR), -(grid[:, 0] + middle[0]), -(grid[:, 1] + middle[1])]))
    gaussians = splat(np.concatenate(plates), 0.6 * FAR / FOCAL)
    count = len(plates[0]) if plates else 0
    targets = [
        target_of(f"plate {number}", gaussians, np.arange(number * count, (number + 1) * count))
        for number in range(len(plates))
    ]
    cameras = looking_cameras(np.zeros((1, 3)), np.array([[1.0, 0, 0]]), UP, FOCAL, WIDTH, HEIGHT)
    return gaussians, targets, blend(gaussians, cameras, 0)


def discs(picture: np.ndarray, numbers: int) -> list[np.ndarray]:
    """The middle of each number's color in a picture that was black."""
    circles = []
    for number in range(numbers):
        pixels = np.argwhere((picture == word_color(number)).all(axis=2))[:, ::-1]
        circles.append(np.median(pixels, axis=0) if len(pixels) else np.full(2, np.nan))
    return circles


BLACK = np.zeros((HEIGHT, WIDTH, 3), np.uint8)


def test_marks_of_large_things_stand_on_them_in_their_order() -> None:
    places = ((80.0, 60.0), (240.0, 180.0))
    _, targets, b = scene(*places, half=40)
    picture, drawn = draw_marks(BLACK, b, targets)
    assert drawn == {1, 2}
    for center, disc in zip(places, discs(picture, 2), strict=True):
        assert np.abs(disc - center).max() < 4


def test_marks_of_small_things_stand_beside_them_with_a_line_to_them() -> None:
    _, targets, b = scene((160.0, 120.0), half=4)
    picture, drawn = draw_marks(BLACK, b, targets)
    assert drawn == {1}
    (disc,) = discs(picture, 1)
    assert RADIUS < np.linalg.norm(disc - (160, 120)) < 6 * RADIUS
    # The line begins on the thing.
    assert (picture[115:126, 155:166] != 0).any()


@pytest.mark.parametrize(("half", "on"), [(10, False), (14, True)])
def test_a_mark_stands_on_a_thing_of_which_it_hides_a_quarter_at_most(half: int, on: bool) -> None:
    """A disc has 154 pixels, the plates have 441 and 841."""
    _, targets, b = scene((160.0, 120.0), half=half)
    (disc,) = discs(draw_marks(BLACK, b, targets)[0], 1)
    assert (np.abs(disc - (160, 120)).max() < half) == on


@pytest.mark.parametrize("half", [4, 30])
def test_no_mark_hides_another_or_leaves_the_picture(half: int) -> None:
    places = ((8.0, 8.0), (14.0, 10.0), (20.0, 12.0), (310.0, 232.0), (312.0, 120.0), (160.0, 236.0))
    _, targets, b = scene(*places, half=half)
    picture, drawn = draw_marks(BLACK, b, targets)
    circles = [disc for number, disc in enumerate(discs(picture, len(places)), start=1) if number in drawn]
    assert len(circles) == len(drawn) >= 4
    for index, disc in enumerate(circles):
        assert (disc >= RADIUS).all()
        assert (disc <= (WIDTH - RADIUS, HEIGHT - RADIUS)).all()
        assert all(np.linalg.norm(disc - other) > 2 * RADIUS - 1 for other in circles[:index])


def test_things_that_are_hidden_or_too_small_carry_no_mark() -> None:
    gaussians, (front,), _ = scene((160.0, 120.0))
    behind = splat(gaussians.means + np.array([1.0, 0, 0], np.float32), 0.02)
    both = merged(gaussians, behind)
    cameras = looking_cameras(np.zeros((1, 3)), np.array([[1.0, 0, 0]]), UP, FOCAL, WIDTH, HEIGHT)
    hidden = target_of("behind", both, np.arange(len(gaussians), len(both)))
    speck = target_of("speck", both, front.rows[:1])
    picture, drawn = draw_marks(BLACK, blend(both, cameras, 0), [hidden, front, speck])
    assert drawn == {2}
    assert np.isnan(discs(picture, 1)[0]).all()


def test_a_thing_is_marked_from_twelve_pixels_of_half_weight_on() -> None:
    _, (target,), b = scene((160.0, 120.0), half=40)
    rows = target_rows(b, target)
    for kept, drawn in ((11, set()), (12, {1})):
        assert draw_marks(BLACK, with_weights(b, rows[:kept], 0.6), [target])[1] == drawn
    assert draw_marks(BLACK, with_weights(b, rows[:12], 0.4), [target])[1] == set()


def target_rows(b: Blend, target: Target) -> np.ndarray:
    solid = np.bincount(rows_of(b), b.weight.numpy() * np.isin(b.col.numpy(), target.rows), minlength=b.rows)
    return np.flatnonzero(solid > 0.9)


def rows_of(b: Blend) -> np.ndarray:
    return np.repeat(np.arange(b.rows), b.crow.diff().numpy())


def with_weights(b: Blend, rows: np.ndarray, share: float) -> Blend:
    """A blend in which the target has a share of the weight of some pixels, and nothing of others."""
    of_row = np.bincount(rows_of(b), b.weight.numpy(), minlength=b.rows)
    scale = np.where(np.isin(np.arange(b.rows), rows), share / np.maximum(of_row, 1e-9), 0)
    weight = b.weight * torch.from_numpy(scale[rows_of(b)]).to(b.weight)
    return Blend(b.crow, b.col, weight, b.depths, b.lattice, b.config)
