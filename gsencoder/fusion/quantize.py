"""Quantized features: the fewest bytes a Gaussian that an error budget allows.

Coordinates are turned so that the first hold most, each is replaced by the nearest of 2ᵇ levels (Lloyd 1982, Max 1960),
and bits go one at a time to the coordinate whose error they lower most. A name or a patch lives near few directions, so
that most coordinates need one or two bits, or none.

Kinds of features count alike, however many Gaussians they have: what is asked for is a mug more often than a ceiling,
and a mean over Gaussians is all ceiling.
"""

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8

from gsencoder.core.arrays import even_indices, is_strictly_increasing
from gsencoder.core.budget import MEGABYTE, Budget
from gsencoder.core.errors import InputError
from gsencoder.types import FeatureBasis, FeatureSpace, GaussianFeatures

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


FIT_SAMPLE = 10_000
"""Gaussians that levels are fitted to."""
SAME_KIND_COSINE = 0.9
"""Rows whose centered cosine is above are of one kind."""
RETRIES = 3
"""Times that a sample is completed by rows that it missed."""
STEP_BITS = 8
"""Bits that are added at a time: a byte a row."""
EXACT_ERROR = 1e-4
"""Codes are not made more exact than this, however large they may be."""
BLOCK = 16_384
"""Rows that are turned into bits, or back, at a time."""
MIN_COSINE = 0.8
"""A row whose cosine falls below is of a kind that the sample missed; generous budgets take a lower bound."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CompactFeatures:
    """Features as codes.

    Attributes:
        codes: of the seen rows, each row's bits one coordinate after the other, the first in the highest bit.
        levels: what the codes of each coordinate stand for, 2ᵇ values each.
        weight_codes: of the seen rows; 0 = `lightest`, 255 = `heaviest`, and each step between is the same factor.
        rows: which Gaussians were seen, ascending, of `total`.
        error: 1 − mean centered cosine to what was compacted: over the seen rows, or over their kinds (a sample where
            each row counts by how few are like it), whichever is larger. Features at the space's mean have no cosine.
        lowest: the centered cosine that one row in a thousand is below.
    """

    codes: UInt8[np.ndarray, "n row_bytes"]
    bits: UInt8[np.ndarray, " R"]
    levels: Float32[np.ndarray, " L"]
    weight_codes: UInt8[np.ndarray, " n"]
    lightest: float
    heaviest: float
    rows: Int64[np.ndarray, " n"]
    total: int
    basis: FeatureBasis
    error: float
    lowest: float

    def __post_init__(self) -> None:
        """Refuses codes that no `compact` makes."""
        counts, rows = self.bits.astype(np.int64), len(self.rows)
        tiny, largest = np.finfo(np.float32).tiny, np.finfo(np.float32).max
        whole = (
            len(counts) == self.basis.rank > 0
            and 1 <= counts.min() <= counts.max() <= MAX_BITS
            and self.codes.shape == (rows, -(-int(counts.sum()) // 8))
            and len(self.levels) == int((1 << counts).sum())
            and len(self.weight_codes) == rows > 0
            and is_strictly_increasing(self.rows, self.total)
            and tiny <= self.lightest <= self.heaviest <= largest
            and 0 <= self.error <= 2
        )
        if not whole:
            raise InputError("compact features: bits, levels, codes, weights and rows do not go together")

    def __len__(self) -> int:
        return self.total

    def coordinates(self, positions: np.ndarray | slice = slice(None)) -> Float32[np.ndarray, "k R"]:
        """Coordinates in the basis of seen rows, by their place among these."""
        codes = self.codes[positions]
        bits = self.bits.astype(np.int64)
        begins = np.concatenate(([0], np.cumsum(bits)))
        offsets = np.concatenate(([0], np.cumsum(1 << bits)))
        compacted = np.empty((len(codes), len(bits)), np.float32)
        for start in range(0, len(codes), BLOCK):
            ones = np.unpackbits(codes[start : start + BLOCK], axis=1)
            for number, width in enumerate(bits):
                part = ones[:, begins[number] : begins[number + 1]]
                code = part @ (1 << np.arange(width - 1, -1, -1))
                compacted[start : start + BLOCK, number] = self.levels[offsets[number] + code]
        return compacted

    def features(self) -> GaussianFeatures:
        values = np.zeros((self.total, self.basis.rank), np.float32)
        weights = np.zeros(self.total, np.float32)
        values[self.rows] = self.coordinates()
        share = self.weight_codes / 255
        weights[self.rows] = np.exp((1 - share) * np.log(self.lightest) + share * np.log(self.heaviest))
        return GaussianFeatures(
            features=values, weights=weights, mean=self.basis.mean, space=self.space, basis=self.basis
        )

    @property
    def space(self) -> FeatureSpace:
        return self.basis.space

    @property
    def row_bytes(self) -> int:
        """Bytes of a row's codes."""
        return int(self.codes.shape[1])


