"""Reconstruction: posed photographs to Gaussians by seeding, optimization and pruning (SplatDistill, sec. 3.1)."""

import os
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cache
from math import inf
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32

from gsencoder.core.device import choose_device
from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.process import Clock, Device, Track, untracked
from gsencoder.data.photographs import Photographs
from gsencoder.reconstruct.anchor import anchor_at
from gsencoder.reconstruct.budget import steps_for_minutes
from gsencoder.reconstruct.checkpoint import CHECKPOINT_FILE, State, load_state, save_state
from gsencoder.reconstruct.config import ReconstructConfig, Report
from gsencoder.reconstruct.expected_time import Costs, Pace, measured_costs
from gsencoder.reconstruct.exposure_prediction import predict_exposures
from gsencoder.reconstruct.fit import fit
from gsencoder.reconstruct.optimize import Optimizer
from gsencoder.reconstruct.parameters import parameters_from
from gsencoder.reconstruct.plan import AIMED, PLAN, STEPS, Plan, follow, late_notes, make_plan, refuse_late
from gsencoder.reconstruct.report import MAX_COMPARISONS, Comparison, LogRow, compare, describe_exposure, describe_plan
from gsencoder.reconstruct.row_adam import RowAdam
from gsencoder.reconstruct.score import MIN_PHOTOGRAPHS, drop_masked_views, split
from gsencoder.reconstruct.start import initial_gaussians
from gsencoder.types import Gaussians, Scene

