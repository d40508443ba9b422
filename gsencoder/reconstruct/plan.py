"""The plan of a reconstruction: how large photographs are, how many steps, colors of which degree, how many Gaussians.

A step costs about C₀ + C₁ · pixels + C₂ · Gaussians in view. For an aim in minutes, sizes and steps follow from this
formula alone, so that the same command on the same machine gives the same splat. Limits are kept by measurement: sizes
are counted on a trial pruning of the seeds, seconds by a few steps that are timed on the scene.
"""

import math
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch

from gsencoder.core.arrays import even_indices
from gsencoder.core.budget import MEGABYTE, PLANNED, Budget
from gsencoder.core.errors import InputError
from gsencoder.core.process import Track
from gsencoder.core.settings import check_limits, option
from gsencoder.data.splats.ply import inria_row_bytes
from gsencoder.reconstruct.optimize import USUAL_STEPS, OptimizeConfig, Optimizer, RowAdam
from gsencoder.reconstruct.score import MAX_COMPARISONS, score
from gsencoder.types import Cameras

FIXED_SECONDS, PIXEL_SECONDS, GAUSSIAN_SECONDS = 0.03, 7e-7, 1.25e-6
"""Of a rendered and differentiated view on two cores: measured on five scenes, 20,000 to 400,000 pixels and 27,000 to
170,000 Gaussians in view."""
OVERHEAD = 1.2
"""A step, its update and its share of validation and pruning take this many times what the view takes."""
USUAL_GAUSSIANS = 60_000.0
"""Gaussians in view that the size of photographs is chosen for, before there are any."""
CORE_GAIN = 0.8
"""Twice the cores are 2 to the power of this as fast."""
CUDA_GAIN = 30.0
SEED_SHARE = 0.2
"""Share of the time that reading and seeding may take."""
DEFAULT_MINUTES = 10.0
STEPS_IN_SECONDS = 400
"""For a limit of seconds photographs are made smaller only where there is no time for this many steps: of the same
time, fewer steps cost less than smaller photographs (docs/measurements.md, Trade-off)."""
LEAST_STEPS, MOST_STEPS = 200, 3000
"""The fewest of an aim in minutes; the most of any budget, which are those of preset=exact."""
FEW_STEPS = 50
"""A limit of seconds that has time for fewer steps is said to have little."""
SMALLEST_REDUCTION = 0.95
"""Photographs are not resized by less than this."""
SEEN_VIEWS, TRIAL_VIEWS = 4, 2
"""Views that stand for all where Gaussians are counted, and where steps are timed."""
AIMED = 0.98
"""Share of a limit of seconds at which results are written, however many steps were done."""
HEADER_BYTES = 2048
"""Of a .ply file, at most."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReconstructBudget(Budget):
    """What a reconstruction may take: the most steps, the highest degree of colors and the most Gaussians that the
    limits allow."""

    minutes: float = option(
        DEFAULT_MINUTES,
        "aim at this many minutes: photographs are made smaller and the default optimize.steps fewer or "
        "more; 0 = neither. No limit, and not used with budget.seconds",
        ge=0,
    )
    seconds: float | None = option(
        None,
        "largest time from the start of the command to its results: steps are planned for "
        f"{PLANNED:.0%} of it, and end early where the clock runs out; what is repeated after a kill is extra",
    )
    megabytes: float | None = option(None, "largest size of splat.ply, in units of 1,000,000 bytes")

    def __post_init__(self) -> None:
        Budget.__post_init__(self)
        check_limits(self)


def step_seconds(pixels: float, gaussians: float, device: torch.device, config: OptimizeConfig) -> float:
    """Expected seconds of a step, on average over the stages, by the pixels of a photograph at its full size and the
    Gaussians in view."""
    seen = sum(share * pixels / shrink**2 for share, shrink in zip(config.shares, config.shrinks, strict=True))
    seconds = OVERHEAD * (FIXED_SECONDS + PIXEL_SECONDS * seen + GAUSSIAN_SECONDS * gaussians)
    if device.type == "cuda":
        return seconds / CUDA_GAIN
    return seconds * (2 / min(torch.get_num_threads(), os.cpu_count() or 1)) ** CORE_GAIN


def steps_for_minutes(minutes: float, config: OptimizeConfig) -> int:
    """Steps that a budget is worth: more time goes into steps by its third root, and into pixels by the rest."""
    return max(LEAST_STEPS, round(config.steps * (minutes / DEFAULT_MINUTES) ** (1 / 3)))


def choose_scale(
    cameras: Cameras, budget: ReconstructBudget, device: torch.device, config: OptimizeConfig, *, spent: float = 0.0
) -> float:
    """The factor by which photographs are made smaller, 1 = not at all.

    Args:
        cameras: of the photographs at their full size.
        spent: seconds that reading has taken, which count to a limit of seconds.
    """
    if budget.seconds is not None:
        minutes, steps = max(PLANNED * budget.seconds - spent, 1.0) / 60, STEPS_IN_SECONDS
    elif budget.minutes:
        minutes, steps = budget.minutes, steps_for_minutes(budget.minutes, config)
    else:
        return 1.0
    without_pixels, with_one = (step_seconds(size, USUAL_GAUSSIANS, device, config) for size in (0.0, 1.0))
    of_a_pixel, seconds = with_one - without_pixels, (1 - SEED_SHARE) * 60 * minutes / steps
    # Where pixels are a third of a step, even half of them would hardly save time.
    affordable = max(without_pixels / of_a_pixel / 2, (seconds - without_pixels) / of_a_pixel)
    pixels = float(np.median(cameras.widths.astype(np.float64) * cameras.heights))
    scale = math.sqrt(affordable / pixels)
    return 1.0 if scale > SMALLEST_REDUCTION else round(scale, 3)


def affordable_steps(optimizer: Optimizer, minutes: float) -> int:
    """The number of steps that the formula allows; those of the settings where they are not the default, or for 0
    minutes."""
    config = optimizer.config
    if not minutes or config.steps != USUAL_STEPS:
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


class Costs(NamedTuple):
    """Seconds of each kind of work: of a step by the factor that makes photographs smaller, of a pruning, of a
    validation, and of a render of a held-out view."""

    steps: Mapping[int, float]
    pruning: float
    validation: float
    picture: float


def measured_costs(optimizer: Optimizer, held_out: Sequence[int]) -> Costs:
    """What the work costs by a few trial steps, which change nothing."""
    views = spread_views(optimizer.training, TRIAL_VIEWS)
    shrinks = dict.fromkeys(optimizer.config.shrink_at(step) for step in range(optimizer.config.steps))
    steps = {shrink: _mean_seconds(views, partial(_trial_step, optimizer, shrink)) for shrink in shrinks}
    picture = 0.0
    if held_out:
        picture = _mean_seconds(spread_views(held_out, TRIAL_VIEWS), lambda view: score(optimizer, [view]))
    # A pruning renders each fitted photograph at half its size, with gradients.
    pruning = len(optimizer.training) * min(steps.values(), default=0.0)
    return Costs(steps, pruning, len(held_out) * picture, picture)


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


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """What a reconstruction is about to do.

    Attributes:
        max_gaussians: Gaussians that pruning leaves at most; None = no limit.
        spent: seconds before the first step.
        until: seconds after which no step begins; None without a limit of them.
        seconds: expected in all; None without a limit of them.
        megabytes: expected size of the splat; None without a limit of it.
        notes: limits that are expected to be broken.
    """

    steps: int
    sh_degree: int
    max_gaussians: int | None = None
    spent: float = 0.0
    until: float | None = None
    seconds: float | None = None
    megabytes: float | None = None
    notes: tuple[str, ...] = ()

    @classmethod
    def of(cls, facts: Mapping[str, Any]) -> "Plan":
        """The plan in the facts of a checkpoint."""
        return cls(**{**facts, "notes": tuple(facts["notes"])})


def make_plan(
    optimizer: Optimizer,
    held_out: Sequence[int],
    budget: ReconstructBudget,
    validations: Callable[[int], int],
    *,
    double_means: bool,
    began: float,
    now: Callable[[], float],
) -> Plan:
    """Plans a reconstruction that has not begun, and sets its colors; `apply_plan` carries the rest out.

    Args:
        validations: how many there are in a number of steps.
        double_means: whether the splat's positions are written as doubles.
        began: when the command began, as `now` counts.
    """
    plan = Plan(steps=optimizer.config.steps, sh_degree=optimizer.config.sh_degree)
    if budget.megabytes is not None:
        plan = _within_megabytes(optimizer, budget, plan, double_means)
    if budget.seconds is None:
        return replace(plan, steps=affordable_steps(optimizer, budget.minutes), spent=now() - began)
    refuse_late(budget, now() - began, "reading photographs and seeding")
    # Trial steps have the colors of the plan.
    apply_plan(optimizer, plan)
    costs, before, steps = measured_costs(optimizer, held_out), now() - began, plan.steps
    config, prune = optimizer.config, optimizer.pruning
    each = sum(costs.steps[config.shrink_at(step)] for step in range(steps)) / steps
    prunings = costs.pruning * sum(prune.due(step, config) for step in range(1, steps + 1))
    pictures = MAX_COMPARISONS * costs.picture
    for _ in range(2):
        # The number of validations depends on the steps.
        other = prunings + costs.validation * validations(max(steps, 1)) + pictures
        steps = min(math.floor((PLANNED * budget.seconds - before - other) / each), MOST_STEPS)
    needed = math.ceil((before + other + FEW_STEPS * each) / PLANNED)
    few = f"{budget.option('seconds')}: has time for {max(steps, 0)} steps; budget.seconds={needed} has for {FEW_STEPS}"
    if steps < 1:
        raise InputError(few)
    return replace(
        plan,
        steps=steps,
        spent=before,
        until=AIMED * budget.seconds - costs.validation - pictures,
        seconds=before + other + steps * each,
        notes=(few,) if steps < FEW_STEPS else (),
    )


def apply_plan(optimizer: Optimizer, plan: Plan) -> None:
    """Sets steps, colors and the limit of Gaussians; coefficients of colors above the planned degree are taken out."""
    optimizer.config = replace(optimizer.config, steps=plan.steps, sh_degree=plan.sh_degree)
    optimizer.max_gaussians = plan.max_gaussians
    coefficients = (plan.sh_degree + 1) ** 2 - 1
    if optimizer.parameters["shN"].shape[1] > coefficients:
        # There are no moments yet.
        shN = optimizer.parameters["shN"][:, :coefficients].contiguous()
        optimizer.adam = RowAdam({**optimizer.parameters, "shN": shN})


def describe_plan(optimizer: Optimizer, steps: int, option: str) -> str:
    """What is about to happen; `option` chose the number of steps where it is not that of the settings."""
    widths, heights = optimizer.photographs.cameras.widths, optimizer.photographs.cameras.heights
    usual = optimizer.config.steps
    number = f"{steps - optimizer.step:,} more of {steps:,} steps" if optimizer.step else f"{steps:,} steps"
    if steps != usual:
        number += f" instead of {usual:,} ({option})"
    return (
        f"{len(optimizer.training)} photographs of {int(np.median(widths))}×{int(np.median(heights))}, "
        f"{len(optimizer.parameters['means']):,} Gaussians, {number}"
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
    max_gaussians = int(limit // sizes[degree])
    if max_gaussians < 1:
        raise budget.too_small((HEADER_BYTES + sizes[0]) / MEGABYTE)
    expected = (HEADER_BYTES + min(contributing, max_gaussians) * sizes[degree]) / MEGABYTE
    return replace(plan, sh_degree=degree, max_gaussians=max_gaussians, megabytes=expected)


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

    return in_time
