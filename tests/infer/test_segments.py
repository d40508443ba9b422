"""Segments: surfaces of one direction and color, wherever the splat lies and in whatever order its Gaussians come."""

import numpy as np
import pytest

from gsencoder.data.seeding.points import flat_gaussians
from gsencoder.infer.segments import average_within, surface_segments
from gsencoder.types import Gaussians


def room(seed: int = 0) -> tuple[Gaussians, np.ndarray]:
    """A floor, a wall, the top and a side of a box of another color, and the number of the part of each Gaussian."""
    rng = np.random.default_rng(seed)
    parts = [
        ([0, 0, 0], [[2, 0, 0], [0, 2, 0]], 0.4),
        ([0, 0, 0], [[2, 0, 0], [0, 0, 2]], 0.4),
        ([0.7, 0.7, 0.5], [[0.6, 0, 0], [0, 0.6, 0]], 0.9),
        ([0.7, 0.7, 0.05], [[0.6, 0, 0], [0, 0, 0.45]], 0.9),
    ]
    means, normals, colors, labels = [], [], [], []
    for number, (corner, sides, color) in enumerate(parts):
        axes = np.array(sides, float)
        count = int(2500 * np.linalg.norm(np.cross(*axes)))
        means.append(np.array(corner) + rng.random((count, 2)) @ axes)
        normals.append(np.tile(np.cross(*axes) / np.linalg.norm(np.cross(*axes)), (count, 1)))
        colors.append(np.full((count, 3), color))
        labels.append(np.full(count, number))
    joined = [np.concatenate(each).astype(np.float32) for each in (means, normals, colors)]
    return flat_gaussians(*joined, largest=0.03, measured=False), np.concatenate(labels)


def purity(segments: np.ndarray, labels: np.ndarray) -> float:
    """The share of Gaussians in the commonest part of their segment."""
    table = np.zeros((segments.max() + 1, labels.max() + 1))
    np.add.at(table, (segments, labels), 1)
    return float(table.max(axis=1).sum() / table.sum())


def test_walls_floors_and_sides_are_segments() -> None:
    gaussians, labels = room()
    segments = surface_segments(gaussians, 0.05)
    assert purity(segments, labels) > 0.95
    assert segments.max() < 12
    for number in range(4):
        assert np.bincount(segments[labels == number]).max() > 0.75 * (labels == number).sum()


def test_segments_do_not_depend_on_order_and_place() -> None:
    gaussians, _ = room()
    segments = surface_segments(gaussians, 0.05)
    shuffled = np.random.default_rng(1).permutation(len(gaussians))
    moved = gaussians.select(shuffled)
    moved = Gaussians(
        means=moved.means + np.float32(8.0),
        quats=moved.quats,
        scales=moved.scales,
        opacities=moved.opacities,
        sh=moved.sh,
    )
    theirs = surface_segments(moved, 0.05)
    pairs = np.unique(np.stack([segments[shuffled], theirs]), axis=1)
    assert pairs.shape[1] <= 1.2 * (segments.max() + 1)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_few_gaussians_are_one_segment_each_cell_or_all(count: int) -> None:
    gaussians, _ = room()
    segments = surface_segments(gaussians.select(np.arange(count)), 0.05)
    assert len(segments) == count
    assert set(segments) == set(range(segments.max() + 1))


def test_averages_keep_the_sums_of_segments_and_are_the_same_twice() -> None:
    rng = np.random.default_rng(0)
    segments, values = rng.integers(0, 7, 1000), rng.normal(size=(1000, 3)).astype(np.float32)
    averaged = values.copy()
    average_within(segments, averaged)
    for number in range(7):
        rows = segments == number
        np.testing.assert_allclose(averaged[rows], np.tile(values[rows].mean(axis=0), (rows.sum(), 1)), atol=1e-6)
    again = averaged.copy()
    average_within(segments, again)
    np.testing.assert_allclose(again, averaged, atol=1e-6)
