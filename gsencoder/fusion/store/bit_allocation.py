"""Which bits a row of quantized features has: they go one at a time to the coordinate whose error they lower most."""

from copy import copy

import numpy as np
from jaxtyping import Float64, Int64

MAX_BITS = 8
"""Of a coordinate."""
ROUNDS = 10
"""Of moving levels to the mean of what is nearest to them."""
BINS = 1024


class BitAllocation:
    """How many bits each coordinate has, and its levels, on a sample."""

    def __init__(
        self,
        sample: Float64[np.ndarray, "n R"],
        row_weight: Float64[np.ndarray, " n"],
        rarity: Float64[np.ndarray, " n"],
    ) -> None:
        self._sample, self._heft, self._rarity = sample, row_weight, rarity
        count = sample.shape[1]
        self.bits = np.zeros(count, np.int64)
        self.levels = [np.zeros(1)] * count
        self._rounded = np.zeros_like(sample)
        self._now = row_weight @ sample**2
        self._next = [self._fit(number, 1) for number in range(count)]

    @property
    def energy_kept(self) -> float:
        """Share of the energy that lies in coordinates with bits."""
        energy = (self._sample**2).sum(axis=0)
        return float(energy[self.bits > 0].sum() / max(float(energy.sum()), 1e-300))

    def copy(self) -> "BitAllocation":
        """Another allocation that is the same now."""
        other = copy(self)
        other.bits, other.levels, other._rounded = self.bits.copy(), list(self.levels), self._rounded.copy()
        other._now, other._next = self._now.copy(), list(self._next)
        return other

    @property
    def can_grow(self) -> bool:
        """Whether some coordinate may have more bits."""
        return bool((self.bits < MAX_BITS).any())

    def errors(self) -> tuple[float, float]:
        """The mean of 1 − cosine over rows, and over kinds."""
        each = 1 - cosines_of(self._sample, self._rounded, (self._sample**2).sum(axis=1))
        return float(each.mean()), float(self._rarity @ each / self._rarity.sum())

    def add_bits(self, count: int) -> None:
        """Gives some more bits, each where it lowers the error most."""
        for _ in range(count):
            gains = [
                self._now[number] - self._next[number][0] if self.bits[number] < MAX_BITS else -1.0
                for number in range(len(self.bits))
            ]
            best = int(np.argmax(gains))
            if self.bits[best] == MAX_BITS:
                break
            self._now[best], self.levels[best] = self._next[best]
            self.bits[best] += 1
            self._rounded[:, best] = self.levels[best][nearest_level(self.levels[best], self._sample[:, best])]
            if self.bits[best] < MAX_BITS:
                self._next[best] = self._fit(best, int(self.bits[best]) + 1)

    def _fit(self, number: int, bits: int) -> tuple[float, Float64[np.ndarray, " L"]]:
        """The weighted error that is left, and the levels: each the mean of what is nearest to it."""
        values = self._sample[:, number]
        best: tuple[float, np.ndarray] = (np.inf, np.zeros(1))
        count = 1 << bits
        # What levels end as depends on where they begin. Many that share a smooth density lie as dense as its cube root
        # (Panter and Dite 1951); a few kinds of features are no density, and are found from an even spread.
        mass, edges = np.histogram(values, BINS, weights=self._heft)
        filled = np.concatenate(([0], np.cumsum(np.cbrt(mass))))
        dense = np.interp((np.arange(count) + 0.5) / count * filled[-1], filled, edges)
        spread = np.linspace(values.min(), values.max(), 2 * count + 1)[1::2]
        for levels in (dense, spread):
            for _ in range(ROUNDS):
                near = nearest_level(levels, values)
                weight = np.bincount(near, self._heft, count)
                total = np.bincount(near, self._heft * values, count)
                levels = np.sort(np.where(weight > 0, total / np.where(weight > 0, weight, 1), levels))
            left = float(self._heft @ (levels[nearest_level(levels, values)] - values) ** 2)
            if left < best[0]:
                best = (left, levels)
        return best


def nearest_level(levels: np.ndarray, values: np.ndarray) -> Int64[np.ndarray, " n"]:
    """Which of the ascending levels each value is nearest to."""
    return np.searchsorted((levels[1:] + levels[:-1]) / 2, values)


def cosines_of(
    values: Float64[np.ndarray, "n R"], rounded: Float64[np.ndarray, "n R"], squares: Float64[np.ndarray, " n"]
) -> Float64[np.ndarray, " n"]:
    """Of rows and what they were rounded to; `squares` are the rows' own, with coordinates that were left out."""
    norms = np.sqrt(squares) * np.sqrt((rounded**2).sum(axis=1))
    return np.asarray((values * rounded).sum(axis=1) / np.where(norms > 0, norms, 1))
