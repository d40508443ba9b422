"""Settings of the optimization of a splat, and what changes from step to step: resolution, color degree, rates."""

import math
from dataclasses import dataclass, field, fields

import numpy as np

from gsencoder.core.errors import InputError

MAX_RATE = 10.0
"""Largest learning rate. A step of Adam is about as large as the rate, and a step of 1 makes a scale e times larger."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OptimizeConfig:
    """Settings of the optimization of a splat."""

    steps: int = field(default=1500, metadata={"help": "photographs looked at, one a step"})
    earlier: tuple[int, ...] = field(
        default=(),
        metadata={
            "help": "numbers of steps that were planned before, each with that of the step until which it was; written "
            "by budget.seconds, whose splat they reproduce (results.budget in summary.json)"
        },
    )
    sh_degree: int = field(default=2, metadata={"help": "how colors may depend on the direction, 0 to 3"})
    sh_every: float = field(default=0.2, metadata={"help": "share of the steps after which the degree rises by one"})
    shrinks: tuple[int, ...] = field(
        default=(2, 1), metadata={"help": "photographs are made smaller so many times, one stage after the other"}
    )
    shares: tuple[float, ...] = field(
        default=(0.3, 0.7), metadata={"help": "share of the steps of each of these stages"}
    )
    ssim_weight: float = field(default=0.2, metadata={"help": "of 1 − SSIM; the rest of 1 is L1's"})
    depth_weight: float = field(
        default=0.5, metadata={"help": "of the relative error of depth, where a sensor measured it"}
    )
    empty_weight: float = field(
        default=0.5,
        metadata={
            "help": "of the opacity where transparency, or a background of one color, says that nothing is there"
        },
    )
    means_rate: float = field(default=3e-4, metadata={"help": "learning rate of positions, times the scene's size"})
    means_final: float = field(default=0.01, metadata={"help": "share of that rate which is left at the end"})
    leash: float = field(
        default=0.4,
        metadata={
            "help": "Gaussians that begin on a measured surface (depth, mesh, tsdf) stay within about so many of their "
            "first standard deviations of there; 0 = they go where they like"
        },
    )
    scales_rate: float = field(default=2e-2, metadata={"help": "learning rate of the logarithms of scales"})
    quats_rate: float = field(default=1e-3, metadata={"help": "learning rate of rotations"})
    opacities_rate: float = field(default=5e-2, metadata={"help": "learning rate of the logits of opacities"})
    colors_rate: float = field(default=2.5e-3, metadata={"help": "learning rate of colors; a 20th for directions"})
    exposure: bool = field(
        default=True,
        metadata={
            "help": "fit an affine map of colors to each photograph, for exposure and white balance that differ; "
            "false = photographs are fitted as they are"
        },
    )
    seed: int = field(default=0, metadata={"help": "of the order in which photographs are looked at"})

    def __post_init__(self) -> None:
        if self.steps < 0:
            raise InputError(f"steps: expected 0 or more, got {self.steps}")
        ends = (0, *self.earlier[1::2], self.steps)
        follow = all(until < planned for planned, until in zip(self.earlier[::2], ends[1:], strict=False))
        if self.earlier and (len(self.earlier) % 2 or not follow or sorted({*ends}) != [*ends]):
            raise InputError(
                f"earlier: expected numbers of steps, each with a later step before it, got {self.earlier}"
            )
        if not 0 <= self.sh_degree <= 3:
            raise InputError(f"sh_degree: expected 0 to 3, got {self.sh_degree}")
        if len(self.shrinks) != len(self.shares) or not self.shrinks:
            raise InputError(f"shrinks and shares: expected as many of each, got {self.shrinks} and {self.shares}")
        if min(self.shrinks) < 1:
            raise InputError(f"shrinks: expected whole numbers from 1, got {self.shrinks}")
        if not min(self.shares) >= 0 or not math.isclose(sum(self.shares), 1, abs_tol=1e-6):
            raise InputError(f"shares: expected numbers that add up to 1, got {self.shares}")
        if not 0 <= self.ssim_weight <= 1:
            raise InputError(f"ssim_weight: expected a number from 0 to 1, got {self.ssim_weight}")
        if not 0 < self.means_final <= 1:
            raise InputError(f"means_final: expected a share above 0, up to 1, got {self.means_final}")
        if not 0 <= self.seed < 2**63:
            raise InputError(f"seed: expected 0 or more, got {self.seed}")
        limits = {"sh_every": 1.0, "depth_weight": 100.0, "empty_weight": 100.0, "leash": 1e6}
        limits |= dict.fromkeys((field.name for field in fields(self) if field.name.endswith("_rate")), MAX_RATE)
        for name, limit in limits.items():
            if not 0 <= getattr(self, name) <= limit:
                raise InputError(f"{name}: expected a number from 0 to {limit:g}, got {getattr(self, name)}")

    def _plan_at(self, step: int) -> tuple[int, int, float]:
        """The number of steps that was planned at a step, when that plan began, and the share of the schedule that was
        done then."""
        begun, done = 0, 0.0
        for planned, until in zip(self.earlier[::2], self.earlier[1::2], strict=True):
            if step < until:
                return planned, begun, done
            done += (1 - done) * (until - begun) / (planned - begun)
            begun = until
        return self.steps, begun, done

    def _place_of(self, step: int) -> tuple[float, int]:
        """Where in the schedule of how many steps a step is: a plan stretches what the one before has left over all of
        its own steps. It depends on the plans until then alone."""
        planned, begun, done = self._plan_at(step)
        return planned * (done + (1 - done) * (step - begun) / (planned - begun)) if begun else float(step), planned

    def completes(self, share: float, step: int) -> bool:
        """Whether a share of the schedule is done after so many steps, and was not before."""
        planned, begun, done = self._plan_at(step - 1)
        reached = round(begun + (share - done) / (1 - done) * (planned - begun))
        return share > done and step == max(begun + 1, reached)

    def shrink_at(self, step: int) -> int:
        """Factor by which the photographs of a step are made smaller."""
        place, steps = self._place_of(step)
        ends = np.cumsum(self.shares) * steps
        return self.shrinks[min(int(np.searchsorted(ends, place, side="right")), len(self.shrinks) - 1)]

    def degree_at(self, step: int) -> int:
        """Degree of the color coefficients that a step uses."""
        place, steps = self._place_of(step)
        return min(self.sh_degree, int(place / max(1.0, self.sh_every * steps)))

    def rates_at(self, step: int, extent: float) -> dict[str, float]:
        """Learning rates of a step; that of the positions falls exponentially."""
        place, steps = self._place_of(step)
        return {
            "means": self.means_rate * extent * self.means_final ** (place / max(1, steps)),
            "quats": self.quats_rate,
            "log_scales": self.scales_rate,
            "logit_opacities": self.opacities_rate,
            "sh0": self.colors_rate,
            "shN": self.colors_rate / 20,
        }
