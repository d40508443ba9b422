"""Index memory: each Gaussian holds the number of a row in a small table of features, in one or two bytes.

The table is made from fused or encoded features, without training: a cover of their centered directions (see
`gsencoder.memory.reduction`), whose rows are then moved to the means of the Gaussians that are nearest to them.
LightSplat (CVPR 2026) and LangSplatV2 (2025) have per-scene codebooks that are learned; here a row costs what the scene
requires, and the cosine with what it stands for is measured.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64

from gsencoder.core.errors import InputError
from gsencoder.memory.reduction import BLOCK, CoverReduction, check_threshold, largest_threshold
from gsencoder.types import GaussianFeatures

MAX_ROWS = 65_535
"""Rows of a table whose numbers, with one for Gaussians that were never seen, fit into two bytes."""
MIN_RELATIVE_NORM = 1e-3
"""Share of the mean's norm below which a centered feature is rounding, not direction."""


@dataclass(frozen=True, slots=True, kw_only=True)
class IndexConfig:
    """How features become rows of a table."""

    threshold: float = field(
        default=0.9,
        metadata={"help": "centered cosine within which every Gaussian has a row when the table is made; 0 = by rows="},
    )
    rows: int = field(default=0, metadata={"help": "largest number of rows of the table, with threshold=0"})

    def __post_init__(self) -> None:
        if self.threshold and self.rows:
            raise InputError(
                f"rows: {self.rows} rows need threshold=0 as well, got {self.threshold}; beside a budget, which "
                "chooses both, leave both out"
            )
        if not self.threshold and not self.rows:
            raise InputError("threshold: 0 needs rows= as well")
        if self.threshold:
            check_threshold(self.threshold)
        elif not 2 <= self.rows <= MAX_ROWS:
            raise InputError(f"rows: expected 2 to {MAX_ROWS:,}, got {self.rows:,}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class IndexMemory:
    """Features that share the rows of a table.

    Attributes:
        features: with a table and an index.
        threshold: θ of the cover that the table was made from, a centered cosine.
        error: 1 − mean centered cosine with the features that it was made from; features at the space's mean, which
            have no direction, do not count.
        lowest: the centered cosine that one Gaussian in a thousand is below.
    """

    features: GaussianFeatures
    threshold: float
    error: float
    lowest: float


class TooManyRowsError(InputError):
    """A table would have more rows than it may."""


def index_features(
    features: GaussianFeatures, config: IndexConfig = IndexConfig(), *, most: int | None = None
) -> IndexMemory:
    """Makes a table of rows that features share.

    Args:
        features: fused or encoded.
        config: how many rows.
        most: a table of more rows is given up; None = one of more than two bytes can number.

    Raises:
        TooManyRowsError: the table would have more rows than `most`.
        InputError: no features, or more rows than two bytes can number.
    """
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
        features=GaussianFeatures(
            features=table + offset,
            weights=features.weights,
            mean=features.mean,
            space=features.space,
            basis=features.basis,
            index=index,
        ),
        threshold=threshold,
        error=max(1 - float(cosines.mean()), 0.0) if len(cosines) else 0.0,
        lowest=float(np.quantile(cosines, 0.001)) if len(cosines) else 1.0,
    )


def _leaders(
    centered: Float32[np.ndarray, "n C"], config: IndexConfig, limit: int, *, search: bool
) -> tuple[float, Int64[np.ndarray, " M"]]:
    """The threshold of a cover, and its rows, at most so many; with `search` an error says which threshold has them.

    Raises:
        InputError: more rows than the numbers of an index.
    """

    def cover(threshold: float, limit: int) -> CoverReduction:
        reduction = CoverReduction(centered.shape[1], threshold)
        reduction.add(centered, "features", limit=limit)
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
            raise TooManyRowsError(f"index: a table of threshold {threshold:g} has more than {limit:,} rows")
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
    lengths = np.linalg.norm(table.astype(np.float64), axis=1)
    cosines = np.empty(len(centered))
    for start in range(0, len(centered), BLOCK):
        part, rows = centered[start : start + BLOCK].astype(np.float64), number[start : start + BLOCK]
        products = np.einsum("nc,nc->n", part, table[rows])
        norms = np.sqrt(np.einsum("nc,nc->n", part, part)) * lengths[rows]
        cosines[start : start + BLOCK] = products / np.where(norms > 0, norms, 1)
    return cosines
