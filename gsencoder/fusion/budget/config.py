"""Promises about a fusion."""

from dataclasses import dataclass, field, replace

from gsencoder.core.errors import InputError
from gsencoder.core.settings import Budget, check_governed
from gsencoder.fusion.fuse import FuseConfig

GOVERNED = (
    "views",
    "view_share",
    "view_choice",
    "basis",
    "max_rank",
    "energy",
    "table_energy",
    "blend.rays_per_patch",
    "blend.stop_transmittance",
    "blend.min_weight",
)
"""The options of fusion that a budget sets, by key."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BudgetConfig(Budget):
    """What a fusion may cost, or must reach. Where they conflict, the one that stands first here wins.

    A budget of error alone takes the cheapest setting that keeps it; budgets of seconds and megabytes without one take
    the most exact setting that keeps them.
    """

    error: float | None = field(
        default=None,
        metadata={
            "help": "largest mean of 1 − centered cosine to the features of preset=exact, over all Gaussians that it "
            "sees; one that only it sees counts as 1"
        },
    )
    seconds: float | None = field(
        default=None, metadata={"help": "largest time from the choice of the setting to the features"}
    )
    megabytes: float | None = field(
        default=None, metadata={"help": "largest size of the file of features, in units of 1,000,000 bytes"}
    )
    check: bool = field(
        default=True,
        metadata={"help": "measure the error afterwards, which fuses at preset=exact; false = leave it unmeasured"},
    )
    seed: int = field(default=0, metadata={"help": "of the sample of Gaussians on which the setting is chosen"})


def check_budget(budget: BudgetConfig, config: FuseConfig, *, basis: bool = False) -> None:
    """Refuses what a budget cannot be combined with.

    Args:
        budget: any of its promises.
        config: the options of the fusion.
        basis: whether features are fused in a basis that was given.

    Raises:
        InputError: an option that the budget chooses is set, or a fusion that no sample of rays stands for.
    """
    if not budget.promised:
        return
    names = budget.names
    check_governed(budget, config, FuseConfig(), GOVERNED, "fusion")
    if config.lift != "blend":
        raise InputError(f"fusion.lift={config.lift}: {names} is for lift=blend alone; leave one of the two out")
    if "rendered" in config.visibility.against:
        raise InputError(
            f"fusion.visibility.against=rendered: {names} knows sensor depth alone; test against sensor or nothing, or "
            "leave the budget out"
        )
    if basis:
        raise InputError(f"basis=: {names} chooses a rank, and a basis that is given has one; leave one of the two out")


def exact_config(config: FuseConfig) -> FuseConfig:
    """The fusion that errors are measured against: the values of `preset=exact`."""
    blend = replace(config.blend, rays_per_patch=196, stop_transmittance=1e-6, min_weight=0.0)
    return replace(config, blend=blend, energy=1.0, table_energy=1.0, max_rank=0, basis=True, views=0, view_share=1.0)
