"""The budgets of `fuse`: what was promised, and what became of it, for people and for the summary."""

from collections.abc import Mapping
from pathlib import Path
from typing import Protocol, runtime_checkable

from gsencoder.app.runs.progress import Progress
from gsencoder.app.runs.promises import report_choice, report_promises
from gsencoder.app.runs.summary import Summary
from gsencoder.core.process import Device
from gsencoder.core.settings import MEGABYTE
from gsencoder.fusion.budget import BudgetFusion, fuse_within, realised_error
from gsencoder.fusion.cost_model import BudgetConfig
from gsencoder.fusion.fuse import FuseConfig
from gsencoder.teachers.base import Teacher
from gsencoder.types import Scene


@runtime_checkable
class BudgetOptions(Protocol):
    """The options of a command that fuses within a budget."""

    @property
    def fusion(self) -> FuseConfig: ...
    @property
    def budget(self) -> BudgetConfig: ...
    @property
    def device(self) -> Device: ...
    @property
    def quiet(self) -> bool: ...


def fuse_in_budget(
    scene: Scene, teacher: Teacher, config: BudgetOptions, summary: Summary, work: Path, *, sample_cells: bool
) -> BudgetFusion:
    """Chooses a setting and fuses; says which setting that is, and what is predicted of it."""
    fused = fuse_within(
        scene,
        teacher,
        config.fusion,
        config.budget,
        work=None if teacher.cheap else work,
        sample_cells=sample_cells,
        device=config.device,
        track=Progress(quiet=config.quiet),
    )
    choice = fused.choice
    summary.add_seconds({"choose": fused.choosing, **fused.fusion.seconds})
    report_choice(
        summary,
        scene.name,
        choice.knobs,
        predicted=_predicted(fused),
        notes=choice.notes,
        quiet=config.quiet,
        of=f", of {len(fused.scene.views or ())} views",
        of_views=len(scene.views) if scene.views is not None else 0,
        scatter=choice.scatter,
        rays_followed=choice.followed,
        rays_exact=choice.all_rays,
    )
    return fused


def _predicted(fused: BudgetFusion) -> Mapping[str, float | None]:
    choice = fused.choice
    size = None if choice.bytes is None else choice.bytes / MEGABYTE
    return {
        "error": choice.predicted.error,
        "error_deviation": choice.predicted.deviation,
        "seconds": choice.seconds,
        "megabytes": size,
    }


def check_promises(fused: BudgetFusion, file: Path, config: BudgetOptions, summary: Summary) -> list[str]:
    """Measures what was promised; returns a line for each promise, and warns of those that are broken."""
    budget, realised = config.budget, dict[str, float]()
    if budget.error is not None and budget.check:
        with summary.step("check"):
            track = Progress(quiet=config.quiet)
            error = realised_error(fused, config.fusion, seed=budget.seed, device=config.device, track=track)
        realised["error"] = error.total
        summary.results["budget"]["covered"] = error.covered
    if budget.seconds is not None:
        realised["seconds"] = fused.seconds
    if budget.megabytes is not None:
        realised["megabytes"] = file.stat().st_size / MEGABYTE
    return report_promises(summary, budget, realised)
