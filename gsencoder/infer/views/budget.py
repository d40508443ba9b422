"""Budgets of the choice of views: the fewest views that leave little unseen, of as many candidates as there is time to
judge. What a budget of megabytes chooses is in `gsencoder.infer.views.picture_size`."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from gsencoder.core.errors import InputError
from gsencoder.core.settings import PLANNED, Budget, check_governed
from gsencoder.infer.views.choose import Judged, Picked, checked_gaussians, chosen_views, judge_candidates
from gsencoder.infer.views.free_space import FreeSpace
from gsencoder.infer.views.selection import ViewsConfig, ViewSet
from gsencoder.infer.views.shown_error import fewest_views, measured_errors
from gsencoder.infer.views.targets import Target
from gsencoder.render import BlendConfig
from gsencoder.types import Cameras, Scene

GOVERNED: Mapping[str, tuple[str, ...]] = {
    "error": ("count",),
    "seconds": ("candidates",),
    "megabytes": ("width", "height", "frame_side"),
}
"""The options of the choice that each promise sets. Beside a promised error, seconds set nothing: it is one about what
`choose.candidates` show, which are all judged."""
CANDIDATES = (8, 12, 16, 24, 32, 48, 64)
"""Numbers that are chosen among; the last is that of preset=exact. The first is judged in any case, and timed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewsBudget(Budget):
    """What a choice of views may cost, or must show. Where they conflict, the one that stands first here wins."""

    error: float | None = field(
        default=None,
        metadata={
            "help": "largest share that the chosen views leave unseen of what all candidates show, mean over targets; "
            "a Gaussian counts as far as it is shown as well as by the candidate that shows it best; the fewest views "
            "are taken"
        },
    )
    seconds: float | None = field(
        default=None,
        metadata={"help": "largest time of choosing views; localization and the pictures come on top of it"},
    )
    megabytes: float | None = field(
        default=None,
        metadata={
            "help": "largest size of the pictures of the views (view_00.png, view_01.png, …, without sheet.png), in "
            "units of 1,000,000 bytes; they are made smaller, and at last fewer"
        },
    )
    check: bool = field(
        default=True,
        metadata={
            "help": "measure the error afterwards, which renders the targets for all candidates; false = leave it "
            "unmeasured"
        },
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BudgetViews:
    """Views that were chosen within a budget.

    Attributes:
        views: these.
        picked: which of the candidates they are, with a budget of error.
        cameras: of all candidates, which may be fewer than there was time for where the scene has no more.
        knobs: values that were chosen, by name.
        predicted: by promise.
        seconds: from the beginning to the choice.
        notes: for the user, about a promise that is not kept.
    """

    views: ViewSet
    picked: Picked | None
    cameras: Cameras
    knobs: Mapping[str, int]
    predicted: Mapping[str, float]
    seconds: float
    notes: tuple[str, ...]

    def realised_error(self, scene: Scene, targets: Sequence[Target], *, largest_side: int) -> float:
        """The error of the chosen views at the size of their pictures, over all Gaussians of the targets.

        Args:
            scene: in which they were chosen.
            targets: that they were chosen for.
            largest_side: of the pictures that are shown, pixels; candidates are compared in no larger ones.
        """
        assert scene.gaussians is not None
        assert self.picked is not None
        config = BlendConfig()
        (error,) = measured_errors(
            scene.gaussians,
            targets,
            self.cameras.resized(largest_side, enlarge=False),
            [self.picked.order],
            config=replace(config, near=min(config.near, self.views.near)),
        )
        return error


def check_views_budget(budget: ViewsBudget, config: ViewsConfig) -> None:
    """Refuses what a budget cannot be combined with.

    Raises:
        InputError: `GOVERNED` options are set, or views are not chosen from candidates.
    """
    for name in budget.promised:
        if name != "seconds" or budget.error is None:
            check_governed(budget, config, ViewsConfig(), GOVERNED[name], "choose")
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
    """The views that show targets best, of as many candidates as can be judged in time; or the fewest that keep an
    error.

    Args:
        scene: see `choose_views`.
        targets: see `choose_views`.
        config: options that the budget does not choose.
        budget: at least one promise; one of megabytes chooses nothing here.
        clock: seconds.

    Raises:
        InputError: no budget, or what `choose_views` refuses.
    """
    check_views_budget(budget, config)
    if not budget.promised:
        raise InputError("budget: expected budget.error=, budget.seconds= or budget.megabytes=, got none of them")
    start = clock()
    gaussians = checked_gaussians(scene, targets, config)
    free = FreeSpace(gaussians)
    predicted: dict[str, float] = {}
    knobs: dict[str, int] = {}
    notes: tuple[str, ...] = ()

    def judged(number: int) -> Judged:
        return judge_candidates(scene, gaussians, targets, free, replace(config, candidates=number))

    if budget.seconds is None or budget.error is not None:
        judgment = judged(config.candidates)
    else:
        numbers = sorted({max(number, config.count, len(targets)) for number in CANDIDATES})
        begun = clock()
        judgment, number = judged(numbers[0]), numbers[0]
        seconds_each = (clock() - begun) / number
        spent = predicted["seconds"] = clock() - start
        # Placing candidates takes some of that time whatever their number, so that this is on the safe side.
        fitting = [more for more in numbers[1:] if spent + more * seconds_each <= PLANNED * budget.seconds]
        if fitting:
            number = fitting[-1]
            predicted["seconds"], judgment = spent + number * seconds_each, judged(number)
        elif spent > budget.seconds:
            notes = (f"{budget.shown('seconds')}: judging {number} candidates took {spent:.3g} s; they are used",)
    cameras = judgment.candidates.cameras
    picked = None
    if budget.error is not None:
        picked, predicted["error"] = fewest_views(judgment.scores, budget.error)
        knobs["count"] = len(picked.order)
    elif budget.seconds is not None:
        knobs["candidates"] = len(cameras)
    views = chosen_views(scene, targets, judgment, free, config, picked=picked)
    seconds = clock() - start
    if budget.error is not None and budget.seconds is not None and seconds > budget.seconds:
        notes = (budget.conflict("error", "seconds", seconds),)
    return BudgetViews(
        views=views, picked=picked, cameras=cameras, knobs=knobs, predicted=predicted, seconds=seconds, notes=notes
    )
