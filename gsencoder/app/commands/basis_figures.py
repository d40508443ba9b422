"""Figures of the basis of an encoder, for summaries, weights and people: rank, energy, and what it keeps elsewhere."""

from collections.abc import Mapping
from typing import Any

from gsencoder.types import FeatureBasis


def basis_figures(basis: FeatureBasis | None, rank: int) -> dict[str, int | float]:
    """The rank of a basis, and the share of the energy that it keeps of the vectors that it was fitted to; `rank` is
    the number of columns of the features, which without a basis are all channels."""
    return {"rank": rank, "energy_kept": basis.energy_kept if basis is not None else 1.0}


def describe_basis(figures: Mapping[str, Any], scenes: str) -> str:
    """The figures in a phrase.

    Args:
        figures: those of `basis_figures`, and those of `BasisFit.figures` where they are known.
        scenes: the scenes that the latter are of.
    """
    phrase = f"rank {figures['rank']}, keeps {figures['energy_kept']:.4f} of the energy"
    if "other_energy" not in figures:
        return phrase
    return (
        f"{phrase}, and {figures['other_energy']:.4f} in {scenes} (cosine {figures['other_cosine']:.3f}, worst 5 % "
        f"below {figures['other_worst']:.3f})"
    )
