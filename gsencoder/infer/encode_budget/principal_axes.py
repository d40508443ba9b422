"""Features with fewer coordinates: along the axes in which their directions have most of their energy."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from gsencoder.core.arrays import even_indices
from gsencoder.types import FeatureBasis, GaussianFeatures

SAMPLE = 20_000
"""Gaussians from which axes are computed."""
BLOCK = 65_536


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PrincipalAxes:
    """The axes of some features.

    Attributes:
        axes: in the coordinates of the features, those with most energy first.
        errors: mean of 1 − centered cosine with the first 1, 2, … of them.
        energies: shares of the energy of directions that these keep.
    """

    axes: Float64[np.ndarray, "R R"]
    errors: Float64[np.ndarray, " R"]
    energies: Float64[np.ndarray, " R"]

    def left_out(self, rank: int) -> float:
        """The error with so many axes."""
        return float(self.errors[rank - 1])

    def rank_within(self, error: float) -> int:
        """The smallest number of axes that keeps an error; all of them where none does."""
        within = np.flatnonzero(self.errors <= error)
        return int(within[0]) + 1 if len(within) else len(self.errors)

    def reduced(self, features: GaussianFeatures, rank: int) -> GaussianFeatures:
        """The features with so many coordinates.

        Args:
            features: those that the axes are of.
            rank: 1 or more.
        """
        axes = self.axes[:rank]
        values = np.empty((len(features), rank), np.float32)
        for start in range(0, len(values), BLOCK):
            values[start : start + BLOCK] = (
                _about_mean(features, np.arange(start, min(start + BLOCK, len(values)))) @ axes.T
            )
        basis = features.basis
        components = axes if basis is None else axes @ basis.components
        return GaussianFeatures(
            features=values,
            weights=features.weights,
            mean=features.mean,
            space=features.space,
            basis=FeatureBasis(
                mean=features.mean,
                components=np.ascontiguousarray(components, np.float32),
                energy_kept=float(self.energies[rank - 1]) * (1.0 if basis is None else basis.energy_kept),
                space=features.space,
            ),
        )


def principal_axes(features: GaussianFeatures) -> PrincipalAxes:
    """The axes of features without an index, on an evenly spaced sample; each direction counts the same."""
    values = _about_mean(features, even_indices(len(features), SAMPLE))
    norms = np.linalg.norm(values, axis=1, keepdims=True)
    unit = values[norms[:, 0] > 0] / norms[norms[:, 0] > 0]
    _, vectors = np.linalg.eigh(unit.T @ unit)
    axes = vectors[:, ::-1].T
    shares = np.square(unit @ axes.T).cumsum(axis=1)
    if not len(unit):
        return PrincipalAxes(axes=axes, errors=np.zeros(len(axes)), energies=np.ones(len(axes)))
    return PrincipalAxes(
        axes=axes,
        errors=np.maximum(1 - np.sqrt(shares).mean(axis=0), 0),
        energies=np.minimum(shares.mean(axis=0), 1),
    )


def _about_mean(features: GaussianFeatures, rows: np.ndarray) -> Float64[np.ndarray, "n R"]:
    values = features.stored(rows).astype(np.float64)
    return values if features.basis is not None else values - features.mean
