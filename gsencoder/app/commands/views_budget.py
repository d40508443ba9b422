"""The budgets of `views`: what was promised, and what became of it, for people and for the summary."""

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

from gsencoder.app.runs.promises import report_choice, report_promises
from gsencoder.app.runs.summary import Summary
from gsencoder.core.settings import MEGABYTE
from gsencoder.infer.draw import Picture
from gsencoder.infer.views.budget import BudgetViews, ViewsBudget, choose_views_within, pictures_within
from gsencoder.infer.views.targets import Target, ViewsConfig, ViewSet
from gsencoder.types import Scene


@runtime_checkable
class BudgetOptions(Protocol):
    """The options of a command that chooses views within a budget."""

    @property
    def choose(self) -> ViewsConfig: ...
    @property
    def budget(self) -> ViewsBudget: ...
    @property
    def quiet(self) -> bool: ...


def choose_in_budget(
    scene: Scene, targets: Sequence[Target], config: BudgetOptions, summary: Summary
) -> tuple[BudgetViews, ViewSet, list[Picture]]:
    """Chooses views and the sizes of their pictures; says which they are, and what is predicted of them.

    Returns:
        The choice, the views that are shown of it, and their pictures; none where no megabytes are promised.
    """
    budget = config.budget
    with summary.step("choose"):
        choice = choose_views_within(scene, targets, config.choose, budget)
    views, pictures = choice.views, list[Picture]()
    knobs, predicted, notes = dict(choice.knobs), dict(choice.predicted), choice.notes
    if budget.megabytes is not None:
        with summary.step("render"):
            sized = pictures_within(scene, views, budget)
        views, pictures = sized.views, sized.pictures
        predicted["megabytes"] = sized.predicted
        knobs |= {"count": len(views), "side": sized.side}
        notes += sized.notes
    report_choice(summary, scene.name, knobs, predicted=predicted, notes=notes, quiet=config.quiet)
    return choice, views, pictures


def check_promises(
    choice: BudgetViews,
    scene: Scene,
    targets: Sequence[Target],
    views: ViewSet,
    files: Sequence[Path],
    config: BudgetOptions,
    summary: Summary,
) -> list[str]:
    """Measures what was promised; returns a line for each promise, and warns of those that are broken.

    Args:
        choice: of `choose_in_budget`.
        scene: in which it was made.
        targets: for which it was made.
        views: that are shown.
        files: their pictures.
        config: with the promises.
        summary: of the run.
    """
    budget, realised = config.budget, dict[str, float]()
    if budget.error is not None and budget.check:
        with summary.step("check"):
            side = int(max(views.cameras.widths.max(), views.cameras.heights.max()))
            realised["error"] = choice.realised_error(scene, targets, largest_side=side)
    if budget.seconds is not None:
        realised["seconds"] = choice.seconds
    if budget.megabytes is not None:
        realised["megabytes"] = sum(file.stat().st_size for file in files) / MEGABYTE
    return report_promises(summary, budget, realised)
