"""How large photographs are looked at, and for how many steps, so that a reconstruction ends in about the time given.

A step costs about C₀ + C₁ · pixels + C₂ · Gaussians in view. Sizes and steps follow from this formula alone, so that
the same command on the same machine gives the same splat; the time that is announced is measured.
"""

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch

from gsencoder.core.errors import InputError
from gsencoder.reconstruct.optimize import Optimizer
from gsencoder.reconstruct.optimize_config import OptimizeConfig
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
LEAST_STEPS, LEAST_PIXELS = 200, 40_000
SMALLEST_REDUCTION = 0.95
"""Photographs are not resized by less than this."""
TRIAL_VIEWS = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class BudgetConfig:
    """How long a reconstruction may take."""

    minutes: float = field(
        default=DEFAULT_MINUTES,
        metadata={
            "help": "aim at so many minutes: photographs are made smaller and the default optimize.steps fewer or "
            "more; "
            "0 = neither"
        },
    )

    def __post_init__(self) -> None:
        if not 0 <= self.minutes < math.inf:
            raise InputError(f"minutes: expected 0 (no budget) or more, got {self.minutes}")


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


def choose_scale(cameras: Cameras, budget: BudgetConfig, device: torch.device, config: OptimizeConfig) -> float:
    """The factor by which photographs are made smaller, 1 = not at all."""
    pixels = float(np.median(cameras.widths.astype(np.float64) * cameras.heights))
    if not budget.minutes:
        return 1.0
    seconds = (1 - SEED_SHARE) * 60 * budget.minutes / steps_for_minutes(budget.minutes, config)
    none, one = (step_seconds(size, USUAL_GAUSSIANS, device, config) for size in (0.0, 1.0))
    affordable = max(LEAST_PIXELS, (seconds - none) / (one - none))
    scale = math.sqrt(affordable / pixels)
    return 1.0 if scale > SMALLEST_REDUCTION else round(scale, 3)


def plan_steps(optimizer: Optimizer, budget: BudgetConfig) -> int:
    """The number of steps, where the budget decides: `optimize.steps` is at its default and there is a budget."""
    config = optimizer.config
    if not budget.minutes or config.steps != OptimizeConfig().steps:
        return config.steps
    views = trial_views(optimizer.training)
    gaussians = float(np.mean([optimizer.rows_seen(view) for view in views]))
    pixels = float(np.mean([optimizer.photographs.at_scale(view).image[..., 0].numel() for view in views]))
    seconds = step_seconds(pixels, gaussians, optimizer.device, config)
    affordable = (1 - SEED_SHARE) * 60 * budget.minutes / seconds
    return int(min(max(LEAST_STEPS, affordable), steps_for_minutes(budget.minutes, config)))


def trial_views(training: Sequence[int]) -> list[int]:
    """Some views, evenly spaced, that stand for all."""
    return [training[index] for index in np.linspace(0, len(training) - 1, min(TRIAL_VIEWS, len(training))).astype(int)]
