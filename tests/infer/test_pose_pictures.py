"""Pictures of what was found from a pose: where the ring, the label and the relevancy of each ray are drawn."""

from typing import Any

import numpy as np
import pytest
from feature_fields import plain_features
from splats import front_camera, one_gaussian, random_gaussians

from gsencoder.infer.draw import legible_factor
from gsencoder.infer.from_pose import (
    HIDDEN,
    VISIBLE,
    FeatureField,
    FromPoseConfig,
    PosePoint,
    SeenField,
    pose_picture,
    view_picture,
)
from gsencoder.render.images import render_image
from gsencoder.types import FeatureSpace, Gaussians, Scene


@pytest.fixture(autouse=True)
def labels(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Labels are listed in place of being drawn."""
    listed: list[Any] = []
    monkeypatch.setattr("gsencoder.infer.from_pose.draw_labels", lambda *arguments: listed.extend(arguments[2]))
    return listed


def seen_from(width: int, height: int, stride: int = 1, gaussians: Gaussians | None = None) -> SeenField:
    gaussians = one_gaussian() if gaussians is None else gaussians
    features = plain_features(np.ones((len(gaussians), 3)), FeatureSpace(name="toy", channels=3, text_encoder="toy"))
    scene = Scene(name="toy", gaussians=gaussians, features={"toy": features})
    return FeatureField(scene, config=FromPoseConfig(stride=stride)).at(front_camera(width, height))


def point_at(x: float, y: float, *, visible: bool = True) -> PosePoint:
    return PosePoint(
        query="mug", camera=0, visible=visible, threshold=0.5, relevancy=0.7, alpha=0.9, pixel=np.array([x, y]),
        depth=2.0, position=np.zeros(3),
    )  # fmt: skip


def drawn(seen: SeenField, point: PosePoint, relevancy: np.ndarray | None = None) -> np.ndarray:
    """The right half of a picture over a black view, without any relevancy unless it is given."""
    width, height = int(seen.cameras.widths[0]), int(seen.cameras.heights[0])
    if relevancy is None:
        relevancy = np.full(seen.b.shape, np.nan, np.float32)
    sheet = pose_picture(np.zeros((height, width, 3), np.uint8), seen, point, relevancy)
    wide, high = (legible_factor(width) * side for side in (width, height))
    gap, head = (sheet.shape[1] - 2 * wide) // 3, sheet.shape[0] - high
    left, right = (sheet[head - gap : head - gap + high, start : start + wide] for start in (gap, 2 * gap + wide))
    if np.isnan(relevancy).all():
        np.testing.assert_array_equal(left, right)
    return right


def middle_of(picture: np.ndarray, color: tuple[int, int, int]) -> tuple[float, float]:
    """The middle, x and y, of the pixels of a color."""
    rows, columns = np.nonzero((picture == color).all(axis=2))
    return (columns.min() + columns.max()) / 2, (rows.min() + rows.max()) / 2


@pytest.mark.parametrize(
    ("width", "height", "x", "y"), [(64, 48, 40.5, 20.5), (64, 48, 20.5, 39.5), (700, 90, 300.5, 50.5)]
)
def test_the_ring_lies_around_the_pixel_of_the_enlarged_view(width: int, height: int, x: float, y: float) -> None:
    factor = legible_factor(width)
    for visible, color in ((True, VISIBLE), (False, HIDDEN)):
        picture = drawn(seen_from(width, height), point_at(x, y, visible=visible))
        assert picture.shape == (factor * height, factor * width, 3)
        np.testing.assert_allclose(middle_of(picture, color), (factor * x, factor * y), atol=1)
        other = HIDDEN if visible else VISIBLE
        assert not (picture == other).all(axis=2).any()


@pytest.mark.parametrize(("width", "height", "stride"), [(640, 90, 1), (646, 93, 4), (650, 90, 3)])
def test_the_relevancy_of_a_ray_is_shown_over_the_block_of_pixels_around_it(width, height, stride):
    seen = seen_from(width, height, stride)
    lattice = seen.b.lattice
    point = point_at(300.5, 50.5)
    plain = drawn(seen, point)
    for row, column in ((lattice.height // 2, 20), (lattice.height // 2, lattice.width - 1), (lattice.height - 1, 100)):
        relevancy = np.full((lattice.height, lattice.width), np.nan, np.float32)
        relevancy[row, column] = 1.0
        rows, columns = np.nonzero((drawn(seen, point, relevancy) != plain).any(axis=2))
        x, y = lattice.x0 + column * stride, lattice.y0 + row * stride
        assert columns.min() <= x - 0.5 <= columns.max()
        assert rows.min() <= y - 0.5 <= rows.max()
        assert (columns.min(), rows.min()) == (column * stride, row * stride)
        # The last ray stands for the pixels beyond its block as well.
        assert columns.max() == (width - 1 if column == lattice.width - 1 else (column + 1) * stride - 1)
        assert rows.max() == (height - 1 if row == lattice.height - 1 else (row + 1) * stride - 1)


def test_a_label_beside_the_ring_says_where_the_word_is_or_why_it_is_nowhere(labels: list[Any]) -> None:
    seen = seen_from(64, 48)
    nowhere = point_at(np.nan, np.nan, visible=False)
    for point in (point_at(40.5, 30.5), point_at(3.5, 1.5, visible=False), nowhere):
        drawn(seen, point)
    # One for the view, and one for its relevancy.
    assert [text for _, text, _ in labels] == [
        text
        for text in ("mug 0.70, depth 2", "mug 0.70, not visible (needs 0.50)", "mug: nothing with features in view")
        for _ in range(2)
    ]
    assert labels[0][0][1] < 305 - 20
    assert labels[2][0][1] - 30 > 15 + 20
    assert [color for *_, color in labels] == [VISIBLE] * 2 + [HIDDEN] * 4
    assert not drawn(seen_from(64, 48, gaussians=one_gaussian((0, 0, -2))), nowhere).any()


@pytest.mark.parametrize("stride", [1, 4])
def test_the_view_is_drawn_in_all_its_pixels_whatever_the_stride(stride: int) -> None:
    gaussians = random_gaussians(50)
    seen = seen_from(61, 43, stride, gaussians)
    np.testing.assert_array_equal(view_picture(seen), render_image(gaussians, front_camera(), 0))
