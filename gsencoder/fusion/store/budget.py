"""Promises about a package."""

from dataclasses import dataclass, field

from gsencoder.core.settings import Budget


@dataclass(frozen=True, slots=True, kw_only=True)
class PackBudget(Budget):
    """What a package may lose, or how large it may be. Where both are promised and conflict, the error wins.

    With a budget of error the smallest package that keeps it is made; with one of megabytes alone, the most exact one.
    """

    error: float | None = field(
        default=None,
        metadata={
            "help": "largest mean of 1 − centered cosine to the features that are packed, over Gaussians and over "
            "kinds of features; without a budget 0.01 for form=compact"
        },
    )
    megabytes: float | None = field(
        default=None, metadata={"help": "largest size of features.gsf, in units of 1,000,000 bytes"}
    )
