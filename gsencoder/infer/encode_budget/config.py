"""Promises about an encoding."""

from dataclasses import dataclass, field, replace

from gsencoder.core.settings import Budget, check_governed
from gsencoder.infer.encode.chunks import EncodeConfig

GOVERNED = ("halo", "precision")
"""The options of encoding that a budget sets; `chunk` remains a limit of memory."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EncodeBudget(Budget):
    """What an encoding may cost, or must reach. Where they conflict, the one that stands first here wins.

    A budget of error alone takes the cheapest setting that keeps it; budgets of seconds and megabytes without one take
    the most exact setting that keeps them.
    """

    error: float | None = field(
        default=None,
        metadata={
            "help": "largest mean of 1 − centered cosine to the features of preset=exact, over all Gaussians; of "
            "several teachers that of the worst"
        },
    )
    seconds: float | None = field(
        default=None, metadata={"help": "largest time from the choice of the setting to the features"}
    )
    megabytes: float | None = field(
        default=None, metadata={"help": "largest size of the files of features, in units of 1,000,000 bytes"}
    )
    check: bool = field(
        default=True,
        metadata={"help": "measure the error afterwards, which encodes at preset=exact; false = leave it unmeasured"},
    )
    seed: int = field(default=0, metadata={"help": "of the parts of the scene on which the setting is chosen"})


def check_encode_budget(budget: EncodeBudget, config: EncodeConfig) -> None:
    """Refuses options that a budget chooses where they are set.

    Raises:
        InputError: one of `GOVERNED` is set.
    """
    check_governed(budget, config, EncodeConfig(), GOVERNED, "encode")


def exact_encoding(config: EncodeConfig) -> EncodeConfig:
    """The encoding that errors are measured against: the values of `preset=exact`."""
    return replace(config, precision="float32", halo=1.28)
