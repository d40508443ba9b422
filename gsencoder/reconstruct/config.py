"""Settings of `gsencoder.reconstruct.run.reconstruct`."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

from gsencoder.core.errors import InputError
from gsencoder.core.files import plain
from gsencoder.core.settings import check_governed
from gsencoder.data.seeding.from_photographs import DenseConfig
from gsencoder.data.seeding.seed import SeedConfig
from gsencoder.reconstruct.budget import BudgetConfig
from gsencoder.reconstruct.optimize_config import OptimizeConfig
from gsencoder.reconstruct.prune import PruneConfig
from gsencoder.render.rasterize import RasterConfig

START_AGAIN = "give resume=false to begin anew"
Report = Callable[[str], None]
"""Receives one line of text for people."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReconstructConfig:
    """How photographs become Gaussians, and how the result is judged."""

    holdout: int = field(default=8, metadata={"help": "hold out every n-th photograph for validation; 0 = none"})
    validate_every: int = field(default=500, metadata={"help": "steps between validations; 0 = at the end alone"})
    checkpoint_every: float = field(default=60.0, metadata={"help": "seconds between checkpoints"})
    seeds: SeedConfig = field(default_factory=SeedConfig)
    dense: DenseConfig = field(default_factory=DenseConfig)
    optimize: OptimizeConfig = field(default_factory=OptimizeConfig)
    budget: BudgetConfig = field(default_factory=BudgetConfig)
    prune: PruneConfig = field(default_factory=PruneConfig)
    raster: RasterConfig = field(default_factory=RasterConfig)

    def __post_init__(self) -> None:
        if self.holdout < 0 or self.holdout == 1:
            raise InputError(f"holdout: expected 0 (none) or 2 and more, got {self.holdout}")
        for name in ("validate_every", "checkpoint_every"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise InputError(f"{name}: expected 0 or more, got {getattr(self, name)}")
        if self.budget.error is not None or self.budget.seconds is not None:
            of_steps = replace(self.budget, megabytes=None)
            check_governed(of_steps, self.optimize, OptimizeConfig(), ("steps", "earlier"), "optimize")
        if self.budget.error is not None and not self.holdout:
            raise InputError(
                "budget.error: is measured on held-out photographs, and holdout=0 holds out none; leave one of the two "
                "out"
            )
        if self.budget.megabytes is not None and not (self.prune.at and self.optimize.steps):
            never = "optimize.steps=0" if self.prune.at else "prune.at=[]"
            raise InputError(
                f"budget.megabytes: Gaussians that do not fit are taken out as the splat is pruned, and {never} "
                "never prunes; leave one of the two out"
            )

    def validates_at(self, step: int, steps: int) -> bool:
        """Whether is validated after `step` of `steps`."""
        return step in (0, steps) or bool(self.validate_every and step % self.validate_every == 0)

    def identity(self) -> dict[str, Any]:
        """The settings that an interrupted run must share with the run that continues it, as JSON values."""
        names = ("seeds", "dense", "optimize", "budget", "prune", "raster", "holdout")
        return {name: plain(getattr(self, name)) for name in names}
