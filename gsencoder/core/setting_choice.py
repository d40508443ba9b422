"""The choice of a setting by the promises of a budget, among settings whose errors and costs are predicted."""

from collections.abc import Callable, Sequence
from typing import Protocol, TypeVar, runtime_checkable

from gsencoder.core.promises import PLANNED, Budget


@runtime_checkable
class PredictedSetting(Protocol):
    """A setting with what is predicted of it.

    Attributes:
        error: predicted.
        bound: what the error stays below in all likelihood.
        cost: in units that all settings of a choice share.
    """

    @property
    def error(self) -> float: ...

    @property
    def bound(self) -> float: ...

    @property
    def cost(self) -> float: ...


Setting = TypeVar("Setting", bound=PredictedSetting)


def best_setting(settings: Sequence[Setting], error: float | None = None) -> Setting:
    """The cheapest setting that keeps a promised error, of equal ones the most exact; where no error is promised, the
    most exact setting, of equal ones the cheapest."""
    if error is None:
        return min(settings, key=lambda setting: (setting.error, setting.cost))
    return min(
        (setting for setting in settings if setting.bound <= error), key=lambda setting: (setting.cost, setting.error)
    )


def within_seconds(
    settings: Sequence[Setting], best: Setting, budget: Budget, seconds: Callable[[Setting], float]
) -> tuple[Setting, tuple[str, ...]]:
    """The best setting that keeps promised seconds; the fastest where none does. A promised error comes first.

    Args:
        settings: to choose among.
        best: `best_setting` of them.
        budget: that promises seconds.
        seconds: that a setting takes, from the beginning of the choice.

    Returns:
        The setting, and notes about a promise that is not kept.
    """
    limit = budget.promise("seconds")
    if "error" in budget.promised:
        needed = seconds(best)
        return best, (budget.conflict("error", "seconds", needed),) if needed > limit else ()
    fast_enough = [setting for setting in settings if seconds(setting) <= PLANNED * limit]
    if fast_enough:
        return best_setting(fast_enough), ()
    fastest = min(settings, key=lambda setting: (seconds(setting), setting.error))
    return fastest, (
        f"{budget.shown('seconds')}: the fastest setting takes about {seconds(fastest):.3g} s; it is used",
    )
