"""How well a basis represents vectors that it was not fitted to: the energy and the directions that it keeps.

A basis keeps a stated share of the energy of the vectors that it was fitted to. Of other scenes it may keep less, and
no features in its coordinates can be closer to the teacher's than the projections of the teacher's own vectors are.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Float64

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError
from gsencoder.fusion.basis import to_coordinates
from gsencoder.fusion.teacher_maps import upright
from gsencoder.teachers.base import Teacher
from gsencoder.types import FeatureBasis, FeatureMap, Views

BINS = 1000
"""Bins of the histogram of cosines from 0 to 1, from which quantiles are interpolated."""
WORST = 0.05
"""Share of the vectors below the cosine that is called the worst."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BasisFit:
    """How well a basis represents vectors.

    Attributes:
        energy: share of the sum of squared distances from the mean that the projections keep.
        cosine: mean cosine, about the mean, of vectors with their projections.
        worst: the cosine below which the worst 5 % of the vectors are.
        vectors: their number.
    """

    energy: float
    cosine: float
    worst: float
    vectors: int

    def figures(self) -> dict[str, float]:
        """The figures by name, as summaries and weights state them: of other vectors than the basis was fitted to."""
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
        explained = np.square(to_coordinates(basis, vectors), dtype=np.float64).sum(axis=1)
        total = np.square(vectors - basis.mean, dtype=np.float64).sum(axis=1)
        count = np.where(total > 0, np.ones(len(vectors)) if counts is None else counts, 0)
        # Rounding may make a projection longer than its vector.
        cosines = np.sqrt(np.minimum(explained / np.where(total > 0, total, 1), 1))
        bins = np.minimum((cosines * BINS).astype(np.int64), BINS - 1)
        self.histogram += np.bincount(bins, weights=count, minlength=BINS)
        self.sums += [(explained * count).sum(), (total * count).sum(), (cosines * count).sum()]

    def add_map(self, basis: FeatureBasis, feature_map: FeatureMap) -> None:
        """Adds the cells of a map that have a vector."""
        if feature_map.codes is not None:
            assert feature_map.table is not None
            codes = feature_map.codes[feature_map.codes >= 0]
            self.add(basis, feature_map.table, np.bincount(codes, minlength=len(feature_map.table)).astype(np.float64))
            return
        rows = feature_map.rows()
        self.add(basis, rows[np.isfinite(rows[:, 0])])

    def fit(self) -> BasisFit:
        """The figures of all vectors that were added.

        Raises:
            InputError: there are none.
        """
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
    """The figures over the vectors of several sums.

    Raises:
        InputError: there are none.
    """
    total = ProjectionSums()
    for each in sums:
        total.histogram += each.histogram
        total.sums += each.sums
    return total.fit()


def basis_fit(basis: FeatureBasis, teacher: Teacher, views: Views, count: int) -> BasisFit:
    """How well a basis represents a teacher's maps of `count` evenly spaced views.

    Raises:
        InputError: the teacher is of another space, or no view has a vector.
    """
    if teacher.space != basis.space:
        raise InputError(f"basis: is of ({basis.space.describe()}), the maps of ({teacher.space.describe()})")
    sums, teacher = ProjectionSums(), upright(teacher)
    for view in even_indices(len(views), count):
        sums.add_map(basis, teacher.feature_map(views, int(view)))
    return sums.fit()
