"""What a reconstruction may take: how large photographs are looked at, and for how many steps.

A step costs about C₀ + C₁ · pixels + C₂ · Gaussians in view. For an aim in minutes, sizes and steps follow from this
formula alone, so that the same command on the same machine gives the same splat; the time that is announced is
measured. What is promised (`error`, `seconds`, `megabytes`) is planned in `gsencoder.reconstruct.plan`.
"""

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch

from gsencoder.core.errors import InputError
from gsencoder.core.settings import PLANNED, Budget
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
