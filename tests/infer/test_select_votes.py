"""Which pixels are looked at, whose they are, and which entries of them count."""

from dataclasses import replace

import numpy as np
import pytest
from selected_rooms import splat_of

from gsencoder.data.orbits import looking_cameras
from gsencoder.infer.select import Votes, sample_views, votes
from gsencoder.types import Cameras, Gaussians


def above(width: int = 60, height: int = 40) -> Cameras:
    """One camera, a unit above the origin, that looks down."""
    return looking_cameras(
        np.array([[0.0, 0.0, 1.0]]), np.array([[0.0, 0.0, -1.0]]), np.array([0.0, 1.0, 0.0]), 60.0, width, height
    )


def sheets(*heights: float, opacities: tuple[float, ...]) -> Gaussians:
    """Flat Gaussians that are wider than the picture, above one another."""
    made = splat_of(np.array([[0.0, 0.0, height] for height in heights]), np.float32(opacities))
    return replace(made, scales=np.full((len(heights), 3), (3.0, 3.0, 0.001), np.float32))


def voted(gaussians: Gaussians, labels: list[int], *, spacing: float, pixels: int = 10_000) -> Votes:
    camera = above()
    samples = sample_views(camera, 1, pixels)
    return votes(gaussians, camera, np.array(labels, np.int32), max(labels), samples, spacing=spacing)


@pytest.mark.parametrize(
    ("size", "pixels", "stride"),
    [((200, 50), 10_000, 1), ((200, 50), 9_999, 2), ((200, 50), 2_500, 2), ((50, 200), 2_400, 3), ((8, 8), 10**6, 1)],
)
def test_no_more_pixels_than_asked_for_are_looked_at(size: tuple[int, int], pixels: int, stride: int) -> None:
    assert sample_views(above(*size), 1, pixels) == [(0, stride)]


@pytest.mark.parametrize(("views", "rows"), [(3, [0, 4, 8]), (20, [*range(9)]), (0, [])])
def test_views_are_evenly_spaced_and_all_where_there_are_fewer(views: int, rows: list[int]) -> None:
    assert [view for view, _ in sample_views(above().select([0] * 9), views)] == rows


def test_a_faint_gaussian_alone_has_its_pixels_and_all_its_weight_on_them() -> None:
    made = voted(sheets(0.0, opacities=(0.3,)), [1], spacing=0.02)
    assert made.present[0, 1] == pytest.approx(0.3 * 60 * 40, rel=0.05)
    assert made.present[0, 0] == 0


def test_what_lies_farther_behind_the_surface_than_a_spacing_and_a_fiftieth_of_its_depth_does_not_count() -> None:
    for below, spacing, counts in ((0.06, 0.05, True), (0.08, 0.05, False), (0.06, 0.03, False), (0.01, 0.0, True)):
        made = voted(sheets(0.0, -below, opacities=(0.7, 0.9)), [1, 0], spacing=spacing)
        assert made.present[0, 1] == pytest.approx(0.7 * 2400, rel=0.05)
        assert made.present[1, 1] == pytest.approx(0.3 * 0.9 * 2400 if counts else 0.0, rel=0.05)
        # Without the first the second would have all these pixels, which keep their label.
        assert made.removed[1, 1] == pytest.approx(0.9 * 2400 if counts else 0.0, rel=0.05)
        assert not made.removed[0].any()


def test_pixels_are_of_the_label_that_more_than_half_of_their_opacity_is_of() -> None:
    for opacities, owner in (((0.3, 0.9), 2), ((0.6, 0.9), 1), ((0.2, 0.1), 1)):
        made = voted(sheets(0.0, -0.01, opacities=opacities), [1, 2], spacing=0.1)
        assert made.present[:, owner].min() > 0
        assert not np.delete(made.present, owner, axis=1).any()
    # None of three has half of it.
    made = voted(sheets(0.0, -0.01, -0.02, opacities=(0.34, 0.5, 0.99)), [1, 2, 3], spacing=0.1)
    assert not made.present[:, 1:].any()


def test_every_third_pixel_counts_nine_times() -> None:
    gaussians, labels = sheets(0.0, -0.01, opacities=(0.7, 0.9)), [1, 0]
    fine, coarse = (voted(gaussians, labels, spacing=0.1, pixels=pixels) for pixels in (10_000, 300))
    np.testing.assert_allclose(coarse.present, fine.present, rtol=0.1)
    np.testing.assert_allclose(coarse.removed, fine.removed, rtol=0.1)
