"""The raw features of a scene, as its maps hold them, and a random sample of them to look at."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int32

from gsencoder.core.errors import InputError
from gsencoder.types import FeatureMap, FeatureSpace

MapStream = Callable[[], Iterator[tuple[int, FeatureMap]]]
"""Gives the maps of a scene with the numbers of their views, any number of times."""


def raw_features(view: int, feature_map: FeatureMap) -> tuple[Float32[np.ndarray, "n D"], Int32[np.ndarray, "n 3"]]:
    """The features of a map, and the view, row and column of their cells: of every cell that has a feature; of a coded
    map each vector that occurs, once, in the first cell that has it."""
    if feature_map.codes is not None:
        assert feature_map.table is not None
        codes, cells = np.unique(feature_map.codes.ravel(), return_index=True)
        rows, cells = feature_map.table[codes[codes >= 0]], cells[codes >= 0]
    else:
        rows = feature_map.rows()
        cells = np.flatnonzero(~np.isnan(rows[:, 0]))
        rows = rows[cells]
    line, column = np.divmod(cells, feature_map.width)
    return rows, np.stack([np.full(len(cells), view), line, column], axis=1).astype(np.int32)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RawSample:
    """Raw features of one teacher in one scene.

    Attributes:
        features: the sample, in the order of the maps.
        total: number of raw features that it was drawn from.
    """

    features: Float32[np.ndarray, "n D"]
    total: int


def draw_sample(maps: MapStream, space: FeatureSpace, limit: int, *, seed: int = 0) -> RawSample:
    """Draws raw features without replacement, each with the same probability.

    Every feature gets a random number, and those with the smallest numbers are the sample. Every n-th feature would
    come from the same few columns of maps whose width divides n.

    Args:
        maps: of the scene; read once.
        space: of the maps.
        limit: largest number of features.
        seed: of the random numbers.

    Raises:
        InputError: a limit below 1.
    """
    if limit < 1:
        raise InputError(f"limit: expected 1 or more, got {limit}")
    features = np.zeros((0, space.channels), np.float32)
    numbers, total = np.zeros(0), 0
    for view, feature_map in maps():
        rows, _ = raw_features(view, feature_map)
        drawn = np.random.default_rng([seed, view]).random(len(rows))
        total += len(rows)
        if len(numbers) == limit:
            # Most views give few features or none, and the sample is not copied for these.
            better = drawn < numbers.max()
            rows, drawn = rows[better], drawn[better]
        if not len(rows):
            continue
        features, numbers = np.concatenate([features, rows]), np.concatenate([numbers, drawn])
        if len(numbers) > limit:
            smallest = np.sort(np.argsort(numbers, kind="stable")[:limit])
            features, numbers = features[smallest], numbers[smallest]
    return RawSample(features=features, total=total)
