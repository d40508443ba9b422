"""The plan of a reconstruction: how large photographs are, how many steps, colors of which degree, how many Gaussians.

A step costs about C₀ + C₁ · pixels + C₂ · Gaussians in view. For an aim in minutes, sizes and steps follow from this
formula alone, so that the same command on the same machine gives the same splat. Limits are kept by measurement: sizes
are counted on a trial pruning of the seeds; for a limit of seconds a few steps are timed on the scene, and the clock
changes the number of steps while they are done.
"""

import math
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
import torch

from gsencoder.core.arrays import even_indices
from gsencoder.core.budget import MEGABYTE, PLANNED, Budget
from gsencoder.core.errors import InputError
from gsencoder.core.process import Track
from gsencoder.core.settings import option
from gsencoder.data.splats.ply import inria_row_bytes
from gsencoder.reconstruct.optimize import OptimizeConfig, Optimizer, PruneConfig
from gsencoder.reconstruct.parameters import PLANNED_DEGREE, RowAdam
from gsencoder.reconstruct.score import MAX_COMPARISONS, score
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
STEPS_IN_SECONDS = 400
"""For a limit of seconds photographs are made smaller only where there is no time for so many steps: of the same time,
fewer steps cost less than smaller photographs (docs/measurements.md, Trade-off)."""
LEAST_STEPS, MOST_STEPS = 200, 3000
"""The fewest of an aim in minutes; the most of any budget, which are those of preset=exact."""
FEW_STEPS = 50
"""A limit of seconds that has time for fewer steps is said to have little."""
SMALLEST_REDUCTION = 0.95
"""Photographs are not resized by less than this."""
SEEN_VIEWS, TRIAL_VIEWS = 4, 2
"""Views that stand for all where Gaussians are counted, and where steps are timed."""
AIMED = 0.98
"""Share of a limit of seconds that the clock steers to."""
HEADER_BYTES = 2048
"""Of a .ply file, at most."""
PLAN = "plan"
"""The fact of a checkpoint that holds the rest of the plan."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReconstructBudget(Budget):
    """What a reconstruction may take: the most steps, the highest degree of colors and the most Gaussians that the
    limits allow."""

    minutes: float = option(
        DEFAULT_MINUTES,
        "aim at so many minutes: photographs are made smaller and the default optimize.steps fewer or "
        "more; 0 = neither. No limit, and not used beside budget.seconds",
    )
    seconds: float | None = option(
        None,
        "largest time from the start of the command to its results, which the clock keeps: it changes the "
        "number of steps while they are done; what a kill made be repeated is extra",
    )
    megabytes: float | None = option(None, "largest size of splat.ply, in units of 1,000,000 bytes")

    def __post_init__(self) -> None:
        Budget.__post_init__(self)
        if not 0 <= self.minutes < math.inf:
            raise InputError(f"minutes: expected 0 (no budget) or more, got {self.minutes}")

    def minutes_left(self, spent: float = 0.0) -> float:
        """The minutes that sizes and steps are chosen for, after `spent` seconds of reading, which count to a limit of
        seconds; 0 = all that they want."""
        if self.seconds is None:
            return self.minutes
        return max(PLANNED * self.seconds - spent, 1.0) / 60


def step_seconds(pixels: float, gaussians: float, device: torch.device, config: OptimizeConfig) -> float:
    """Expected seconds of a step, on average over the stages.

    Args:
        pixels: of a photograph at its full size.
        gaussians: in view.
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
    cameras: Cameras, budget: ReconstructBudget, device: torch.device, config: OptimizeConfig, *, spent: float = 0.0
) -> float:
    """The factor by which photographs are made smaller, 1 = not at all.

    Args:
        cameras: of the photographs at their full size.
        spent: seconds that reading has taken.
    """
    pixels = float(np.median(cameras.widths.astype(np.float64) * cameras.heights))
    minutes = budget.minutes_left(spent)
    if not minutes:
        return 1.0
    none, pixel = _step_costs(device, config)
    steps = steps_for_minutes(minutes, config) if budget.seconds is None else STEPS_IN_SECONDS
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
    views = spread_views(optimizer.training, SEEN_VIEWS)
    gaussians = float(np.mean([optimizer.rows_seen(view) for view in views]))
    pixels = float(np.mean([optimizer.photographs.at_scale(view).image[..., 0].numel() for view in views]))
    seconds = step_seconds(pixels, gaussians, optimizer.device, config)
    affordable = (1 - SEED_SHARE) * 60 * minutes / seconds
    return int(min(max(LEAST_STEPS, affordable), steps_for_minutes(minutes, config)))