TRIAL_SHARE = 1 / 30
"""Of promised seconds that are left, what goes into trials of each kind of work."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Reconstruction:
    """A splat that was fitted to photographs, and how well it predicts those that were held out.

    Attributes:
        gaussians: relative to the scene's origin.
        seeding: number and source of the seeds, and what was added to structure-from-motion points, as JSON values.
        steps: optimization steps that were done.
        training: row numbers of the views that were fitted.
        held_out: row numbers of the views that were not.
        log: one row a validation, oldest first; empty without held-out views.
        comparisons: up to four held-out photographs beside renders of them.
        exposure: brightness of each fitted photograph, relative to their mean, from the affine maps of colors; None
            where photographs are fitted as they are.
        exposure_source: what those of held-out photographs were predicted from, see `ExposurePrediction`.
        held_out_colors: color maps to which held-out photographs are expected to be exposed, in their order; identities
            where `exposure` is None.
        seconds: wall-clock time by step of the stage.
        plan: that was followed.
        elapsed: seconds from the first reading to the Gaussians and pictures, of all runs that it took.
    """

    gaussians: Gaussians
    seeding: Mapping[str, Any]
    steps: int
    training: tuple[int, ...]
    held_out: tuple[int, ...]
    log: tuple[LogRow, ...]
    comparisons: tuple[Comparison, ...]
    exposure: tuple[float, ...] | None
    exposure_source: str | None
    held_out_colors: Float32[np.ndarray, "Q 3 4"]
    seconds: Mapping[str, float]
    plan: Plan
    elapsed: float


def reconstruct(
    scene: Scene,
    config: ReconstructConfig = ReconstructConfig(),
    *,
    device: Device = "auto",
    work: Path | None = None,
    made_from: Mapping[str, Any] = {},
    spent: float = 0.0,
    may_shrink: bool = False,
    now: Callable[[], float] = time.monotonic,
    track: Track = untracked,
    report: Report = lambda line: None,  # noqa: ARG005
) -> Reconstruction:
    """Fits Gaussians to the photographs of a scene.

    The Gaussians are the scene's own splat, or seeds from its depth, mesh or structure-from-motion points. They are
    moved, recolored and pruned, and never split, so every surface has to be seeded at the start.

    Args:
        scene: with photographs and poses; depth and masks are used where it has them.
        config: settings.
        device: where to compute; on CUDA gsplat renders.
        work: an existing folder for the checkpoint and the log. A run that was interrupted is continued from the
            checkpoint in it, with the same result; None = a temporary folder.
        made_from: what else a run must share with the run that it continues, as JSON values, such as the path and the
            reading options of the scene.
        spent: seconds that reading the scene took, which count to a promise of seconds.
        may_shrink: whether the caller begins anew with smaller photographs where promised seconds ask for it.
        now: the clock.
        track: progress of long loops.
        report: receives a line after seeding and after each validation.

    Raises:
        InputError: no photographs, too few of them, nothing to seed from, no Gaussian in view, a loss or gradient that
            is not finite, a promise that cannot be kept, or a checkpoint of another run.
        PhotographsTooLargeError: only with `may_shrink`.

    Warns:
        SceneWarning: photographs that are masked all over, or plane sweeps that found no surface.
    """
    if scene.views is None:
        raise InputError(f"reconstruct: scene {scene.name} has no photographs to fit a splat to")
    clock, first = Clock(), now() - spent

    def elapsed() -> float:
        return now() - first

    def in_time(items: Iterable[Any], label: str) -> Iterator[Any]:
        for item in track(items, label):
            if not continued:
                refuse_late(config.budget, elapsed(), "reading photographs and seeding")
            yield item

    with ExitStack() as stack:
        folder = work or Path(stack.enter_context(TemporaryDirectory()))
        continued = os.path.lexists(checkpoint := folder / CHECKPOINT_FILE)
        with clock("read"):
            photographs = Photographs(scene.views, track=in_time)
        training, held_out = split(len(photographs), config.holdout)
        training = drop_masked_views(photographs, training, "photographs to fit", least=MIN_PHOTOGRAPHS)
        held_out = drop_masked_views(photographs, held_out, "held-out photographs")
        identity = {**made_from, **config.identity(), "photographs": photographs.digest()}
        chosen_device = choose_device(device)
        if config.budget.error is not None and not held_out:
            raise InputError("budget.error: is measured on held-out photographs, and there are none; leave it out")
        if continued:
            most = max(config.optimize.steps, steps_for_minutes(config.budget.minutes, config.optimize), STEPS[-1])
            shape = {"steps": most, "sh_degree": config.optimize.sh_degree}
            state = load_state(checkpoint, identity, **shape, device=chosen_device)
        else:
            with clock("seeds"):
                state = initial_state(scene, photographs, training, config, chosen_device, in_time, report)
        optimizer = Optimizer(
            state.adam,
            photographs,
            training,
            config.optimize,
            prune=config.prune,
            raster=config.raster,
            anchor=state.anchor,
            exposures=state.exposures,
            step=state.step,
        )

        def validations(steps: int) -> int:
            return sum(config.validates_at(step, steps) for step in range(optimizer.step, steps + 1))

        @cache
        def costs() -> Costs:
            limit = config.budget.clock
            return measured_costs(optimizer, held_out, inf if limit is None else (limit - elapsed()) * TRIAL_SHARE)

        with clock("trial"):
            if continued:
                plan = Plan.of(state.facts, steps=config.optimize.steps, sh_degree=config.optimize.sh_degree)
            else:
                plan = make_plan(
                    optimizer,
                    config.budget,
                    costs,
                    validations,
                    double_means=bool(scene.origin.any()),
                    spent=elapsed,
                    may_shrink=may_shrink,
                )
            follow(optimizer, plan)
            saved_from = now()
            if not continued:
                state = replace(state, adam=optimizer.adam)
                save_state(checkpoint, replace(state, facts={**state.facts, **plan.facts()}), identity)
            saving = now() - saved_from
            left = optimizer.step, plan.steps, validations(plan.steps)
            seconds = sum(costs().expected(optimizer.config, config.prune, *left))
            report(describe_plan(optimizer, config.optimize.steps, seconds, config.budget.option_of_steps, STEPS[-1]))
            for note in (*plan.notes, *late_notes(config.budget, elapsed() + seconds)):
                report(note)
        if continued:
            # What is repeated does not count.
            first = now() - plan.spent - state.seconds
        pace = None
        if (limit := config.budget.clock) is not None:
            # The last checkpoint and the splat, and pictures beside it.
            pace = Pace(costs(), AIMED * limit - 2 * saving - MAX_COMPARISONS * costs().picture, elapsed)
        with clock("optimise"):
            fitted = fit(optimizer, state, plan, held_out, config, folder, identity, track, report, pace=pace, now=now)
        exposure = differing = source = None
        predicted = predict_exposures(optimizer.exposures, photographs.cameras, held_out)
        if optimizer.exposures is not None:
            exposure, source = tuple(optimizer.exposures.brightness().tolist()), predicted.source
            differing = describe_exposure(min(exposure), max(exposure), source)
        if differing is not None:
            report(differing)
        comparisons = compare(optimizer, held_out, matched=differing is not None and source == "mean")
        return Reconstruction(
            gaussians=optimizer.gaussians(),
            seeding={name: value for name, value in {**state.facts, **fitted.plan.facts()}.items() if name != PLAN},
            steps=optimizer.step,
            training=optimizer.training,
            held_out=tuple(held_out),
            log=tuple(fitted.rows),
            comparisons=comparisons,
            exposure=exposure,
            exposure_source=source,
            held_out_colors=predicted.maps.numpy(),
            seconds=clock.seconds,
            plan=fitted.plan,
            elapsed=elapsed(),
        )


def initial_state(
    scene: Scene,
    photographs: Photographs,
    training: Sequence[int],
    config: ReconstructConfig,
    device: torch.device,
    track: Track,
    report: Report,
) -> State:
    """The state before the first step: seeds as parameters, and how they came about."""
    start = initial_gaussians(scene, photographs, training, config.seeds, config.dense, track=track)
    seeding: dict[str, Any] = {"seeds": len(start.gaussians), "source": start.source}
    if start.dense is not None:
        dense = start.dense
        seeding |= {"swept": dense.swept, "filled": dense.filled, "coverage": list(dense.coverage)}
        if start.triangulated is not None:
            seeding["triangulated"] = start.triangulated
            report(f"the scene has no points; {start.triangulated:,} were triangulated from matches, poses held")
        report(
            f"points reach {dense.coverage[0]:.0%} of the pictures' cells: {dense.swept:,} were added from plane "
            f"sweeps and {dense.filled:,} between them, which reach {dense.coverage[1]:.0%}"
        )
        if not dense.swept:
            warnings.warn(
                f"plane sweeps found no surface, and points reach {dense.coverage[0]:.0%} of the pictures alone; what "
                "they leave bare stays empty: a smaller dense.spacing or dense.samples may find more",
                SceneWarning,
                stacklevel=3,
            )
    adam = RowAdam(parameters_from(start.gaussians, config.optimize.sh_degree, device))
    anchor = anchor_at(adam.parameters, config.optimize.leash) if start.measured and config.optimize.leash else None
    return State(adam=adam, anchor=anchor, step=0, seconds=0.0, facts=seeding)
