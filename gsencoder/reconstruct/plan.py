"""The plan of a reconstruction: how many steps, colors of which degree, and how many Gaussians keep its budget.

Sizes are counted on a trial pruning of the seeds, and seconds are those of trial steps on the scene; where seconds are
promised, the clock changes the number of steps while they are done. How many steps an error takes is not predicted: the
plan begins with few, and is extended until held-out photographs show that error.

What a reconstruction may take: how large photographs are looked at, and for how many steps.

A step costs about C₀ + C₁ · pixels + C₂ · Gaussians in view. For an aim in minutes, sizes and steps follow from this
formula alone, so that the same command on the same machine gives the same splat; the time that is announced is
measured. What is promised (`error`, `seconds`, `megabytes`) is planned in `gsencoder.reconstruct.plan`.
"""

import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from math import inf
from typing import Any, NamedTuple

import numpy as np
import torch

from gsencoder.core.errors import InputError
from gsencoder.core.settings import MEGABYTE, PLANNED, Budget
from gsencoder.data.splats.ply import inria_row_bytes
from gsencoder.reconstruct.optimize import OptimizeConfig, Optimizer, PruneConfig
from gsencoder.reconstruct.parameters import PLANNED_DEGREE, RowAdam
from gsencoder.reconstruct.score import MAX_COMPARISONS, LogRow, score
from gsencoder.types import Cameras

FIXED_SECONDS, PIXEL_SECONDS, GAUSSIAN_SECONDS = 0.03, 7e-7, 1.25e-6
"""Of a rendered and differentiated view on two cores: measured on five scenes, 20,000 to 400,000 pixels and 27,000 to
170,000 Gaussians in view."""
OVERHEAD = 1.2
"""A step, its update and its share of validation and pruning take so many times what the view takes."""
USUAL_GAUSSIANS = 60_000.0
"""Gaussians in view that the size of photographs is chosen for, before there are any."""
CORE_GAIN = 0.8
"""Twice the cores are 2 to the power of this as fast."""
CUDA_GAIN = 30.0
SEED_SHARE = 0.2
"""Share of the time that reading and seeding may take."""
DEFAULT_MINUTES = 10.0
PROMISED_STEPS = 400
"""For promised seconds photographs are made smaller only where there is no time for so many steps: of the same time,
fewer steps cost less than smaller photographs (docs/measurements.md, Trade-off)."""
LEAST_STEPS = 200
SMALLEST_REDUCTION = 0.95
"""Photographs are not resized by less than this."""
TRIAL_VIEWS = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class BudgetConfig(Budget):
    """What a reconstruction may take, or must reach. A promised size is kept in any case; error comes before seconds.

    A promised error takes the fewest steps that reach it; seconds and megabytes without one take the most steps, the
    highest degree of colors and the most Gaussians that they allow.
    """

    minutes: float = field(
        default=DEFAULT_MINUTES,
        metadata={
            "help": "aim at so many minutes: photographs are made smaller and the default optimize.steps fewer or "
            "more; 0 = neither. No promise, and not used beside budget.seconds"
        },
    )
    error: float | None = field(
        default=None,
        metadata={
            "help": "largest mean of 1 − SSIM on held-out photographs, at the size that photographs are looked at; "
            "of measured surfaces, where a fitted photograph shows them"
        },
    )
    seconds: float | None = field(
        default=None,
        metadata={
            "help": "largest time from the start of the command to its results, which the clock keeps: it changes the "
            "number of steps while they are done; what a kill made be repeated is extra"
        },
    )
    megabytes: float | None = field(
        default=None, metadata={"help": "largest size of splat.ply, in units of 1,000,000 bytes"}
    )

    def __post_init__(self) -> None:
        Budget.__post_init__(self)
        if not 0 <= self.minutes < math.inf:
            raise InputError(f"minutes: expected 0 (no budget) or more, got {self.minutes}")

    @property
    def option_of_steps(self) -> str:
        """The option that chooses the number of steps."""
        return next((f"budget.{name}" for name in ("error", "seconds") if name in self.promised), "budget.minutes")

    @property
    def clock(self) -> float | None:
        """Promised seconds that the clock keeps; a promised error comes before them."""
        return self.seconds if self.error is None else None

    def minutes_left(self, spent: float = 0.0) -> float:
        """The minutes that sizes and steps are chosen for; 0 = all that they want.

        Args:
            spent: seconds that reading has taken, which count to a promise of seconds.
        """
        if self.seconds is None:
            return self.minutes
        return max(PLANNED * self.seconds - spent, 1.0) / 60