def spread_views(views: Sequence[int], count: int) -> list[int]:
    """Some views, evenly spaced, that stand for all."""
    return [views[index] for index in even_indices(len(views), count)]


class ExpectedSeconds(NamedTuple):
    """Seconds that a part of a reconstruction will take: of its steps, and of prunings and validations."""

    steps: float
    other: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Costs:
    """Seconds of each kind of work.

    Attributes:
        steps: of a step, by the factor that makes photographs smaller.
        pruning: of one.
        validation: of one.
        picture: of a render of a held-out view.
    """

    steps: Mapping[int, float]
    pruning: float
    validation: float
    picture: float

    def expected(
        self, config: OptimizeConfig, prune: PruneConfig, start: int, stop: int, validations: int
    ) -> ExpectedSeconds:
        """Seconds that the steps from `start` to `stop` take, with their prunings and so many validations."""
        numbers = range(start, stop)
        prunings = sum(prune.due(step + 1, config) for step in numbers)
        slowest = max(self.steps.values(), default=0.0)
        return ExpectedSeconds(
            sum(self.steps.get(config.shrink_at(step), slowest) for step in numbers),
            prunings * self.pruning + validations * self.validation,
        )


def measured_costs(optimizer: Optimizer, held_out: Sequence[int]) -> Costs:
    """What the remaining work costs by a few trial steps, which change nothing."""
    views = spread_views(optimizer.training, TRIAL_VIEWS)
    shrinks = dict.fromkeys(optimizer.config.shrink_at(step) for step in range(optimizer.step, optimizer.config.steps))
    steps = {shrink: _mean_seconds(views, partial(_trial_step, optimizer, shrink)) for shrink in shrinks}
    picture = 0.0
    if held_out:
        picture = _mean_seconds(spread_views(held_out, TRIAL_VIEWS), lambda view: score(optimizer, [view]))
    # A pruning renders each fitted photograph at half its size, with gradients.
    pruning = len(optimizer.training) * min(steps.values(), default=0.0)
    return Costs(steps=steps, pruning=pruning, validation=len(held_out) * picture, picture=picture)


def _trial_step(optimizer: Optimizer, shrink: int, view: int) -> None:
    """What a step does, on a copy of the rows that it changes."""
    _, rows, grads, _ = optimizer.gradients(view, shrink)
    if len(rows):
        seen = RowAdam({name: value[rows] for name, value in optimizer.parameters.items()})
        seen.step(torch.arange(len(rows), device=rows.device), grads, dict.fromkeys(grads, 0.0))


def _mean_seconds(views: Sequence[int], work: Callable[[int], object]) -> float:
    """Of looks at some views; a first one compiles and warms caches, and is not counted."""
    seconds: list[float] = []
    for view in (views[0], *views):
        began = time.perf_counter()
        work(view)
        seconds.append(time.perf_counter() - began)
    return float(np.mean(seconds[1:]))


