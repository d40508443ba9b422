"""A random sample of a scene's raw features, to look at: no more than it are held while the maps are read."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from gsencoder.core.errors import InputError
from gsencoder.memory.bank import MapStream, raw_features
from gsencoder.types import FeatureSpace


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

    Every feature gets a random number, and those with the smallest numbers are kept. Every n-th feature would come from
    the same few columns of maps whose width divides n.

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
            kept = np.sort(np.argsort(numbers, kind="stable")[:limit])
            features, numbers = features[kept], numbers[kept]
    return RawSample(features=features, total=total)
