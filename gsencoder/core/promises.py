"""Budgets: what the section `budget` of a command may promise, and how promises are checked, ordered and worded.

Each stage with budgets has a frozen dataclass of its promises beside its code (`gsencoder.reconstruct.budget`,
`gsencoder.fusion.budget.config`, `gsencoder.fusion.store.budget`, `gsencoder.infer.encode_budget.config`,
`gsencoder.infer.views.budget`), with those fields of `PROMISES` that mean something there.
"""

from collections.abc import Iterable
from math import inf

from gsencoder.core.errors import InputError
from gsencoder.core.knobs import shown_value, value_at

PROMISES = {"error": "", "seconds": " s", "megabytes": " MB"}
"""What can be promised, with its unit. Where promises conflict, the one that stands first wins."""
MEGABYTE = 1_000_000
PLANNED = 0.85
"""Share of promised seconds that is planned with, since times vary."""


class Budget:
    """Promises: a frozen dataclass with fields `error`, `seconds` or `megabytes`, None where nothing is promised.

    A field `seed`, where there is one, is of what the choice draws.

    Raises:
        InputError: a promise that means nothing, or a negative seed.
    """

    __slots__ = ()

    def __post_init__(self) -> None:
        for name in self.promised:
            value = self.promise(name)
            if name == "error" and not 0 < value < 1:
                raise InputError(f"error: expected a number between 0 and 1, got {value}")
            if not 0 < value < inf:
                raise InputError(f"{name}: expected a number above 0, got {value}")
        if (seed := getattr(self, "seed", 0)) < 0:
            raise InputError(f"seed: expected 0 or more, got {seed}")

    @property
    def promised(self) -> tuple[str, ...]:
        """The promises that are made, the one that wins first."""
        return tuple(name for name in PROMISES if getattr(self, name, None) is not None)

    def promise(self, name: str) -> float:
        """The value of a promise that is made."""
        return float(getattr(self, name))

    @property
    def names(self) -> str:
        """The options of the promises that are made, for messages."""
        return " and ".join(f"budget.{name}" for name in self.promised)

    def shown(self, name: str) -> str:
        """A promise as it is written on the command line."""
        return f"budget.{name}={shown_value(self.promise(name))}"

    def conflict(self, first: str, other: str, needed: float) -> str:
        """What is said where a promise cannot be kept beside one that comes before it.

        Args:
            first: the promise that wins.
            other: the one that is broken.
            needed: what it becomes.
        """
        return (
            f"{self.shown(first)} takes about {needed:.3g}{PROMISES[other]}, more than {self.shown(other)}; "
            f"budget.{first} comes first"
        )


def check_governed(budget: Budget, settings: object, default: object, keys: Iterable[str], section: str) -> None:
    """Refuses options that a budget chooses where they are set by hand.

    Args:
        budget: any of its promises.
        settings: of the stage.
        default: such settings with every option at its default.
        keys: of the options, with dots between sections.
        section: that the settings are on the command line.

    Raises:
        InputError: an option has another value than its default.
    """
    if not budget.promised:
        return
    for key in keys:
        if (value := value_at(settings, key)) != value_at(default, key):
            raise InputError(
                f"{section}.{key}={shown_value(value)}: is chosen by {budget.names}; leave it (or the preset that sets "
                "it) out, or the budget"
            )