class Pace:
    """How many steps there is time for, by a clock that is looked at whenever a quarter of the time has gone that was
    left at the look before."""

    LOOKS, CHANGE = 0.25, 0.02

    def __init__(self, costs: Costs, step: int, until: float, elapsed: Callable[[], float]) -> None:
        """Args:
        step: where the run begins or goes on.
        until: seconds that may have gone after the last step.
        elapsed: seconds that have gone.
        """
        self.costs, self.until, self.elapsed = costs, until, elapsed
        self._looked = (step, elapsed())

    def steps(self, optimizer: Optimizer, validates: Callable[[int, int], bool]) -> int:
        """The number of all steps; that of the plan where the clock is not looked at, or where it is about right.

        What was done since the last look took so many times longer than expected, and so will the rest.

        Args:
            optimizer: between two steps.
            validates: whether is validated after a step of so many.
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
        steps = min(step + max(1, int(left * (config.steps - step) / rest.steps)), MOST_STEPS)
        return steps if abs(steps - config.steps) >= max(1, self.CHANGE * (config.steps - step)) else config.steps


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """What a reconstruction is about to do.

    Attributes:
        steps: of the optimization.
        sh_degree: of colors.
        earlier: what was planned before, see `OptimizeConfig`.
        most: Gaussians that pruning leaves at most; None = no limit.
        spent: seconds before the first step.
        seconds: expected in all; None without a limit of them.
        megabytes: expected size of the splat; None without a limit of it.
        notes: limits that are expected to be broken.
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
    def of(cls, facts: Mapping[str, Any]) -> "Plan":
        """The plan in the facts of a checkpoint."""
        rest = dict(facts[PLAN])
        notes, earlier = (tuple(rest.pop(name)) for name in ("notes", "earlier"))
        steps, degree = int(facts["steps_planned"]), int(facts[PLANNED_DEGREE])
        return cls(steps=steps, sh_degree=degree, notes=notes, earlier=earlier, **rest)


def make_plan(
    optimizer: Optimizer,
    budget: ReconstructBudget,
    costs: Callable[[], Costs],
    validations: Callable[[int], int],
    *,
    double_means: bool,
    spent: Callable[[], float],
) -> Plan:
    """Plans a reconstruction that has not begun; `apply_plan` carries the plan out.

    Args:
        optimizer: with the seeds.
        costs: measures the work, with the colors of the plan.
        validations: how many there are in so many steps.
        double_means: whether the splat's positions are written as doubles.
        spent: seconds until now.

    Raises:
        InputError: megabytes into which not one Gaussian fits, or seconds that are over.
    """
    config = optimizer.config
    plan = Plan(steps=config.steps, sh_degree=config.sh_degree, earlier=config.earlier)
    if budget.megabytes is not None:
        plan = _within_megabytes(optimizer, budget, plan, double_means)
    if budget.seconds is None:
        return replace(plan, steps=affordable_steps(optimizer, budget.minutes), spent=spent())
    apply_plan(optimizer, plan)
    return _within_seconds(optimizer, budget, budget.seconds, plan, costs, validations, spent)


def apply_plan(optimizer: Optimizer, plan: Plan) -> None:
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