def step_seconds(pixels: float, gaussians: float, device: torch.device, config: OptimizeConfig) -> float:
    """Expected seconds of a step, on average over the stages.

    Args:
        pixels: of a photograph at its full size.
        gaussians: in view.
        device: where it is computed.
        config: the stages.
    """
    seen = sum(share * pixels / shrink**2 for share, shrink in zip(config.shares, config.shrinks, strict=True))
    seconds = OVERHEAD * (FIXED_SECONDS + PIXEL_SECONDS * seen + GAUSSIAN_SECONDS * gaussians)
    if device.type == "cuda":
        return seconds / CUDA_GAIN
    return seconds * (2 / min(torch.get_num_threads(), os.cpu_count() or 1)) ** CORE_GAIN


def steps_for_minutes(minutes: float, config: OptimizeConfig) -> int:
    """Steps that a budget is worth: more time goes into steps by its third root, and into pixels by the rest."""
    return max(LEAST_STEPS, round(config.steps * (minutes / DEFAULT_MINUTES) ** (1 / 3)))


def least_pixels(device: torch.device, config: OptimizeConfig) -> float:
    """Pixels of a photograph that is made no smaller: where they are a third of a step, even half of them would hardly
    save time."""
    none, pixel = _step_costs(device, config)
    return none / pixel / 2


def _step_costs(device: torch.device, config: OptimizeConfig) -> tuple[float, float]:
    """Seconds of a step without pixels, and of each pixel more."""
    none, one = (step_seconds(size, USUAL_GAUSSIANS, device, config) for size in (0.0, 1.0))
    return none, one - none


def choose_scale(
    cameras: Cameras, budget: BudgetConfig, device: torch.device, config: OptimizeConfig, *, spent: float = 0.0
) -> float:
    """The factor by which photographs are made smaller, 1 = not at all.

    Args:
        cameras: of the photographs at their full size.
        budget: the aim in minutes, or promised seconds.
        device: where it is computed.
        config: the stages.
        spent: seconds that reading has taken.
    """
    pixels = float(np.median(cameras.widths.astype(np.float64) * cameras.heights))
    minutes = budget.minutes_left(spent)
    if not minutes:
        return 1.0
    none, pixel = _step_costs(device, config)
    steps = steps_for_minutes(minutes, config) if budget.seconds is None else PROMISED_STEPS
    seconds = (1 - SEED_SHARE) * 60 * minutes / steps
    affordable = max(least_pixels(device, config), (seconds - none) / pixel)
    scale = math.sqrt(affordable / pixels)
    return 1.0 if scale > SMALLEST_REDUCTION else round(scale, 3)


def affordable_steps(optimizer: Optimizer, minutes: float) -> int:
    """The number of steps that the formula allows; those of the settings where they are not the default, or for 0
    minutes."""
    config = optimizer.config
    if not minutes or config.steps != OptimizeConfig().steps or config.earlier:
        return config.steps
    views = trial_views(optimizer.training)
    gaussians = float(np.mean([optimizer.rows_seen(view) for view in views]))
    pixels = float(np.mean([optimizer.photographs.at_scale(view).image[..., 0].numel() for view in views]))
    seconds = step_seconds(pixels, gaussians, optimizer.device, config)
    affordable = (1 - SEED_SHARE) * 60 * minutes / seconds
    return int(min(max(LEAST_STEPS, affordable), steps_for_minutes(minutes, config)))


def trial_views(training: Sequence[int]) -> list[int]:
    """Some views, evenly spaced, that stand for all."""
    return [training[index] for index in np.linspace(0, len(training) - 1, min(TRIAL_VIEWS, len(training))).astype(int)]


class ExpectedSeconds(NamedTuple):
    """Seconds that a part of a reconstruction will take.

    Attributes:
        steps: all steps.
        other: prunings and validations.
    """

    steps: float
    other: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Costs:
    """Seconds of each kind of work, measured between two steps.

    Attributes:
        step: number of steps that were done.
        steps: of a step, by the factor that makes photographs smaller and whether the next pruning was before it.
        prunings: of the next pruning, and of each after it.
        validation: of one.
        picture: of a render beside a held-out photograph.
    """

    step: int
    steps: Mapping[tuple[int, bool], float]
    prunings: tuple[float, float]
    validation: float
    picture: float

    def expected(
        self, config: OptimizeConfig, prune: PruneConfig, start: int, stop: int, validations: int
    ) -> ExpectedSeconds:
        """Seconds that the steps from `start` to `stop` take, with their prunings and so many validations."""
        stepping, other, pruned = 0.0, validations * self.validation, False
        for step in range(self.step, stop):
            if step >= start:
                stepping += self.steps.get((config.shrink_at(step), pruned), max(self.steps.values()))
            if prune.due(step + 1, config):
                other += self.prunings[pruned] if step >= start else 0
                pruned = True
        return ExpectedSeconds(stepping, other)


