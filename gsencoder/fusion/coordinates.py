"""Features with fewer coordinates: principal axes, what they leave out, and as many of them as fit into a file."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from gsencoder.core.arrays import even_indices
from gsencoder.core.budget import MEGABYTE, Budget
from gsencoder.fusion.folder import features_bytes
from gsencoder.fusion.quantize import centered_rows
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

    def rank_within(self, error: float) -> int:
        """The smallest number of axes that keeps an error; all of them where none does."""
        within = np.flatnonzero(self.errors <= error)
        return int(within[0]) + 1 if len(within) else len(self.errors)

    def reduced(self, features: GaussianFeatures, rank: int) -> GaussianFeatures:
        """The features that the axes are of, with `rank` coordinates."""
        axes, basis = self.axes[:rank], features.basis
        values = np.zeros((len(features), rank), np.float32)
        seen = np.flatnonzero(features.seen)
        for start in range(0, len(seen), BLOCK):
            rows = seen[start : start + BLOCK]
            values[rows] = centered_rows(features, rows) @ axes.T
        return GaussianFeatures(
            features=values,
            weights=features.weights,
            mean=features.mean,
            space=features.space,
            basis=FeatureBasis(
                mean=features.mean,
                components=np.ascontiguousarray(axes if basis is None else axes @ basis.components, np.float32),
                energy_kept=float(self.energies[rank - 1]) * (1.0 if basis is None else basis.energy_kept),
                space=features.space,
            ),
        )


def principal_axes(features: GaussianFeatures) -> PrincipalAxes:
    """The axes of features without an index, on an evenly spaced sample; each direction counts the same."""
    seen = np.flatnonzero(features.seen)
    values = centered_rows(features, seen[even_indices(len(seen), SAMPLE)])
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


class Reduced(NamedTuple):
    """Features whose files keep a limit of megabytes.

    Attributes:
        error: that leaving out coordinates adds, of the teacher that loses most.
    """

    features: dict[str, GaussianFeatures]
    ranks: dict[str, int]
    error: float
    megabytes: float


def reduce_to_fit(
    features: Mapping[str, GaussianFeatures], budget: Budget, header: Mapping[str, Any], *, error: float = 0.0
) -> Reduced:
    """Features with as many coordinates as fit into a limit of megabytes, or as a limit of error needs. Teachers share
    the bytes in proportion to what all their coordinates take.

    Args:
        header: the settings that `save_features` writes with them, which take bytes.
        error: what features may lose where the budget limits the error.
    """
    limit = budget.limit("megabytes") * MEGABYTE

    def size(name: str, rank: int) -> int:
        each = features[name]
        # All channels have no basis, which takes bytes of its own.
        all_channels = each.basis is None and rank == each.features.shape[1]
        return features_bytes(each.space, int(each.seen.sum()), rank, header, basis=not all_channels)

    full = {name: each.features.shape[1] for name, each in features.items()}
    full_sizes = {name: size(name, rank) for name, rank in full.items()}
    ranks, lost, reduced = dict(full), 0.0, dict(features)
    if sum(full_sizes.values()) > limit:
        for name, each in features.items():
            axes, share = principal_axes(each), limit * full_sizes[name] / sum(full_sizes.values())
            fitting = [rank for rank in range(1, full[name] + 1) if size(name, rank) <= share]
            needed = axes.rank_within(error) if "error" in budget.limits else 1
            ranks[name] = rank = max([needed, *fitting])
            if rank < full[name]:
                reduced[name] = axes.reduced(each, rank)
                lost = max(lost, float(axes.errors[rank - 1]))
    megabytes = sum(size(name, rank) for name, rank in ranks.items()) / MEGABYTE
    if megabytes > budget.limit("megabytes") and "error" not in budget.limits:
        raise budget.too_small(megabytes)
    return Reduced(reduced, ranks, lost, megabytes)