def compact(features: GaussianFeatures, *, error: float = 0.01) -> CompactFeatures:
    """The fewest bytes a row whose features come within a budget of `CompactFeatures.error`."""
    if not 0 < error < 1:
        raise InputError(f"error: expected a budget between 0 and 1, got {error}")

    def fewest(allocation: BitAllocation, encode: _Encode) -> tuple[CompactFeatures, Float64[np.ndarray, " n"]]:
        while True:
            allocation.add_bits(STEP_BITS)
            if max(allocation.errors()) > error and allocation.can_grow:
                continue
            compacted, cosines = encode(allocation)
            if compacted.error <= error:
                return compacted, cosines
            if not allocation.can_grow:
                raise InputError(
                    f"an error of {error:.3g}: {MAX_BITS} bits a coordinate reach {compacted.error:.2g}; allow a "
                    "larger one, or take another form"
                )

    return _completed(features, fewest)


def compact_within(
    features: GaussianFeatures, budget: Budget, bytes_of: Callable[[Int64[np.ndarray, " R"]], int]
) -> CompactFeatures:
    """The most exact codes that keep a limit of megabytes; no more exact than `EXACT_ERROR`. `bytes_of` is what a
    package takes, given the bits of each of its coordinates."""

    def most_exact(allocation: BitAllocation, encode: _Encode) -> tuple[CompactFeatures, Float64[np.ndarray, " n"]]:
        while not allocation.bits.any() or (allocation.can_grow and max(allocation.errors()) > EXACT_ERROR):
            more = allocation.copy()
            more.add_bits(STEP_BITS)
            if (size := bytes_of(more.bits[more.bits > 0]) / MEGABYTE) > budget.limit("megabytes"):
                if not allocation.bits.any():
                    raise budget.too_small(size)
                break
            allocation = more
        return encode(allocation)

    return _completed(features, most_exact)


_Encode = Callable[[BitAllocation], tuple[CompactFeatures, Float64[np.ndarray, " n"]]]
"""All rows with an allocation of bits, and what it leaves of the cosine of each."""


