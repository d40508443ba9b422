"""Numbered marks: which are drawn, where they stand, and that none hides another."""

import numpy as np
import pytest
import torch
from rooms import UP, merged, splat

from gsencoder.data.orbits import looking_cameras
from gsencoder.infer.draw import word_color
from gsencoder.infer.views.pictures import draw_marks
from gsencoder.infer.views.targets import Target, target_of
from gsencoder.render import Blend, blend
from gsencoder.types import Gaussians

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