def measured_costs(optimizer: Optimizer, held_out: Sequence[int], limit: float = inf) -> Costs:
    """What the remaining work costs; nothing changes.

    Gaussians that contribute nothing now will not contribute later either, and the first pruning takes them out. So it
    is done once for trial, and the steps after it are timed with what it leaves.

    Args:
        optimizer: as it is now.
        held_out: views that are validated on.
        limit: seconds that go into each kind of work, which is done twice at least.
    """
    config, state, prunings, pruned = optimizer.config, optimizer, (0.0, 0.0), False
    steps: dict[tuple[int, bool], float] = {}
    for step in range(optimizer.step, config.steps):
        kind = (config.shrink_at(step), pruned)
        if kind not in steps:
            steps[kind] = _mean_seconds(trial_views(optimizer.training), partial(_step, state, kind[0]), limit)
        if not pruned and optimizer.pruning.due(step + 1, config):
            began, pruned = time.perf_counter(), True
            state = _pruned(optimizer)
            seconds = time.perf_counter() - began
            prunings = (seconds, seconds * len(state.parameters["means"]) / len(optimizer.parameters["means"]))
    picture = _mean_seconds(trial_views(held_out), lambda view: score(optimizer, [view]), limit) if held_out else 0.0
    validation = len(held_out) * picture
    return Costs(step=optimizer.step, steps=steps, prunings=prunings, validation=validation, picture=picture)


class Pace:
    """How many steps there is time for, by a clock that is looked at whenever a quarter of the time has gone that was
    left at the look before."""

    LOOKS, CHANGE = 0.25, 0.02

    def __init__(self, costs: Costs, until: float, elapsed: Callable[[], float]) -> None:
        """Args:
        costs: measured at the step where the run begins or goes on.
        until: seconds that may have gone after the last step.
        elapsed: seconds that have gone.
        """
        self.costs, self.until, self.elapsed = costs, until, elapsed
        self._looked = (costs.step, elapsed())

    def steps(self, optimizer: Optimizer, validates: Callable[[int, int], bool], most: int) -> int:
        """The number of all steps; that of the plan where the clock is not looked at, or where it is about right.

        What was done since the last look took so many times longer than expected, and so will the rest.

        Args:
            optimizer: between two steps.
            validates: whether is validated after a step of so many.
            most: number of steps.
        """
        now, (last, then) = self.elapsed(), self._looked
        config, step = optimizer.config, optimizer.step
        if now - then < self.LOOKS * (self.until - then) or step == last:
            return config.steps
        self._looked = (step, now)
        done, rest = (
            self.costs.expected(
                config, optimizer.pruning, *part, sum(validates(each + 1, config.steps) for each in range(*part))
            )
            for part in ((last, step), (step, config.steps))
        )
        slowness = (now - then) / max(sum(done), 1e-9)
        left = (self.until - now) / max(slowness, 1e-9) - rest.other
        steps = min(step + max(1, int(left * (config.steps - step) / rest.steps)), most)
        return steps if abs(steps - config.steps) >= max(1, self.CHANGE * (config.steps - step)) else config.steps


def _pruned(optimizer: Optimizer) -> Optimizer:
    try:
        return optimizer.restricted(optimizer.contributing())
    except InputError:
        # Nothing would be left now; the steps until then may change that.
        return optimizer


def _step(optimizer: Optimizer, shrink: int, view: int) -> None:
    """What a step does, on a copy of the rows that it changes."""
    _, rows, grads, _ = optimizer.gradients(view, shrink)
    if len(rows):
        seen = RowAdam({name: value[rows] for name, value in optimizer.parameters.items()})
        seen.step(torch.arange(len(rows), device=rows.device), grads, dict.fromkeys(grads, 0.0))


def _mean_seconds(views: Sequence[int], work: Callable[[int], object], limit: float) -> float:
    """Of looks at some views, as many as the limit allows and one at least; a first one compiles and warms caches, and
    is not counted."""
    seconds: list[float] = []
    for view in (views[0], *views):
        began = time.perf_counter()
        work(view)
        seconds.append(time.perf_counter() - began)
        if sum(seconds[1:]) > max(limit, 0.0):
            break
    return float(np.mean(seconds[1:]))


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
