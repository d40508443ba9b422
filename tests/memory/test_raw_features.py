"""Samples of raw features: some of them, all with the same probability, and the same again."""

from collections.abc import Iterator

import numpy as np
import pytest

from gsencoder.memory.bank import MapStream, build_bank, draw_sample, raw_features
from gsencoder.types import FeatureMap, FeatureSpace

SPACE = FeatureSpace(name="numbers", channels=2)
GRID = np.array([[0.5, 0, 0], [0, 0.25, 0]])


def numbered_maps(*sizes: tuple[int, int], missing: float = 0.0) -> list[FeatureMap]:
    """Maps whose features are the number of the map and that of the cell."""
    maps, rng = [], np.random.default_rng(0)
    for number, (height, width) in enumerate(sizes):
        cells = np.arange(height * width).reshape(height, width)
        features = np.stack([np.full_like(cells, number), cells], axis=2).astype(np.float32)
        features[rng.random((height, width)) < missing] = np.nan
        maps.append(FeatureMap(features=features, grid_from_image=GRID * (number + 1), space=SPACE))
    return maps


def stream(maps: list[FeatureMap]) -> MapStream:
    def give() -> Iterator[tuple[int, FeatureMap]]:
        return iter(enumerate(maps))

    return give


@pytest.mark.parametrize("limit", [1, 59, 60, 61])
def test_a_sample_has_so_many_different_features_of_the_maps_in_their_order(limit: int) -> None:
    maps = numbered_maps((4, 5), (3, 10), (2, 5))
    sample = draw_sample(stream(maps), SPACE, limit)
    assert sample.total == 60
    assert len(sample.features) == min(limit, 60)
    keys = [(view, cell) for view, cell in sample.features.tolist()]
    assert keys == sorted(set(keys))
    assert set(keys) <= {(view, cell) for view, cells in enumerate((20, 30, 10)) for cell in range(cells)}


def test_cells_without_a_feature_are_in_no_sample_and_not_counted() -> None:
    maps = numbered_maps((20, 20), (20, 20), missing=0.5)
    sample = draw_sample(stream(maps), SPACE, 10_000)
    rows = np.concatenate([raw_features(view, each)[0] for view, each in enumerate(maps)])
    np.testing.assert_array_equal(sample.features, rows)
    assert sample.total == len(rows) < 500
    empty = draw_sample(stream(numbered_maps((3, 3), missing=1.1)), SPACE, 5)
    assert (empty.features.shape, empty.total) == ((0, 2), 0)


def test_every_feature_is_drawn_equally_often() -> None:
    """Views of any size and columns of any map: counts over seeds are those of independent draws."""
    maps = numbered_maps((2, 32), (1, 4), (4, 8))
    seeds, limit = 300, 25
    counts = {}
    for seed in range(seeds):
        for key in map(tuple, draw_sample(stream(maps), SPACE, limit, seed=seed).features.tolist()):
            counts[key] = counts.get(key, 0) + 1
    drawn = np.array([counts.get((view, cell), 0) for view, n in enumerate((64, 4, 32)) for cell in range(n)])
    share = limit / 100
    deviation = (drawn - seeds * share) / np.sqrt(seeds * share * (1 - share))
    assert np.abs(deviation).max() < 4.5
    assert np.square(deviation).mean() == pytest.approx(1, abs=0.5)


def test_a_view_is_sampled_whatever_cells_another_view_gives() -> None:
    sample = draw_sample(stream(numbered_maps((20, 20), (20, 20))), SPACE, 200)
    first, second = (set(sample.features[sample.features[:, 0] == view, 1].tolist()) for view in (0, 1))
    # A quarter of all cells is drawn, and a quarter of these in the other view as well.
    assert len(first & second) < 0.5 * min(len(first), len(second))


def test_a_seed_gives_the_same_sample_again_and_another_seed_another_one() -> None:
    maps = stream(numbered_maps((10, 10), (10, 10)))
    first, again, other = (draw_sample(maps, SPACE, 20, seed=seed).features for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


def test_the_cell_of_a_component_is_where_the_affine_of_its_map_puts_its_source() -> None:
    maps = numbered_maps((4, 5), (3, 10), (2, 5))
    bank = build_bank(stream(maps), SPACE, np.zeros(2, np.float32))
    assert len(bank) > 2
    assert len(set(bank.sources[:, 0].tolist())) > 1
    for (view, row, column), (left, top, right, bottom) in zip(bank.sources.tolist(), bank.cells, strict=True):
        affine = maps[view].grid_from_image
        corners = affine @ np.array([[left, right], [top, bottom], [1, 1]])
        np.testing.assert_allclose(corners, [[column, column + 1], [row, row + 1]], atol=1e-12)
