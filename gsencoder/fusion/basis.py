"""The affine subspace that a scene's features live in: the smallest rank that keeps a share of the energy.

Lifting and rendering are linear, so features may be fused, stored and rendered as R coordinates in place of D
channels. Because rows of B sum to alpha and not to 1, a rendered map decodes as `(B @ z) @ components + alpha·mean`.
Of other scenes than those it was fitted to a basis may keep less, and no features in its coordinates can be closer to
the teacher's than the projections of the teacher's own vectors are.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError
from gsencoder.types import FeatureBasis, FeatureMap, FeatureSpace, GaussianFeatures, Teacher, Views

WORST = 0.05
"""Share of the vectors below the cosine that is called the worst."""


def distinct_rows(feature_map: FeatureMap) -> Float32[np.ndarray, "n D"]:
    """The vectors of a map that its basis and mean are computed from: of a coded map each row of its table that occurs,
    once, so that a region counts however few pixels it has; of others each cell that has a vector."""
    if feature_map.codes is not None:
        assert feature_map.table is not None
        counts = np.bincount(feature_map.codes.ravel() + 1, minlength=len(feature_map.table) + 1)
        return feature_map.table[counts[1:] > 0]
    rows = feature_map.rows()
    return rows[np.isfinite(rows[:, 0])]


class Moments:
    """Streaming first and second moments of feature vectors, in float64, one chunk at a time."""

    def __init__(self, channels: int, *, second: bool = True) -> None:
        """`second=False` keeps the mean alone."""
        self.count = 0.0
        self.second = second
        self.sum: Float64[np.ndarray, " D"] = np.zeros(channels)
        self.outer: Float64[np.ndarray, "D D"] = np.zeros((channels, channels) if second else (0, 0))
        self._shift: Float32[np.ndarray, " D"] | None = None

    def add(self, vectors: Float[np.ndarray, "n D"]) -> None:
        if len(vectors) == 0:
            return
        if self._shift is None:
            # Moments are taken about the first chunk's mean: features whose mean is large against their spread, as
            # those of vision transformers are, would otherwise lose the spread to cancellation.
            self._shift = vectors.mean(axis=0, dtype=np.float64).astype(np.float32)
        shifted = vectors - self._shift
        gram = (shifted.T @ shifted).astype(np.float64) if self.second else shifted.sum(axis=0, dtype=np.float64)
        if not np.isfinite(gram).all():
            bad = int((~np.isfinite(vectors).all(axis=1)).sum())
            raise InputError(f"features: expected finite values, got {bad} bad rows of {len(vectors)}")
        self.count += len(vectors)
        self.sum += shifted.sum(axis=0, dtype=np.float64)
        if self.second:
            self.outer += gram

    def merge(self, other: "Moments") -> None:
        """Takes all into account that was added to others; the same order of merging gives the same bits."""
        if other._shift is None:
            return
        if self._shift is None:
            self._shift = other._shift
        offset = other._shift.astype(np.float64) - self._shift
        if self.second:
            mixed = np.outer(other.sum, offset)
            self.outer += other.outer + mixed + mixed.T + other.count * np.outer(offset, offset)
        self.sum += other.sum + other.count * offset
        self.count += other.count

    @property
    def mean(self) -> Float64[np.ndarray, " D"]:
        if self._shift is None or self.count == 0:
            raise InputError("features: no view has any cell with features; nothing to fit a basis to")
        return self._shift + self.sum / self.count

    def covariance(self) -> Float64[np.ndarray, "D D"]:
        """Second moment about the mean."""
        offset = self.sum / max(self.count, 1.0)
        return self.outer / max(self.count, 1.0) - np.outer(offset, offset)


def fit_basis(
    mean: Float64[np.ndarray, " D"],
    covariance: Float64[np.ndarray, "D D"],
    space: FeatureSpace,
    *,
    energy: float,
    max_rank: int = 0,
) -> FeatureBasis:
    """The leading eigenvectors of a covariance, which keep a share of its trace; at most `max_rank` of them, 0 = no
    limit. `energy_kept` of the result says what that cost."""
    values, vectors = np.linalg.eigh(covariance)
    return _leading(mean, np.maximum(values[::-1], 0), vectors[:, ::-1].T, space, energy=energy, max_rank=max_rank)


def _leading(
    mean: Float64[np.ndarray, " D"],
    values: Float64[np.ndarray, " E"],
    vectors: Float64[np.ndarray, "E D"],
    space: FeatureSpace,
    *,
    energy: float,
    max_rank: int,
) -> FeatureBasis:
    """The basis of the first eigenvectors, which come in descending order of their eigenvalues."""
    total = values.sum()
    if total == 0:
        rank = 1
    else:
        # Below rounding a component holds nothing; without this cut energy = 1 would keep every channel.
        meaningful = int((values > values[0] * 1e-7).sum())
        rank = min(int(np.searchsorted(values.cumsum() / total, energy - 1e-9)) + 1, meaningful)
    if max_rank:
        rank = min(rank, max_rank)
    energy_kept = float(values[:rank].sum() / total) if total else 1.0
    components = vectors[:rank]
    # The sign of an eigenvector is arbitrary; its largest entry is made positive so that reruns agree.
    largest = np.abs(components).argmax(axis=1)
    components = components * np.sign(components[np.arange(rank), largest])[:, None]
    return FeatureBasis(
        mean=mean.astype(np.float32),
        components=np.ascontiguousarray(components, np.float32),
        energy_kept=min(energy_kept, 1.0),
        space=space,
    )


def table_basis(
    table: Float32[np.ndarray, "C D"], mean: Float32[np.ndarray, " D"], space: FeatureSpace, *, energy: float
) -> FeatureBasis:
    """A basis for coded maps. Every row of the table counts once: a name matters however few pixels it has."""
    wide, centered = mean.astype(np.float64), table.astype(np.float64) - mean
    if len(table) >= space.channels:
        return fit_basis(wide, centered.T @ centered / len(table), space, energy=energy)
    # Eigenvectors of all channels would take longer than lifting a view. Only ratios of the eigenvalues matter.
    _, lengths, vectors = np.linalg.svd(centered, full_matrices=False)
    return _leading(wide, lengths**2, vectors, space, energy=energy, max_rank=0)


def basis_figures(basis: FeatureBasis | None, rank: int) -> dict[str, int | float]:
    """The rank of a basis, and the share of the energy that it keeps of the vectors that it was fitted to; `rank` is
    the number of columns of the features, which without a basis are all channels."""
    return {"rank": rank, "energy_kept": basis.energy_kept if basis is not None else 1.0}


def describe_basis(figures: Mapping[str, Any], scenes: str) -> str:
    """The figures of `basis_figures` in a phrase, and those of `BasisFit.figures` where they are known, of `scenes`."""
    phrase = f"rank {figures['rank']}, keeps {figures['energy_kept']:.4f} of the energy"
    if "other_energy" not in figures:
        return phrase
    return (
        f"{phrase}, and {figures['other_energy']:.4f} in {scenes} (cosine {figures['other_cosine']:.3f}, worst 5 % "
        f"below {figures['other_worst']:.3f})"
    )


BINS = 1000
"""Bins of the histogram of cosines from 0 to 1, from which quantiles are interpolated."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BasisFit:
    """How well a basis represents vectors.

    Attributes:
        energy: share of the sum of squared distances from the mean that the projections keep.
        cosine: mean cosine, about the mean, of vectors with their projections.
        worst: the cosine below which the worst 5 % of the vectors are.
    """

    energy: float
    cosine: float
    worst: float
    vectors: int

    def figures(self) -> dict[str, float]:
        """As summaries and weights name them: of other vectors than the basis was fitted to."""
        return {"other_energy": self.energy, "other_cosine": self.cosine, "other_worst": self.worst}


