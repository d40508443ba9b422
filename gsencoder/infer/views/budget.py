"""A budget of seconds for the choice of views: it is chosen from as many candidates as there is time to judge."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

from gsencoder.core.errors import InputError
from gsencoder.core.promises import PLANNED, Budget, check_governed
from gsencoder.infer.views.choose import Judged, checked_gaussians, chosen_views, judge_candidates
from gsencoder.infer.views.free_space import FreeSpace
from gsencoder.infer.views.selection import ViewsConfig, ViewSet
from gsencoder.infer.views.targets import Target
from gsencoder.types import Scene

GOVERNED = ("candidates",)
"""The options of the choice that a budget sets."""
CANDIDATES = (8, 12, 16, 24, 32, 48, 64)
"""Numbers that are chosen among; the last is that of preset=exact. The first is judged in any case, and timed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewsBudget(Budget):
    """What a choice of views may cost."""

    seconds: float | None = field(
        default=None,
        metadata={"help": "largest time of choosing views; localization and the pictures come on top of it"},
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BudgetViews:
    """Views that were chosen within a budget.

    Attributes:
        views: these.
        candidates: among how many; fewer than there was time for where the scene has no more.
        predicted: seconds.
        seconds: from the beginning to the choice.
        notes: for the user, about a promise that is not kept.
    """

    views: ViewSet
    candidates: int
    predicted: float
    seconds: float
    notes: tuple[str, ...]


def check_views_budget(budget: ViewsBudget, config: ViewsConfig) -> None:
    """Refuses what a budget cannot be combined with.

    Raises:
        InputError: `GOVERNED` options are set, or views are not chosen from candidates.
    """
    check_governed(budget, config, ViewsConfig(), GOVERNED, "choose")
    if budget.promised and config.method != "greedy":
        raise InputError(
            f"choose.method={config.method}: {budget.names} is for method=greedy, which judges candidates; leave one "
            "of the two out"
        )


def choose_views_within(
    scene: Scene,
    targets: Sequence[Target],
    config: ViewsConfig,
    budget: ViewsBudget,
    *,
    clock: Callable[[], float] = time.perf_counter,
) -> BudgetViews:
    """The views that show targets best, of as many candidates as can be judged in time.

    Args:
        scene: see `choose_views`.
        targets: see `choose_views`.
        config: options that the budget does not choose.
        budget: of seconds.
        clock: seconds.

    Raises:
        InputError: no budget, or what `choose_views` refuses.
    """
    check_views_budget(budget, config)
    if budget.seconds is None:
        raise InputError("budget: expected budget.seconds=, got none")
    start = clock()
    gaussians = checked_gaussians(scene, targets, config)
    free = FreeSpace(gaussians)
    numbers = sorted({max(number, config.count, len(targets)) for number in CANDIDATES})

    def judged(number: int) -> Judged:
        return judge_candidates(scene, gaussians, targets, free, replace(config, candidates=number))

    begun = clock()
    judgment, number = judged(numbers[0]), numbers[0]
    seconds_each = (clock() - begun) / number
    spent = predicted = clock() - start
    notes: tuple[str, ...] = ()
    # Placing candidates takes some of that time whatever their number, so that this is on the safe side.
    fitting = [more for more in numbers[1:] if spent + more * seconds_each <= PLANNED * budget.seconds]
    if fitting:
        number = fitting[-1]
        predicted, judgment = spent + number * seconds_each, judged(number)
    elif spent > budget.seconds:
        notes = (f"{budget.shown('seconds')}: judging {number} candidates took {spent:.3g} s; they are used",)
    views = chosen_views(scene, targets, judgment, free, config)
    return BudgetViews(views=views, candidates=views.judged, predicted=predicted, seconds=clock() - start, notes=notes)