def _completed(
    features: GaussianFeatures,
    choose: Callable[[BitAllocation, _Encode], tuple[CompactFeatures, Float64[np.ndarray, " n"]]],
) -> CompactFeatures:
    """Features with the bits that are chosen on a sample, which is completed by kinds of rows that it missed."""
    rows = np.flatnonzero(features.seen)
    if not len(rows):
        raise InputError("compact: no Gaussian has features")
    sample = rows[even_indices(len(rows), FIT_SAMPLE)]
    for _ in range(RETRIES):
        allocation, rotated = _allocation(features, sample)
        compacted, cosines = choose(allocation, partial(_encode, features, rows, rotated))
        missed = np.setdiff1d(rows[cosines < min(MIN_COSINE, 1 - 10 * compacted.error)], sample)
        if not len(missed):
            break
        sample = np.union1d(sample, missed[even_indices(len(missed), FIT_SAMPLE // 4)])
    return compacted


def _allocation(
    features: GaussianFeatures, sample: Int64[np.ndarray, " k"]
) -> tuple[BitAllocation, Float64[np.ndarray, "R R"]]:
    """No bits yet, and the axes in which coordinates have them."""
    centered = centered_rows(features, sample)
    norms = np.sqrt((centered * centered).sum(axis=1))
    centered, norms = centered[norms > 0], norms[norms > 0]
    if not len(norms):
        raise InputError("compact: all features are the space's mean, which no direction tells from one another")
    rarity = rarity_of(centered, norms)
    # A cosine weighs an error by what it is an error of.
    row_weight = rarity / np.maximum(norms, 1e-6 * float(norms.max())) ** 2
    _, vectors = np.linalg.eigh((centered * row_weight[:, None]).T @ centered)
    rotated = vectors[:, ::-1]
    return BitAllocation(centered @ rotated, row_weight, rarity), rotated


def centered_rows(features: GaussianFeatures, rows: np.ndarray) -> Float64[np.ndarray, "n R"]:
    """Some rows about the mean of the features, in the coordinates of their basis."""
    values = features.stored(rows).astype(np.float64)
    return values if features.basis is not None else values - features.mean


def rarity_of(centered: Float64[np.ndarray, "n R"], norms: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    """1 over the number of rows that point the same way, which adds up to one for each kind of feature."""
    units = (centered / norms[:, None]).astype(np.float32)
    counts_alike = [
        (units[start : start + 1024] @ units.T > SAME_KIND_COSINE).sum(axis=1) for start in range(0, len(units), 1024)
    ]
    return 1 / np.maximum(np.concatenate(counts_alike), 1)


def _encode(
    features: GaussianFeatures,
    rows: Int64[np.ndarray, " n"],
    rotated: Float64[np.ndarray, "R R"],
    allocation: BitAllocation,
) -> tuple[CompactFeatures, Float64[np.ndarray, " n"]]:
    used = np.flatnonzero(allocation.bits)
    bits, levels = allocation.bits[used], [allocation.levels[number].astype(np.float32) for number in used]
    codes = np.empty((len(rows), -(-int(bits.sum()) // 8)), np.uint8)
    cosines = np.ones(len(rows))
    for start in range(0, len(rows), BLOCK):
        centered = centered_rows(features, rows[start : start + BLOCK])
        values = centered @ rotated[:, used]
        ones, rounded = [], np.empty_like(values)
        for number, (each, width) in enumerate(zip(levels, bits, strict=True)):
            code = nearest_level(each, values[:, number])
            rounded[:, number] = each[code]
            ones.append(code[:, None] >> np.arange(width - 1, -1, -1) & 1)
        codes[start : start + BLOCK] = np.packbits(np.concatenate(ones, axis=1).astype(np.uint8), axis=1)
        squares = (centered**2).sum(axis=1)
        cosines[start : start + BLOCK] = np.where(squares > 0, cosines_of(values, rounded, squares), np.nan)
    axes = rotated[:, used].T
    basis = features.basis
    components = axes if basis is None else axes @ basis.components
    weights = features.weights[rows].astype(np.float64)
    tiny = float(np.finfo(np.float32).tiny)
    lightest, heaviest = max(float(weights.min()), tiny), max(float(weights.max()), tiny)
    shares = np.log(np.maximum(weights, lightest) / lightest) / max(np.log(heaviest / lightest), 1e-12)
    compacted = CompactFeatures(
        codes=codes,
        bits=bits.astype(np.uint8),
        levels=np.concatenate(levels),
        weight_codes=np.rint(255 * shares).astype(np.uint8),
        lightest=lightest,
        heaviest=heaviest,
        rows=rows,
        total=len(features),
        basis=FeatureBasis(
            mean=features.mean,
            components=np.ascontiguousarray(components, np.float32),
            energy_kept=allocation.energy_kept * (1.0 if basis is None else basis.energy_kept),
            space=features.space,
        ),
        error=max(1 - float(np.nanmean(cosines)), allocation.errors()[1], 0.0),
        lowest=float(np.nanquantile(cosines, 0.001)),
    )
    return compacted, cosines
