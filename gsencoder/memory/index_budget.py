"""Tables of rows within a budget: the threshold is chosen on a sample of Gaussians, and moved until all keep it."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Float64, Int64

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError
from gsencoder.core.settings import MEGABYTE
from gsencoder.fusion.feature_error import row_cosines
from gsencoder.fusion.store.budget import PackBudget
from gsencoder.fusion.store.quantize import FIT_SAMPLE, rarity_of
from gsencoder.memory.index import MAX_ROWS, IndexConfig, IndexMemory, TooManyRowsError, index_features
from gsencoder.types import GaussianFeatures

THRESHOLDS = tuple(1 - 0.8 * 2 ** (-step / 4) for step in range(48))
"""From 0.2 to within 0.0003 of 1; from each to the next a sixth of what is left of 1 goes."""
SAMPLE = 16_384
"""Gaussians on which a threshold is chosen."""


def index_within(
    features: GaussianFeatures, budget: PackBudget, bytes_of: Callable[[int], int]
) -> tuple[IndexMemory, float]:
    """The smallest table that keeps a budget of error; without one, the largest whose file keeps one of megabytes.

    Thresholds come from a fixed list. What a sample says of one is too good: its table has fewer rows than that of all
    Gaussians, and is nearer to them. All Gaussians then decide, from there on towards what is safe.

    Args:
        features: fused or encoded.
        budget: at least one promise.
        bytes_of: of a package with so many rows.

    Returns:
        The table, and its error: 1 − mean centered cosine over Gaussians, or over their kinds where that is larger.

    Raises:
        InputError: no features, or no table keeps the budget; the message says how near one comes.
    """
    seen = features.seen.nonzero()[0]
    if not len(seen):
        raise InputError("index: no Gaussian has features")
    chosen = seen[even_indices(len(seen), SAMPLE)]
    sample = replace(
        features,
        features=features.stored(chosen),
        weights=features.weights[chosen],
        index=None,
    )
    if budget.error is not None:
        return _smallest(features, sample, budget.error)
    assert budget.megabytes is not None
    indexed = _largest(features, sample, budget.megabytes, bytes_of)
    return indexed, _KindsError(features)(indexed)


class _KindsError:
    """The error of tables over Gaussians or over kinds of features, whichever is larger."""

    def __init__(self, features: GaussianFeatures) -> None:
        seen = features.seen.nonzero()[0]
        rows = seen[even_indices(len(seen), FIT_SAMPLE)]
        self._centered = self._about_mean(features, rows)
        norms = np.linalg.norm(self._centered, axis=1)
        self._rows, self._centered = rows[norms > 0], self._centered[norms > 0]
        self._rarity = rarity_of(self._centered, norms[norms > 0])

    def __call__(self, indexed: IndexMemory) -> float:
        if not len(self._rows):
            return indexed.error
        each = 1 - row_cosines(self._centered, self._about_mean(indexed.features, self._rows))
        return max(indexed.error, float(self._rarity @ each / self._rarity.sum()), 0.0)

    @staticmethod
    def _about_mean(features: GaussianFeatures, rows: Int64[np.ndarray, " n"]) -> Float64[np.ndarray, "n R"]:
        values = features.stored(rows).astype(np.float64)
        return values if features.basis is not None else values - features.mean


def _smallest(features: GaussianFeatures, sample: GaussianFeatures, error: float) -> tuple[IndexMemory, float]:
    of_sample, of_all = _KindsError(sample), _KindsError(features)
    first = 0
    while first < len(THRESHOLDS) - 1 and of_sample(_indexed(sample, first)) > error:
        first += 1
    reached: float | None = None
    for number in range(first, len(THRESHOLDS)):
        try:
            indexed = _indexed(features, number, MAX_ROWS)
        except TooManyRowsError:
            break
        reached = of_all(indexed)
        if reached <= error:
            return indexed, reached
    least = "does not reach it" if reached is None else f"reaches {reached:.2g}"
    raise InputError(
        f"budget.error={error:g}: a table of up to {MAX_ROWS:,} rows {least}; give a larger budget, or form=compact"
    )


def _largest(
    features: GaussianFeatures, sample: GaussianFeatures, megabytes: float, bytes_of: Callable[[int], int]
) -> IndexMemory:
    largest = megabytes * MEGABYTE
    rows = _rows_within(largest, bytes_of)
    first = 0
    while first < len(THRESHOLDS) - 1 and rows and len(_indexed(sample, first + 1).features.features) <= rows:
        first += 1
    for number in range(first if rows else -1, -1, -1):
        try:
            return _indexed(features, number, rows)
        except TooManyRowsError:
            continue
    needed = bytes_of(len(_indexed(features, 0).features.features))
    raise InputError(
        f"budget.megabytes={megabytes:g}: the smallest table of these features takes {needed / MEGABYTE + 5e-6:.5f} MB"
        "; give more"
    )


def _rows_within(largest: float, bytes_of: Callable[[int], int]) -> int:
    """The largest number of rows whose file has at most so many bytes; 0 where there is none."""
    low, high = 0, MAX_ROWS
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if bytes_of(middle) <= largest else (low, middle - 1)
    return low


def _indexed(features: GaussianFeatures, number: int, most: int | None = None) -> IndexMemory:
    return index_features(features, IndexConfig(threshold=THRESHOLDS[number]), most=most)
