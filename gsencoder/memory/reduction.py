"""Reducing raw features to principal scene components: M3's similarity reduction (Algorithm 1), and a cover.

Both take rows of any length and compare directions: the cosine of two rows is the product of their unit vectors.
Products are made block by block, so that memory is that of the features, the components and a block.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float32, Int64

from gsencoder.core.errors import InputError

ROUNDING = 2e-6
"""What a cosine of float32 products may be off."""
BLOCK = 1024
"""Rows that are compared at once."""
PRODUCT_VALUES = 1 << 25
"""Cosines that are kept at once, 128 MiB."""
THRESHOLD_STEPS = 12
"""Halvings of the interval in which a threshold is searched: to 1/4,096 of a cosine."""
WITNESSES = 4096
"""Rows in use that a row is compared with before it is compared with all."""


def unit_rows(rows: Float32[np.ndarray, "n D"]) -> Float32[np.ndarray, "n D"]:
    """Rows of unit length, without overflow or underflow of their squares."""
    largest = np.abs(rows).max(axis=1, initial=0.0, keepdims=True)
    bad = ~np.isfinite(largest[:, 0]) | (largest[:, 0] == 0)
    if bad.any():
        row = int(np.flatnonzero(bad)[0])
        fault = "zero" if largest[row, 0] == 0 else "not finite"
        raise InputError(f"features: {int(bad.sum()):,} of {len(rows):,} rows have no direction: row {row} is {fault}")
    scaled = rows / largest
    return np.asarray(scaled / np.sqrt(np.einsum("nd,nd->n", scaled, scaled))[:, None], np.float32)


def reduce_algorithm1(
    unit: Float32[np.ndarray, "n D"], threshold: float, *, drop_last: int = 0
) -> tuple[Int64[np.ndarray, " M"], Bool[np.ndarray, " n"]]:
    """M3's Algorithm 1: a row becomes a component if no row within the threshold of it is in use; then all rows within
    the threshold of it are in use.

    A row near one in use is skipped even where no component is within the threshold of it, so the components need not
    represent every row. The printed algorithm computes the cosines of each row with all others. Here most rows are
    settled before that: those in use are skipped, and for others a row in use that is near (a witness) is searched
    among neighbors in order and in a sample. Only rows without one are compared with all.

    Args:
        unit: directions of the raw features of all views, in order; they may be those of a file that is mapped into
            memory.
        drop_last: a chunk size c: the last n mod c rows become no components, as the printed loop has it; 0 = they may.

    Returns:
        The components, ascending; and which rows are in use.
    """
    count = len(unit)
    candidates = count - count % drop_last if drop_last else count
    used = np.zeros(count, bool)
    rows: list[int] = []
    rng = np.random.default_rng(0)
    start, size = 0, 64
    while start < candidates:
        stop = min(start + size, candidates)
        block = start + np.flatnonzero(~used[start:stop])
        block = _without_witness(unit, block, used, threshold, rng)
        step = max(1, PRODUCT_VALUES // count)
        for first in range(0, len(block), step):
            part = block[first : first + step]
            part = part[~used[part]]
            near = unit[part] @ unit.T >= threshold
            for row, neighbors in zip(part.tolist(), near, strict=True):
                if not used[row] and not (neighbors & used).any():
                    rows.append(row)
                    used |= neighbors
                    used[row] = True
        start, size = stop, min(2 * size, BLOCK)
    return np.array(rows, np.int64), used


def _without_witness(
    unit: Float32[np.ndarray, "n D"],
    block: Int64[np.ndarray, " k"],
    used: Bool[np.ndarray, " n"],
    threshold: float,
    rng: np.random.Generator,
) -> Int64[np.ndarray, " remaining"]:
    """The rows of a block for which no near row in use is known yet."""
    if not len(block):
        return block
    around = slice(max(0, int(block[0]) - BLOCK), int(block[-1]) + BLOCK)
    neighbors = around.start + np.flatnonzero(used[around])
    sample = np.flatnonzero(used)
    if len(sample) > WITNESSES:
        sample = sample[rng.integers(0, len(sample), WITNESSES)]
    for witnesses in (neighbors, sample):
        if len(witnesses) and len(block):
            block = block[~(unit[block] @ unit[witnesses].T >= threshold).any(axis=1)]
    return block


class CoverReduction:
    """Components of which one is within the threshold of every row: each row in order that none is near becomes one.

    Rows may come in any number of parts, such as views; nothing but the components is kept of them. Components are the
    same however the rows are divided.
    """

    def __init__(self, channels: int, threshold: float) -> None:
        # Rounding of float32 products depends on their block. The smallest cosine that counts is a little above the
        # threshold, so that a row that counts is within the threshold in exact arithmetic, and a little below 1, so
        # that equal rows are one component.
        self._least = min(threshold + ROUNDING, 1 - ROUNDING)
        self._unit, self._raw = np.zeros((2, 64, channels), np.float32)
        self._rows: list[int] = []
        self._seen = 0

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def rows(self) -> Int64[np.ndarray, " M"]:
        """Which of the rows so far are components, ascending."""
        return np.array(self._rows, np.int64)

    @property
    def components(self) -> Float32[np.ndarray, "M D"]:
        """The components as they were given."""
        return self._raw[: len(self)]

    @property
    def unit(self) -> Float32[np.ndarray, "M D"]:
        """The directions of the components."""
        return self._unit[: len(self)]

    def add(self, features: Float32[np.ndarray, "n D"], *, limit: int | None = None) -> None:
        """Takes more rows, but none once there are more components than a limit, which is for the caller to see."""
        for start in range(0, len(features), BLOCK):
            if limit is not None and len(self) > limit:
                return
            raw = features[start : start + BLOCK]
            unit = unit_rows(raw)
            far = self._far_from_components(unit, np.arange(len(unit)))
            leaders = self._leaders(unit, far)
            self._append(unit[leaders], raw[leaders])
            self._rows.extend((self._seen + leaders).tolist())
            self._seen += len(unit)

    def _far_from_components(
        self, unit: Float32[np.ndarray, "n D"], rows: Int64[np.ndarray, " k"]
    ) -> Int64[np.ndarray, " remaining"]:
        """The rows that no component is near. Most are near one of a few components, so that few meet all of them."""
        start, size = 0, 256
        while start < len(self) and len(rows):
            near = unit[rows] @ self.unit[start : start + size].T >= self._least
            rows = rows[~near.any(axis=1)]
            start, size = start + size, 2 * size
        return rows

    def _leaders(self, unit: Float32[np.ndarray, "n D"], rows: Int64[np.ndarray, " k"]) -> Int64[np.ndarray, " c"]:
        """Of rows that no component is near, those that become components."""
        near = unit[rows] @ unit[rows].T >= self._least
        uncovered = np.ones(len(rows), bool)
        leaders = []
        for index, row in enumerate(rows.tolist()):
            if uncovered[index]:
                uncovered &= ~near[index]
                leaders.append(row)
        return np.array(leaders, np.int64)

    def _append(self, unit: Float32[np.ndarray, "c D"], raw: Float32[np.ndarray, "c D"]) -> None:
        first, last = len(self), len(self) + len(unit)
        while last > len(self._unit):
            self._unit = np.concatenate([self._unit, np.zeros_like(self._unit)])
            self._raw = np.concatenate([self._raw, np.zeros_like(self._raw)])
        self._unit[first:last], self._raw[first:last] = unit, raw


def largest_threshold(fits: Callable[[float], bool]) -> float:
    """The largest threshold at which a cover fits, to 1/4,096; the smallest one even if it does not fit.

    Args:
        fits: whether the cover of a threshold has few enough components; covers of larger thresholds have more.
    """
    low, high = 0.0, 1.0
    for _ in range(THRESHOLD_STEPS):
        middle = (low + high) / 2
        low, high = (middle, high) if fits(middle) else (low, middle)
    return low or high
