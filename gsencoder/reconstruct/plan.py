"""The plan of a reconstruction: how many steps, colors of which degree, and how many Gaussians keep its budget.

Sizes are counted on a trial pruning of the seeds, and seconds are those of trial steps on the scene; where seconds are
promised, the clock changes the number of steps while they are done. How many steps an error takes is not predicted: the
plan begins with few, and is extended until held-out photographs show that error.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gsencoder.core.errors import InputError
from gsencoder.core.settings import MEGABYTE
from gsencoder.data.splats.ply import inria_row_bytes
from gsencoder.reconstruct.budget import SMALLEST_REDUCTION, BudgetConfig, affordable_steps, least_pixels
from gsencoder.reconstruct.checkpoint import PLANNED_DEGREE
from gsencoder.reconstruct.expected_time import Costs
from gsencoder.reconstruct.optimize import Optimizer
from gsencoder.reconstruct.report import MAX_COMPARISONS, LogRow
from gsencoder.reconstruct.row_adam import RowAdam

STEPS = (50, 100, 150, 200, 300, 400, 600, 800, 1100, 1500, 2100, 3000)
"""Steps after which a promised error is looked at. The last are those of preset=exact; no promise takes more of them,
or fewer than the first."""
PATIENCE = 2
"""A promised error is given up once it was looked at so many times without becoming smaller than before: more steps
then fit the photographs that are fitted, and no others."""
AIMED = 0.98
"""Share of promised seconds that the clock steers to."""
FEW_STEPS = STEPS[1]
"""Where promised seconds have no time for so many steps, photographs are made smaller once more."""
SMALLEST_SHARE = 0.2
"""Of the pixels, which smaller photographs keep at least."""
LATE = 1.5
"""So many times the aim in minutes is said."""
HEADER_BYTES = 2048
"""Of a .ply file, at most."""
PLAN = "plan"
"""The fact of a checkpoint that holds the rest of the plan."""


class PhotographsTooLargeError(Exception):
    """Promised seconds have no time for steps of photographs of this size, and enough is left to begin anew with
    photographs that are so many times as large, `args[0]`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """What a reconstruction is about to do.

    Attributes:
        steps: of the optimization; of a promised error the next at which it is looked at.
        sh_degree: of colors.
        earlier: what was planned before, see `OptimizeConfig`.
        most: Gaussians that pruning leaves at most; None = no limit.
        spent: seconds before the first step.
        seconds: expected in all; None without a promise of them.
        megabytes: expected size of the splat; None without a promise of it.
        notes: what is known not to be kept.
    """

    steps: int
    sh_degree: int
    earlier: tuple[int, ...] = ()
    most: int | None = None
    spent: float = 0.0
    seconds: float | None = None
    megabytes: float | None = None
    notes: tuple[str, ...] = ()

    def facts(self) -> dict[str, Any]:
        """The plan as facts of a checkpoint, JSON values."""
        rest = {name: getattr(self, name) for name in ("most", "spent", "seconds", "megabytes")}
        return {
            "steps_planned": self.steps,
            PLANNED_DEGREE: self.sh_degree,
            PLAN: {**rest, "earlier": list(self.earlier), "notes": list(self.notes)},
        }

    @classmethod
    def of(cls, facts: Mapping[str, Any], *, steps: int, sh_degree: int) -> "Plan":
        """The plan in the facts of a checkpoint.

        Args:
            facts: of the checkpoint.
            steps: where there are none, as in checkpoints of earlier versions.
            sh_degree: likewise.
        """
        rest = dict(facts.get(PLAN, {}))
        notes, earlier = (tuple(rest.pop(name, ())) for name in ("notes", "earlier"))
        steps = int(facts.get("steps_planned", steps))
        return cls(
            steps=steps, sh_degree=int(facts.get(PLANNED_DEGREE, sh_degree)), notes=notes, earlier=earlier, **rest
        )


def make_plan(
    optimizer: Optimizer,
    budget: BudgetConfig,
    costs: Callable[[], Costs],
    validations: Callable[[int], int],
    *,
    double_means: bool,
    spent: Callable[[], float],
    may_shrink: bool = False,
) -> Plan:
    """Plans a reconstruction that has not begun; `follow` carries the plan out.

    Args:
        optimizer: with the seeds.
        budget: what is promised, and the aim in minutes.
        costs: measures the work, with the colors of the plan.
        validations: how many there are in so many steps.
        double_means: whether the splat's positions are written as doubles.
        spent: seconds until now.
        may_shrink: whether photographs may be made smaller.

    Raises:
        InputError: megabytes into which not one Gaussian fits, or seconds that are over.
        PhotographsTooLargeError: seconds ask for smaller ones.
    """
    config = optimizer.config
    plan = Plan(steps=config.steps, sh_degree=config.sh_degree, earlier=config.earlier)
    if budget.megabytes is not None:
        plan = _within_megabytes(optimizer, budget, budget.megabytes, plan, double_means)
    if budget.error is not None:
        return replace(plan, steps=STEPS[0], spent=spent())
    if budget.seconds is None:
        return replace(plan, steps=affordable_steps(optimizer, budget.minutes), spent=spent())
    follow(optimizer, plan)
    return _within_seconds(optimizer, budget, budget.seconds, plan, costs, validations, spent, may_shrink)


