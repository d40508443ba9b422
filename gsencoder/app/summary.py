"""The report of a budget, and the figures of a basis."""

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

from gsencoder.app.output import Summary
from gsencoder.app.run import console
from gsencoder.core.errors import SceneWarning
from gsencoder.core.settings import Budget, describe_values, shown_value
from gsencoder.types import FeatureBasis


def report_choice(
    summary: Summary,
    scene: str,
    knobs: Mapping[str, Any],
    *,
    predicted: Mapping[str, float | None],
    notes: Sequence[str],
    quiet: bool,
    of: str = "",
    **more: Any,
) -> None:
    """Prints a setting that a budget chose, warns of what it does not keep, and adds both to the summary.

    Args:
        predicted: of the setting, by promise; None = not predicted.
        notes: what budgets in conflict do not keep.
        of: what the values are of, on the screen.
    """
    summary.results["budget"] = {
        "chosen": dict(knobs),
        "predicted": {name: value for name, value in predicted.items() if value is not None},
        "notes": list(notes),
        **more,
    }
    console(quiet).print(f"{scene}: budget: {describe_values(knobs)}{of}")
    for note in notes:
        warnings.warn(note, SceneWarning, stacklevel=3)


def report_promises(summary: Summary, budget: Budget, realised: Mapping[str, float]) -> list[str]:
    """A line for each promise that is not broken; warns of those that are, and adds what became of all to the summary.

    Args:
        realised: what was measured, by promise; one that is missing was not.
    """
    promised = {name: budget.promise(name) for name in budget.promised}
    summary.results["budget"].update(promised=promised, realised=dict(realised))
    predicted = summary.results["budget"]["predicted"]
    lines = []
    for name, promise in promised.items():
        if name not in realised:
            lines.append(f"budget.{name}: promised {shown_value(promise)}, not measured (budget.check=false)")
            continue
        if realised[name] <= promise:
            lines.append(f"budget.{name}: promised {shown_value(promise)}, realised {realised[name]:.4g}")
        else:
            more = "; the summary says what was predicted" if name in predicted else ""
            warnings.warn(
                f"budget.{name}: promised {shown_value(promise)}, and it became {realised[name]:.4g}{more}",
                SceneWarning,
                stacklevel=3,
            )
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
