"""The report of a budget, and the figures of a basis."""

import math
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

from gsencoder.app.output import Summary
from gsencoder.app.run import console
from gsencoder.core.budget import Budget
from gsencoder.core.errors import SceneWarning
from gsencoder.core.settings import describe_values, shown_value
from gsencoder.types import FeatureBasis


def report_choice(
    summary: Summary,
    scene: str,
    chosen: Mapping[str, Any],
    *,
    predicted: Mapping[str, float],
    notes: Sequence[str],
    quiet: bool,
    **more: Any,
) -> None:
    """Prints the setting that a budget chose, warns of what it does not keep, and adds both to the summary.

    Args:
        predicted: by limit.
        notes: limits that are expected to be broken.
        more: further entries of `results.budget`.
    """
    known = {name: value for name, value in predicted.items() if math.isfinite(value)}
    summary.results["budget"] = {"chosen": dict(chosen), "predicted": known, "notes": list(notes), **more}
    console(quiet).print(f"{scene}: budget: {describe_values(chosen)}")
    for note in notes:
        warnings.warn(note, SceneWarning, stacklevel=3)


def report_budget(summary: Summary, budget: Budget, measured: Mapping[str, float]) -> list[str]:
    """A line for each limit that is kept; warns of those that are broken, and adds both numbers to the summary, after
    `report_choice`. A limit that is not in `measured` was not measured."""
    limits = {name: budget.limit(name) for name in budget.limits}
    measured = {name: measured[name] for name in limits if name in measured}
    summary.results["budget"].update(limits=limits, measured=measured)
    lines = []
    for name, limit in limits.items():
        if name not in measured:
            lines.append(f"budget.{name}: limit {shown_value(limit)}, not measured (budget.check=false)")
        elif measured[name] <= limit:
            lines.append(f"budget.{name}: limit {shown_value(limit)}, measured {measured[name]:.4g}")
        else:
            text = f"budget.{name}: the limit is {shown_value(limit)}, and it became {measured[name]:.4g}"
            warnings.warn(text, SceneWarning, stacklevel=3)
    return lines


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
