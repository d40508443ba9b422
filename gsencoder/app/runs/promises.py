"""Budgets of a run, for people and for the summary: what was chosen, what was promised, and what became of it."""

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

from gsencoder.app.runs.progress import console
from gsencoder.app.runs.summary import Summary
from gsencoder.core.errors import SceneWarning
from gsencoder.core.settings import Budget, describe_values, shown_value


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
        summary: of the run.
        scene: its name.
        knobs: values of knobs.
        predicted: of the setting, by promise; None = not predicted.
        notes: what budgets in conflict do not keep.
        quiet: see `CommonConfig`.
        of: what the values are of, on the screen.
        more: further entries of `results.budget`.
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
        summary: of the run, after `report_choice`.
        budget: its promises.
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