class ProjectionSums:
    """Running sums over vectors, from which a `BasisFit` is computed; those of several scenes can be added.

    Attributes:
        histogram: number of vectors by their cosine with their projection.
        sums: energy kept, energy, and sum of the cosines.
    """

    def __init__(
        self, histogram: Float64[np.ndarray, " bins"] | None = None, sums: Float64[np.ndarray, "3"] | None = None
    ) -> None:
        self.histogram = np.zeros(BINS) if histogram is None else histogram
        self.sums = np.zeros(3) if sums is None else sums

    def add(
        self, basis: FeatureBasis, vectors: Float32[np.ndarray, "n D"], counts: Float[np.ndarray, " n"] | None = None
    ) -> None:
        """Adds vectors of the space, each `counts` times; vectors that are the mean itself have no direction and are
        left out."""
        explained = np.square(basis.coordinates(vectors), dtype=np.float64).sum(axis=1)
        total = np.square(vectors - basis.mean, dtype=np.float64).sum(axis=1)
        count = np.where(total > 0, np.ones(len(vectors)) if counts is None else counts, 0)
        # Rounding may make a projection longer than its vector.
        cosines = np.sqrt(np.minimum(explained / np.where(total > 0, total, 1), 1))
        bins = np.minimum((cosines * BINS).astype(np.int64), BINS - 1)
        self.histogram += np.bincount(bins, weights=count, minlength=BINS)
        self.sums += [(explained * count).sum(), (total * count).sum(), (cosines * count).sum()]

    def add_map(self, basis: FeatureBasis, feature_map: FeatureMap) -> None:
        if feature_map.codes is not None:
            assert feature_map.table is not None
            codes = feature_map.codes[feature_map.codes >= 0]
            self.add(basis, feature_map.table, np.bincount(codes, minlength=len(feature_map.table)).astype(np.float64))
            return
        rows = feature_map.rows()
        self.add(basis, rows[np.isfinite(rows[:, 0])])

    def fit(self) -> BasisFit:
        vectors = float(self.histogram.sum())
        explained, total, cosines = self.sums.tolist()
        if not vectors:
            raise InputError("basis: no view has a cell whose vector differs from the mean; nothing to compare")
        cumulative, rank = self.histogram.cumsum(), WORST * vectors
        bin_ = int(np.searchsorted(cumulative, rank))
        within = 1 - (cumulative[bin_] - rank) / self.histogram[bin_]
        worst = float((bin_ + within) / BINS)
        return BasisFit(
            energy=min(explained / total, 1.0), cosine=cosines / vectors, worst=worst, vectors=round(vectors)
        )


