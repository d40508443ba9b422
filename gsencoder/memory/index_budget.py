"""Tables of rows within a budget: the threshold is chosen on a sample of Gaussians, and moved until all keep it."""

from collections.abc import Callable
from dataclasses import replace

from gsencoder.core.errors import InputError
from gsencoder.core.even_indices import even_indices
from gsencoder.core.promises import MEGABYTE
from gsencoder.fusion.store.budget import PackBudget
from gsencoder.memory.index import MAX_ROWS, IndexConfig, IndexMemory, TooManyRowsError, index_features
from gsencoder.types import GaussianFeatures

THRESHOLDS = tuple(1 - 0.8 * 2 ** (-step / 4) for step in range(48))
"""From 0.2 to within 0.0003 of 1; from each to the next a sixth of what is left of 1 goes."""
SAMPLE = 4096
"""Gaussians on which a threshold is chosen."""


def index_within(features: GaussianFeatures, budget: PackBudget, bytes_of: Callable[[int], int]) -> IndexMemory:
    """The smallest table that keeps a budget of error; without one, the largest whose file keeps one of megabytes.

    Thresholds come from a fixed list. What a sample says of one is too good: its table has fewer rows than that of all
    Gaussians, and is nearer to them. All Gaussians then decide, from there on towards what is safe.

    Args:
        features: fused or encoded.
        budget: at least one promise.
        bytes_of: of a package with so many rows.

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
    return _largest(features, sample, budget.megabytes, bytes_of)


def _smallest(features: GaussianFeatures, sample: GaussianFeatures, error: float) -> IndexMemory:
    first = 0
    while first < len(THRESHOLDS) - 1 and _indexed(sample, first).error > error:
        first += 1
    reached: IndexMemory | None = None
    for number in range(first, len(THRESHOLDS)):
        try:
            made = _indexed(features, number, MAX_ROWS)
        except TooManyRowsError:
            break
        if made.error <= error:
            return made
        reached = made
    least = "does not reach it" if reached is None else f"reaches {reached.error:.2g}"
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
        f"budget.megabytes={megabytes:g}: the smallest table of these features takes {needed / MEGABYTE + 5e-6:.5f}; "
        "give more"
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