def _within_megabytes(optimizer: Optimizer, budget: ReconstructBudget, plan: Plan, double_means: bool) -> Plan:
    """The highest degree of colors with which the Gaussians that contribute now fit, or degree 0 and as many as fit."""
    try:
        contributing = len(optimizer.contributing())
    except InputError:
        # Nothing would be left now; the steps until the first pruning may change that.
        contributing = len(optimizer.parameters["means"])
    limit = budget.limit("megabytes") * MEGABYTE - HEADER_BYTES
    sizes = {d: inria_row_bytes(d, double_means=double_means) for d in range(plan.sh_degree, -1, -1)}
    degree = next((d for d, row in sizes.items() if contributing * row <= limit), 0)
    most = int(limit // sizes[degree])
    if most < 1:
        raise budget.too_small((HEADER_BYTES + sizes[0]) / MEGABYTE)
    expected = (HEADER_BYTES + min(contributing, most) * sizes[degree]) / MEGABYTE
    return replace(plan, sh_degree=degree, most=most, megabytes=expected)


def _within_seconds(
    optimizer: Optimizer,
    budget: ReconstructBudget,
    seconds: float,
    plan: Plan,
    measure: Callable[[], Costs],
    validations: Callable[[int], int],
    spent: Callable[[], float],
) -> Plan:
    """As many steps as there is time for, by trial steps of each kind."""
    refuse_late(budget, spent(), "reading photographs and seeding")
    costs, steps = measure(), plan.steps
    before = spent()
    expected = costs.expected(optimizer.config, optimizer.pruning, 0, steps, 0)
    each = expected.steps / steps
    for _ in range(2):
        # How often is validated depends on the steps.
        other = expected.other + costs.validation * validations(max(steps, 1)) + MAX_COMPARISONS * costs.picture
        steps = min(math.floor((AIMED * seconds - before - other) / each), MOST_STEPS)
    needed = math.ceil((before + other + FEW_STEPS * each) / AIMED)
    few = f"{budget.option('seconds')}: has time for {max(steps, 0)} steps; budget.seconds={needed} has for {FEW_STEPS}"
    if steps < 1:
        raise InputError(few)
    total = before + other + steps * each
    return replace(plan, steps=steps, spent=before, seconds=total, notes=(few,) if steps < FEW_STEPS else ())


def refuse_late(budget: ReconstructBudget, spent: float, subject: str, advice: str = "") -> None:
    """Raises InputError where a limit of seconds is over before the first step; `subject` says with what."""
    if budget.seconds is not None and spent >= AIMED * budget.seconds:
        raise InputError(
            f"{budget.option('seconds')}: is over before the first step: {spent:.0f} s went into {subject}; "
            f"give {advice or 'more seconds, a smaller data.image_scale, or fewer photographs (data.max_views)'}"
        )


def refusing_late(track: Track, budget: ReconstructBudget, elapsed: Callable[[], float]) -> Track:
    """Progress of what comes before the first step, which ends where the limit of seconds is over."""

    def in_time(items: Iterable[Any], label: str) -> Iterator[Any]:
        for item in track(items, label):
            refuse_late(budget, elapsed(), "reading photographs and seeding")
            yield item

    return track if budget.seconds is None else in_time


class Pacing:
    """The number of steps of a reconstruction: planned, and changed by a clock where seconds are limited.

    Attributes:
        plan: that is followed now.
    """

    plan: Plan

    def __init__(
        self,
        optimizer: Optimizer,
        held_out: Sequence[int],
        budget: ReconstructBudget,
        validates: Callable[[int, int], bool],
        elapsed: Callable[[], float],
    ) -> None:
        """Args:
        optimizer: before its first step, or where it goes on.
        held_out: views that are validated on.
        validates: whether is validated after a step of so many.
        elapsed: seconds since the reconstruction began.
        """
        self._optimizer, self._held_out, self._budget = optimizer, held_out, budget
        self._validates, self._elapsed = validates, elapsed
        self._pace: Pace | None = None

    def begin(self, facts: Mapping[str, Any], *, double_means: bool) -> Plan:
        """Makes a plan, or takes up that of a checkpoint's `facts`, and follows it.

        Raises:
            InputError: as `make_plan`.
        """
        optimizer, budget = self._optimizer, self._budget
        costs = cache(lambda: measured_costs(optimizer, self._held_out))

        def validations(steps: int) -> int:
            return sum(self._validates(step, steps) for step in range(optimizer.step, steps + 1))

        if PLAN in facts:
            plan = Plan.of(facts)
        else:
            plan = make_plan(optimizer, budget, costs, validations, double_means=double_means, spent=self._elapsed)
        self._follow(plan)
        if budget.seconds is not None:
            # The pictures that are compared are rendered after the last step.
            until = AIMED * budget.seconds - MAX_COMPARISONS * costs().picture
            self._pace = Pace(costs(), optimizer.step, until, self._elapsed)
        return plan

    def steps(self, track: Track) -> Iterator[int]:
        """The steps that are left; between two of them the clock may change their number."""
        one = self._optimizer
        while one.step < self.plan.steps:
            for step in track(range(one.step, self.plan.steps), "optimising"):
                yield step
                if self._changes_steps():
                    break

    def _changes_steps(self) -> bool:
        """Looks at the clock; whether the number of steps is another one now."""
        one = self._optimizer
        if self._pace is None or one.step >= self.plan.steps:
            return False
        steps = self._pace.steps(one, self._validates)
        if steps == self.plan.steps:
            return False
        earlier = (*self.plan.earlier, self.plan.steps, one.step)
        self._follow(replace(self.plan, steps=steps, earlier=earlier))
        return True

    def _follow(self, plan: Plan) -> None:
        self.plan = plan
        apply_plan(self._optimizer, plan)
