"""Budgets: limits of error, seconds and megabytes, and the one engine that chooses a setting that keeps them.

A stage lists its settings, cheapest first and the exact one last, and measures one of them on a sample of its input:
some parts of a scene, some views, some steps. `choose` takes the cheapest setting that keeps a limit of error, or the
most exact one that keeps seconds and megabytes. The stage then runs and measures what became of each limit
(`gsencoder.app.run` reports both numbers).
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from math import ceil, inf, nan
from typing import Generic, TypeVar

import numpy as np

from gsencoder.core.errors import InputError
from gsencoder.core.settings import format_value, value_at

UNITS = {"error": "", "seconds": " s", "megabytes": " MB"}
"""The limits of a budget with their units. Where limits conflict, the one that stands first wins."""
MEGABYTE = 1_000_000
PLANNED = 0.85
"""Share of a limit of seconds that is planned with, since times vary."""
DEVIATIONS = 2.0
"""An error is taken to stay below its estimate plus this many standard errors."""


class Budget:
    """Limits: a frozen dataclass with fields `error`, `seconds` or `megabytes`, None = no limit."""

    __slots__ = ()

    def __post_init__(self) -> None:
        for name in self.limits:
            value = self.limit(name)
            if name == "error" and not 0 < value < 1:
                raise InputError(f"error: expected a number above 0 and below 1, got {value}")
            if not 0 < value < inf:
                raise InputError(f"{name}: expected a number above 0, got {value}")

    @property
    def limits(self) -> tuple[str, ...]:
        """The names of the limits that are set, the one that wins first."""
        return tuple(name for name in UNITS if getattr(self, name, None) is not None)

    def limit(self, name: str) -> float:
        return float(getattr(self, name))

    @property
    def options(self) -> str:
        """The options of the limits that are set, for messages."""
        return " and ".join(f"budget.{name}" for name in self.limits)

    def option(self, name: str) -> str:
        """A limit as it is written on the command line."""
        return f"budget.{name}={format_value(self.limit(name))}"

    def conflict(self, other: str, needed: float) -> str:
        """The warning where the limit of error takes more seconds or megabytes than their limit."""
        return (
            f"{self.option('error')} takes about {needed:.3g}{UNITS[other]}, more than {self.option(other)}; "
            "budget.error comes first"
        )

    def too_small(self, megabytes: float) -> InputError:
        """The error where not even the smallest result fits into the limit of megabytes."""
        needed = ceil(1e5 * megabytes) / 1e5
        return InputError(f"{self.option('megabytes')}: the smallest result takes {needed:.6g} MB; give more")


def check_any_limit(budget: Budget) -> None:
    if not budget.limits:
        raise InputError("budget: expected budget.error=, budget.seconds= or budget.megabytes=, got none of them")


def reject_options_set_by_budget(
    budget: Budget, settings: object, default: object, keys: Iterable[str], section: str
) -> None:
    """Refuses options (`keys`, with dots between sections) that a budget chooses where they differ from the default."""
    for key in keys if budget.limits else ():
        if (value := value_at(settings, key)) != value_at(default, key):
            raise InputError(
                f"{section}.{key}={format_value(value)}: is chosen by {budget.options}; leave it (or the preset that "
                "sets it) out, or the budget"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """What a sample says of a setting; NaN = not measured."""

    error: float = nan
    bound: float = nan
    """What the error stays below in all likelihood."""
    seconds: float = nan
    """From the beginning of the choice to the result."""
    megabytes: float = nan


def error_bound(errors: Sequence[float] | np.ndarray, safety: float) -> float:
    """What the mean error of the whole stays below, by the errors of equal parts of a sample: `safety` times their mean
    plus `DEVIATIONS` standard errors of the mean."""
    values = np.asarray(errors, np.float64)
    deviation = float(values.std() / max(len(values) - 1, 1) ** 0.5)
    return min(safety * float(values.mean()) + DEVIATIONS * deviation, 1.0)


Setting = TypeVar("Setting")


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice(Generic[Setting]):
    """The setting that a budget chose, and warnings about limits that it is expected to break."""

    setting: Setting
    estimate: Estimate
    notes: tuple[str, ...] = ()


def choose(settings: Sequence[Setting], measure: Callable[[Setting], Estimate], budget: Budget) -> Choice[Setting]:
    """The cheapest setting that keeps a limit of error; without one, the most exact that keeps seconds and megabytes.

    Settings are found by bisection, so that few are measured, and a looser limit never takes a dearer setting.

    Args:
        settings: cheapest first, the exact one last, which keeps any error.

    Raises:
        InputError: not even the first setting keeps the limit of megabytes, and no error is limited.
    """
    estimates = cache(lambda number: measure(settings[number]))
    first, last = 0, len(settings) - 1
    notes: list[str] = []
    if "error" in budget.limits:
        while first < last:
            middle = (first + last) // 2
            first, last = (first, middle) if estimates(middle).bound <= budget.limit("error") else (middle + 1, last)
        for name in budget.limits[1:]:
            if (needed := getattr(estimates(first), name)) > budget.limit(name):
                notes.append(budget.conflict(name, needed))
        return Choice(setting=settings[first], estimate=estimates(first), notes=tuple(notes))
    shares = {"seconds": PLANNED, "megabytes": 1.0}

    def keeps(number: int) -> bool:
        return not any(getattr(estimates(number), name) > shares[name] * budget.limit(name) for name in budget.limits)

    while first < last:
        middle = (first + last + 1) // 2
        first, last = (middle, last) if keeps(middle) else (first, middle - 1)
    estimate = estimates(first)
    if "megabytes" in budget.limits and estimate.megabytes > budget.limit("megabytes"):
        raise budget.too_small(estimate.megabytes)
    if "seconds" in budget.limits and estimate.seconds > budget.limit("seconds"):
        notes.append(
            f"{budget.option('seconds')}: the fastest setting takes about {estimate.seconds:.3g} s; it is used"
        )
    return Choice(setting=settings[first], estimate=estimate, notes=tuple(notes))
