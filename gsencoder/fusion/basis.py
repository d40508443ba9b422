"""The affine subspace that a scene's features live in: the smallest rank that keeps a share of the energy.

Lifting and rendering are linear, so features may be fused, stored and rendered as R coordinates in place of D
channels. Because rows of B sum to alpha and not to 1, a rendered map decodes as `(B @ z) @ components + alpha·mean`.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Float64

from gsencoder.core.errors import InputError
from gsencoder.types import FeatureBasis, FeatureMap, FeatureSpace

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
    # The same without a matrix of all channels, whose eigenvectors would take longer than lifting a view.
    _, lengths, vectors = np.linalg.svd(centered / np.sqrt(len(table)), full_matrices=False)
    return _leading(wide, lengths**2, vectors, space, energy=energy, max_rank=0)


def to_coordinates(basis: FeatureBasis, vectors: Float[np.ndarray, "*n D"]) -> Float32[np.ndarray, "*n R"]:
    """Coordinates of vectors: (x − mean) @ componentsᵀ."""
    return ((vectors - basis.mean) @ basis.components.T).astype(np.float32)


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
