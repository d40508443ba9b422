"""Index memory: each Gaussian holds the number of a row in a small table of features, in one or two bytes.

The table is made from fused or encoded features, without training: a cover of their centered directions (see
`gsencoder.memory.reduction`), whose rows are then moved to the means of the Gaussians that are nearest to them.
LightSplat (CVPR 2026) and LangSplatV2 (2025) learn a codebook for each scene.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64

from gsencoder.core.arrays import even_indices
from gsencoder.core.budget import MEGABYTE, Estimate, choose
from gsencoder.core.errors import InputError
from gsencoder.core.settings import check_limits, option
from gsencoder.fusion.basis import row_cosines
from gsencoder.fusion.package import PackBudget
from gsencoder.fusion.quantize import FIT_SAMPLE, rarity_of
from gsencoder.memory.reduction import BLOCK, CoverReduction, largest_threshold
from gsencoder.types import GaussianFeatures

MAX_ROWS = 65_535
"""Rows of a table whose numbers, with one for Gaussians that were never seen, fit into two bytes."""
MIN_RELATIVE_NORM = 1e-3
"""Share of the mean's norm below which a centered feature is rounding, not direction."""


@dataclass(frozen=True, slots=True, kw_only=True)
class IndexConfig:
    """How features become rows of a table."""

    threshold: float = option(
        0.9,
        "centered cosine within which every Gaussian has a row when the table is made; 0 = by rows=",
        ge=0,
        le=1,
    )
    rows: int = option(0, "largest number of rows of the table, with threshold=0", ge=0, le=MAX_ROWS)

    def __post_init__(self) -> None:
        check_limits(self)
        if self.threshold and self.rows:
            raise InputError(
                f"rows: {self.rows} rows need threshold=0 as well, got {self.threshold}; with a budget, which "
                "chooses both, leave both out"
            )
        if not self.threshold and self.rows < 2:
            raise InputError(f"threshold: 0 needs rows=2 or more as well, got {self.rows}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class IndexMemory:
    """Features that share the rows of a table.

    Attributes:
        threshold: θ of the cover that the table was made from, a centered cosine.
        error: 1 − mean centered cosine with the features that it was made from; features at the space's mean, which
            have no direction, do not count.
        lowest: the centered cosine that one Gaussian in a thousand is below.
    """

    features: GaussianFeatures
    threshold: float
    error: float
    lowest: float


class RowLimitError(InputError):
    """A table would have more rows than it may."""


def index_features(
    features: GaussianFeatures, config: IndexConfig = IndexConfig(), *, most: int | None = None
) -> IndexMemory:
    """Makes a table of rows that features share, at most `most`, or as many as two bytes can number."""
    seen = np.flatnonzero(features.seen)
    if not len(seen):
        raise InputError("index: no Gaussian has features")
    values = features.stored(seen)
    offset = features.mean if features.basis is None else np.zeros_like(values[0])
    centered = values - offset
    norms = np.sqrt(np.einsum("nc,nc->n", centered, centered, dtype=np.float64))
    directed = np.flatnonzero(norms > MIN_RELATIVE_NORM * np.linalg.norm(features.mean.astype(np.float64)))
    # One row is for features without a direction, if there are any.
    limit = (config.rows or most or MAX_ROWS) - (len(directed) < len(seen))
    threshold, leaders = _leaders(centered[directed], config, limit, search=most is None)
    table = np.concatenate([centered[directed[leaders]], np.zeros_like(centered[:1])])
    # Features without a direction have the last row, the mean of the space; it goes where there are none.
    number = np.full(len(seen), len(table) - 1, np.int32)
    number[directed] = _nearest(centered[directed], table[:-1])
    table[:-1] = _means(centered[directed], number[directed], table[:-1])
    number[directed] = _nearest(centered[directed], table[:-1])
    used, row = np.unique(number, return_inverse=True)
    table = table[used]
    cosines = _cosines(centered[directed], table, row[directed])
    index = np.full(len(features), -1, np.int32)
    index[seen] = row
    return IndexMemory(
        features=replace(features, features=table + offset, index=index),
        threshold=threshold,
        error=max(1 - float(cosines.mean()), 0.0) if len(cosines) else 0.0,
        lowest=float(np.quantile(cosines, 0.001)) if len(cosines) else 1.0,
    )


def _leaders(
    centered: Float32[np.ndarray, "n C"], config: IndexConfig, limit: int, *, search: bool
) -> tuple[float, Int64[np.ndarray, " M"]]:
    """The threshold of a cover, and its rows, at most `limit`; with `search` an error says which threshold has them."""

    def cover(threshold: float, limit: int) -> CoverReduction:
        reduction = CoverReduction(centered.shape[1], threshold)
        reduction.add(centered, limit=limit)
        return reduction

    threshold = config.threshold or largest_threshold(lambda each: len(cover(each, limit)) <= limit)
    leaders = cover(threshold, limit)
    if len(leaders) > limit and config.rows:
        raise InputError(
            f"index: rows={config.rows}: the features point in more directions than that even at a threshold of "
            f"{threshold:.4f}; give more rows"
        )
    if len(leaders) > limit:
        if not search:
            raise RowLimitError(f"index: a table of threshold {threshold:g} has more than {limit:,} rows")
        fits = largest_threshold(lambda each: len(cover(each, limit)) <= limit)
        raise InputError(
            f"index: a table with a row within {threshold:g} of every feature has more than {limit:,} rows; give "
            f"threshold={fits:.3g}, or rows="
        )
    return threshold, leaders.rows


def _nearest(centered: Float32[np.ndarray, "n C"], table: Float32[np.ndarray, "M C"]) -> Int32[np.ndarray, " n"]:
    """The row of the table that each feature is nearest to, in Euclidean distance."""
    half_squares = np.einsum("mc,mc->m", table, table) / 2
    parts = [
        (centered[start : start + BLOCK] @ table.T - half_squares).argmax(axis=1)
        for start in range(0, len(centered), BLOCK)
    ]
    return np.concatenate([np.zeros(0, np.int64), *parts]).astype(np.int32)


def _means(
    centered: Float32[np.ndarray, "n C"], number: Int32[np.ndarray, " n"], table: Float32[np.ndarray, "M C"]
) -> Float32[np.ndarray, "M C"]:
    """The mean of the features of each row; the row itself where it has none."""
    counts = np.bincount(number, minlength=len(table))
    order = np.argsort(number, kind="stable")
    has_features = counts > 0
    means = table.copy()
    if len(order):
        first = np.concatenate(([0], np.cumsum(counts)[:-1]))[has_features]
        sums = np.add.reduceat(centered[order], first, axis=0, dtype=np.float64)
        means[has_features] = sums / counts[has_features, None]
    return means


def _cosines(
    centered: Float32[np.ndarray, "n C"], table: Float32[np.ndarray, "M C"], number: Int64[np.ndarray, " n"]
) -> Float64[np.ndarray, " n"]:
    """The cosine of each feature with its row."""
    parts = [slice(start, start + BLOCK) for start in range(0, len(centered), BLOCK)]
    blocks = [row_cosines(centered[part].astype(np.float64), table[number[part]].astype(np.float64)) for part in parts]
    return np.concatenate([np.zeros(0), *blocks])


THRESHOLDS = tuple(1 - 0.8 * 2 ** (-step / 4) for step in range(48))
"""From 0.2 to within 0.0003 of 1; from each to the next a sixth of what is left of 1 goes."""
SAMPLE = 16_384
"""Gaussians on which a threshold is chosen."""


def index_within(
    features: GaussianFeatures, budget: PackBudget, bytes_of: Callable[[int], int]
) -> tuple[IndexMemory, float]:
    """The smallest table that keeps a limit of error; without one, the largest whose file keeps one of megabytes.

    Thresholds come from a fixed list. What a sample says of one is too good: its table has fewer rows than that of all
    Gaussians, and is nearer to them. All Gaussians then decide, from there on towards what is safe.

    Args:
        bytes_of: of a package with a table of this many rows.

    Returns:
        The table, and its error: 1 − mean centered cosine over Gaussians, or over their kinds where that is larger.
    """
    seen = features.seen.nonzero()[0]
    if not len(seen):
        raise InputError("index: no Gaussian has features")
    rows = seen[even_indices(len(seen), SAMPLE)]
    stored, weights = features.stored(rows), features.weights[rows]
    sample = replace(features, features=stored, weights=weights, index=None, confidence=None)
    error_of_sample, error_of_all = _KindsError(sample), _KindsError(features)

    def megabytes(indexed: IndexMemory) -> float:
        return bytes_of(len(indexed.features.features)) / MEGABYTE

    def measure(number: int) -> Estimate:
        indexed = _indexed(sample, number)
        error = error_of_sample(indexed)
        return Estimate(error=error, bound=error, megabytes=megabytes(indexed))

    numbers = range(len(THRESHOLDS))
    first = choose(numbers, measure, budget).setting
    reached, size = "does not reach it", math.nan
    for number in numbers[first:] if budget.error is not None else numbers[first::-1]:
        try:
            indexed = _indexed(features, number, MAX_ROWS)
        except RowLimitError:
            if budget.error is not None:
                break
            continue
        error, size = error_of_all(indexed), megabytes(indexed)
        if error <= budget.error if budget.error is not None else size <= budget.limit("megabytes"):
            return indexed, error
        reached = f"reaches {error:.2g}"
    if budget.error is None:
        raise budget.too_small(size)
    raise InputError(
        f"{budget.option('error')}: a table of up to {MAX_ROWS:,} rows {reached}; give a larger budget, or form=compact"
    )


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


def _indexed(features: GaussianFeatures, number: int, most: int | None = None) -> IndexMemory:
    return index_features(features, IndexConfig(threshold=THRESHOLDS[number]), most=most)