def total_fit(sums: Iterable[ProjectionSums]) -> BasisFit:
    total = ProjectionSums()
    for each in sums:
        total.histogram += each.histogram
        total.sums += each.sums
    return total.fit()


def project_maps(basis: FeatureBasis, teacher: Teacher, views: Views, rows: Iterable[int]) -> ProjectionSums:
    if teacher.space != basis.space:
        raise InputError(f"basis: is of ({basis.space.describe()}), the maps of ({teacher.space.describe()})")
    sums = ProjectionSums()
    for view in rows:
        sums.add_map(basis, teacher.feature_map(views, int(view)))
    return sums


MAX_CELLS = 32_768
"""Approximate limit of the cells of a sample: a mean of this many is known to 1/180 of the scale."""


class CellSample:
    """Vectors of evenly spaced cells of a number of maps."""

    def __init__(self, maps: int, limit: int = MAX_CELLS) -> None:
        self._per_map = max(1, limit // max(1, maps))
        self._parts: list[np.ndarray] = []

    def add(self, feature_map: FeatureMap) -> None:
        rows = feature_map.rows()
        rows = rows[np.isfinite(rows).all(axis=1)]
        self._parts.append(rows[:: -(-len(rows) // self._per_map)] if len(rows) else rows)

    def vectors(self) -> Float32[np.ndarray, "n D"]:
        if not sum(len(part) for part in self._parts):
            raise InputError("heads: no view has a cell with a vector; check the teacher's maps")
        return np.concatenate(self._parts).astype(np.float32, copy=False)


def sample_cells(teacher: Teacher, views: Views, rows: Sequence[int]) -> CellSample:
    sample = CellSample(len(rows))
    for view in rows:
        sample.add(teacher.feature_map(views, view))
    return sample


DEFAULT_SAMPLE = 20_000
CHUNK = 4096
JUDGED = 0.1
"""Share of the seen Gaussians on which the error of a budget is measured."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldError:
    """One field held against a more accurate one; each seen Gaussian counts the same, however much it was seen.

    Attributes:
        centered: 1 − mean cosine after each field's own mean is taken off, over Gaussians that both saw.
        raw: the same without taking the mean off.
        covered: share of the reference's seen Gaussians that the other saw too.
    """

    centered: float
    raw: float
    covered: float

    @property
    def total(self) -> float:
        """1 − mean centered cosine over all that the reference saw; a Gaussian that only it saw counts as 0."""
        return 1 - self.covered * (1 - self.centered)


def field_error(
    features: GaussianFeatures,
    reference: GaussianFeatures,
    *,
    sample: int = DEFAULT_SAMPLE,
    rows: Int64[np.ndarray, " n"] | None = None,
) -> FieldError:
    """Compares two fields in the full space.

    Args:
        sample: the most Gaussians, evenly spaced over all that the reference saw; 0 = all.
        rows: the Gaussians that are compared, which the reference saw; None = a sample.
    """
    if len(features) != len(reference) or features.space != reference.space:
        raise InputError(
            f"field_error: expected {len(reference)} Gaussians in ({reference.space.describe()}), "
            f"got {len(features)} in ({features.space.describe()})"
        )
    if rows is None:
        rows = np.flatnonzero(reference.seen)
        rows = rows[even_indices(len(rows), sample)] if sample else rows
    if not len(rows):
        raise InputError("field_error: the reference saw no Gaussian")
    both = rows[features.seen[rows]]
    centered = raw = 0.0
    for start in range(0, len(both), CHUNK):
        part = both[start : start + CHUNK]
        a, b = features.decode(part).astype(np.float64), reference.decode(part).astype(np.float64)
        raw += float(row_cosines(a, b).sum())
        centered += float(row_cosines(a - features.mean, b - reference.mean).sum())
    if not len(both):
        return FieldError(centered=1.0, raw=1.0, covered=0.0)
    return FieldError(centered=1 - centered / len(both), raw=1 - raw / len(both), covered=len(both) / len(rows))


def judge(features: GaussianFeatures, exact: GaussianFeatures, *, seed: int = 0) -> FieldError:
    """The error on a tenth of the Gaussians that the exact features see, drawn now; each counts the same."""
    seen = np.flatnonzero(exact.seen)
    count = min(max(round(JUDGED * len(seen)), 1), len(seen))
    # Not the sequence of numbers that drew the sample on which a setting was chosen.
    rows = np.random.default_rng((seed, 1)).choice(seen, count, replace=False)
    return field_error(features, exact, rows=np.sort(rows))


def row_cosines(a: Float64[np.ndarray, "n D"], b: Float64[np.ndarray, "n D"]) -> Float64[np.ndarray, " n"]:
    """Cosine of each row with the other's; the eps inside the root makes a zero vector's cosine 0."""
    norms = np.sqrt((a * a).sum(axis=1) * (b * b).sum(axis=1) + 1e-60)
    return np.asarray((a * b).sum(axis=1) / norms)