def follow(optimizer: Optimizer, plan: Plan) -> None:
    """Sets steps, colors and the limit of Gaussians; coefficients of colors above the planned degree are taken out."""
    optimizer.config = replace(optimizer.config, steps=plan.steps, sh_degree=plan.sh_degree, earlier=plan.earlier)
    optimizer.most = plan.most
    coefficients = (plan.sh_degree + 1) ** 2 - 1
    if optimizer.parameters["shN"].shape[1] > coefficients:
        # There are no moments yet.
        optimizer.adam = RowAdam(
            {
                name: value[:, :coefficients].contiguous() if name == "shN" else value
                for name, value in optimizer.parameters.items()
            }
        )


def extended(plan: Plan, budget: BudgetConfig, rows: Sequence[LogRow]) -> Plan:
    """The plan with more steps, where a promised error was not reached and more may reach it; otherwise the same, with
    a note where more would not.

    Args:
        plan: that was followed to its end.
        budget: what is promised.
        rows: of the log.
    """
    if budget.error is None or error_of(rows[-1]) <= budget.error:
        return plan
    errors = {int(row["step"]): error_of(row) for row in rows if row["step"] in STEPS}
    best = min(errors, key=lambda step: errors[step])
    if len([step for step in errors if step > best]) >= PATIENCE:
        lowest = f"step {best} ({errors[best]:.4f})"
        note = f"{budget.shown('error')}: it has not fallen since {lowest}, so no more steps are done"
        # A run that was cut off here finds the note in its checkpoint.
        return replace(plan, notes=tuple(dict.fromkeys((*plan.notes, note))))
    return replace(plan, steps=next((steps for steps in STEPS if steps > plan.steps), plan.steps))


def error_of(row: LogRow) -> float:
    """1 − SSIM of a validation: of surfaces that a fitted photograph shows, where a sensor says which these are."""
    return 1 - row.get("seen_ssim", row["ssim"])


def _within_megabytes(
    optimizer: Optimizer, budget: BudgetConfig, megabytes: float, plan: Plan, double_means: bool
) -> Plan:
    """The highest degree of colors with which the Gaussians that contribute now fit, or degree 0 and as many as fit."""
    try:
        contributing = len(optimizer.contributing())
    except InputError:
        # Nothing would be left now; the steps until the first pruning may change that.
        contributing = len(optimizer.parameters["means"])
    limit = megabytes * MEGABYTE - HEADER_BYTES
    sizes = {d: inria_row_bytes(d, double_means=double_means) for d in range(plan.sh_degree, -1, -1)}
    degree = next((d for d, row in sizes.items() if contributing * row <= limit), 0)
    most = int(limit // sizes[degree])
    if most < 1:
        raise InputError(
            f"{budget.shown('megabytes')}: not one Gaussian fits; a splat of one takes "
            f"{(HEADER_BYTES + sizes[0]) / MEGABYTE:.4g}"
        )
    expected = (HEADER_BYTES + min(contributing, most) * sizes[degree]) / MEGABYTE
    return replace(plan, sh_degree=degree, most=most, megabytes=expected)


def _within_seconds(
    optimizer: Optimizer,
    budget: BudgetConfig,
    seconds: float,
    plan: Plan,
    measure: Callable[[], Costs],
    validations: Callable[[int], int],
    spent: Callable[[], float],
    may_shrink: bool,
) -> Plan:
    """As many steps as there is time for, by trial steps of each kind."""
    begun = spent()
    refuse_late(budget, begun, "reading photographs and seeding")
    costs, steps = measure(), plan.steps
    before = spent()
    expected = costs.expected(optimizer.config, optimizer.pruning, 0, steps, 0)
    each = expected.steps / steps
    for _ in range(2):
        # How often is validated depends on the steps.
        other = expected.other + costs.validation * validations(max(steps, 1)) + MAX_COMPARISONS * costs.picture
        steps = min(math.floor((AIMED * seconds - before - other) / each), STEPS[-1])
    cameras, shares = optimizer.photographs.cameras, (SMALLEST_SHARE, steps / (2 * FEW_STEPS))
    least = least_pixels(optimizer.device, optimizer.config) / float(np.median(cameras.widths * cameras.heights))
    factor = math.sqrt(max(*shares, least))
    if may_shrink and steps < FEW_STEPS and factor < SMALLEST_REDUCTION and before + factor * begun < seconds / 2:
        raise PhotographsTooLargeError(factor)
    needed = math.ceil((before + other + STEPS[0] * each) / AIMED)
    few = f"{budget.shown('seconds')}: has time for {max(steps, 0)} steps; budget.seconds={needed} has for {STEPS[0]}"
    if steps < 1:
        raise InputError(few)
    total = before + other + steps * each
    return replace(plan, steps=steps, spent=before, seconds=total, notes=(few,) if steps < STEPS[0] else ())


def refuse_late(budget: BudgetConfig, spent: float, subject: str, advice: str = "") -> None:
    """Raises InputError where promised seconds are over before the first step; `subject` says with what."""
    if budget.clock is not None and spent >= AIMED * budget.clock:
        raise InputError(
            f"{budget.shown('seconds')}: is over before the first step: {spent:.0f} s went into {subject}; "
            f"give {advice or 'more seconds, a smaller data.image_scale, or fewer photographs (data.max_views)'}"
        )


def late_notes(budget: BudgetConfig, seconds: float) -> tuple[str, ...]:
    """What is said where so many seconds in all are far more than the aim in minutes, which no clock keeps."""
    note = (
        f"budget.minutes={budget.minutes:g} aims at less; budget.seconds={60 * budget.minutes:g} is kept by the clock"
    )
    return (note,) if not budget.promised and 0 < 60 * LATE * budget.minutes < seconds else ()
