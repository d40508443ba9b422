"""Reconstruction: posed photographs to Gaussians by seeding, optimization and pruning (SplatDistill, sec. 3.1)."""

import os
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32

from gsencoder.core.errors import InputError, SceneWarning, advised
from gsencoder.core.files.json_values import plain
from gsencoder.core.files.step_log import LOG_FILE, Log, read_log
from gsencoder.core.runtime.clock import Clock
from gsencoder.core.runtime.device import choose_device
from gsencoder.core.runtime.device_names import Device
from gsencoder.core.runtime.tracking import Track, untracked
from gsencoder.data.photographs import Photographs
from gsencoder.data.seeding.dense import DenseConfig
from gsencoder.data.seeding.seed import SeedConfig
from gsencoder.reconstruct.anchor import anchor_at
from gsencoder.reconstruct.budget import BudgetConfig, plan_steps, steps_for_minutes
from gsencoder.reconstruct.checkpoint import CHECKPOINT_FILE, State, load_state, save_state
from gsencoder.reconstruct.expected_time import expected_seconds
from gsencoder.reconstruct.exposure_prediction import predict_exposures
from gsencoder.reconstruct.optimize import Optimizer
from gsencoder.reconstruct.optimize_config import OptimizeConfig
from gsencoder.reconstruct.parameters import parameters_from
from gsencoder.reconstruct.prune import PruneConfig
from gsencoder.reconstruct.report import Comparison, LogRow, compare, describe, describe_exposure, describe_plan
from gsencoder.reconstruct.row_adam import RowAdam
from gsencoder.reconstruct.score import MIN_PHOTOGRAPHS, covisible_pixels, drop_masked_views, score, split
from gsencoder.reconstruct.start import initial_gaussians
from gsencoder.render.rasterize import RasterConfig
from gsencoder.types import Gaussians, Scene

START_AGAIN = "give resume=false to begin anew"
Report = Callable[[str], None]
"""Receives one line of text for people."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReconstructConfig:
    """How photographs become Gaussians, and how the result is judged."""

    holdout: int = field(default=8, metadata={"help": "hold out every n-th photograph for validation; 0 = none"})
    validate_every: int = field(default=500, metadata={"help": "steps between validations; 0 = at the end alone"})
    checkpoint_every: float = field(default=60.0, metadata={"help": "seconds between checkpoints"})
    seeds: SeedConfig = field(default_factory=SeedConfig)
    dense: DenseConfig = field(default_factory=DenseConfig)
    optimize: OptimizeConfig = field(default_factory=OptimizeConfig)
    budget: BudgetConfig = field(default_factory=BudgetConfig)
    prune: PruneConfig = field(default_factory=PruneConfig)
    raster: RasterConfig = field(default_factory=RasterConfig)

    def __post_init__(self) -> None:
        if self.holdout < 0 or self.holdout == 1:
            raise InputError(f"holdout: expected 0 (none) or 2 and more, got {self.holdout}")
        for name in ("validate_every", "checkpoint_every"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise InputError(f"{name}: expected 0 or more, got {getattr(self, name)}")

    def validates_at(self, step: int, steps: int) -> bool:
        """Whether is validated after `step` of `steps`."""
        return step in (0, steps) or bool(self.validate_every and step % self.validate_every == 0)

    def identity(self) -> dict[str, Any]:
        """The settings that an interrupted run must share with the run that continues it, as JSON values."""
        names = ("seeds", "dense", "optimize", "budget", "prune", "raster", "holdout")
        return {name: plain(getattr(self, name)) for name in names}


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


def reconstruct(
    scene: Scene,
    config: ReconstructConfig = ReconstructConfig(),
    *,
    device: Device = "auto",
    work: Path | None = None,
    made_from: Mapping[str, Any] = {},
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
        track: progress of long loops.
        report: receives a line after seeding and after each validation.

    Raises:
        InputError: no photographs, too few of them, nothing to seed from, no Gaussian in view, a loss or gradient that
            is not finite, or a checkpoint of another run.

    Warns:
        SceneWarning: photographs that are masked all over, or plane sweeps that found no surface.
    """
    if scene.views is None:
        raise InputError(f"reconstruct: scene {scene.name} has no photographs to fit a splat to")
    clock = Clock()
    with ExitStack() as stack:
        folder = work or Path(stack.enter_context(TemporaryDirectory()))
        with clock("read"):
            photographs = Photographs(scene.views, track=track)
        training, held_out = split(len(photographs), config.holdout)
        training = drop_masked_views(photographs, training, "photographs to fit", least=MIN_PHOTOGRAPHS)
        held_out = drop_masked_views(photographs, held_out, "held-out photographs")
        identity = {**made_from, **config.identity(), "photographs": photographs.digest()}
        chosen_device, checkpoint = choose_device(device), folder / CHECKPOINT_FILE
        if continued := os.path.lexists(checkpoint):
            most = max(config.optimize.steps, steps_for_minutes(config.budget.minutes, config.optimize))
            shape = {"steps": most, "sh_degree": config.optimize.sh_degree}
            state = load_state(checkpoint, identity, **shape, device=chosen_device)
        else:
            with clock("seeds"):
                state = initial_state(scene, photographs, training, config, chosen_device, track, report)
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
        if not continued:
            state = replace(state, facts={**state.facts, "steps_planned": plan_steps(optimizer, config.budget)})
            save_state(checkpoint, state, identity)
        steps = int(state.facts.get("steps_planned", config.optimize.steps))
        optimizer.config = replace(config.optimize, steps=steps)
        with clock("trial"):
            validations = sum(config.validates_at(step, steps) for step in range(optimizer.step, steps + 1))
            seconds = expected_seconds(optimizer, held_out, validations)
            report(describe_plan(optimizer, config.optimize.steps, seconds))
        with clock("optimise"):
            config = replace(config, optimize=optimizer.config)
            log = optimize(optimizer, state, held_out, config, folder, identity, track, report)
        exposure = differing = source = None
        predicted = predict_exposures(optimizer.exposures, photographs.cameras, held_out)
        if optimizer.exposures is not None:
            exposure, source = tuple(optimizer.exposures.brightness().tolist()), predicted.source
            differing = describe_exposure(min(exposure), max(exposure), source)
        if differing is not None:
            report(differing)
        return Reconstruction(
            gaussians=optimizer.gaussians(),
            seeding=state.facts,
            steps=optimizer.step,
            training=optimizer.training,
            held_out=tuple(held_out),
            log=tuple(log),
            comparisons=compare(optimizer, held_out, matched=differing is not None and source == "mean"),
            exposure=exposure,
            exposure_source=source,
            held_out_colors=predicted.maps.numpy(),
            seconds=clock.seconds,
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


def optimize(
    optimizer: Optimizer,
    state: State,
    held_out: Sequence[int],
    config: ReconstructConfig,
    work: Path,
    identity: Mapping[str, Any],
    track: Track,
    report: Report,
) -> list[LogRow]:
    """All remaining steps; the rows of the log. Whatever stops the run between two steps leaves a checkpoint."""
    steps = config.optimize.steps
    with advised(START_AGAIN):
        log = Log(work, done=optimizer.step, events=False, begun=bool(held_out and optimizer.step))
        rows = read_rows(work / LOG_FILE)
    seen = covisible_pixels(optimizer.photographs, held_out, optimizer.training)
    start, saved_at, saved_step = time.monotonic() - state.seconds, time.monotonic(), optimizer.step

    def validate() -> None:
        due = config.validates_at(optimizer.step, steps)
        # A continued run may begin at a step whose validation was cut off, or whose row is in the log already.
        if not held_out or not due or (rows and rows[-1]["step"] == optimizer.step):
            return
        scores = {
            name: value for name, value in score(optimizer, held_out, seen)._asdict().items() if value is not None
        }
        row: LogRow = {"seconds": time.monotonic() - start, "gaussians": len(optimizer.parameters["means"]), **scores}
        log.add(optimizer.step, row)
        rows.append({"step": optimizer.step, **row})
        report(
            f"step {optimizer.step} of {steps}: {describe(row)}, {row['gaussians']:,} Gaussians, {row['seconds']:.0f} s"
        )

    def save() -> None:
        now = State(
            adam=optimizer.adam,
            anchor=optimizer.anchor,
            exposures=None if optimizer.exposures is None else optimizer.exposures.maps,
            step=optimizer.step,
            seconds=time.monotonic() - start,
            facts=state.facts,
        )
        save_state(work / CHECKPOINT_FILE, now, identity)

    try:
        validate()
        for _ in track(range(optimizer.step, steps), "optimising"):
            optimizer.advance()
            validate()
            if time.monotonic() - saved_at >= config.checkpoint_every:
                save()
                saved_at, saved_step = time.monotonic(), optimizer.step
    finally:
        # Also after the last step: writing the results may be interrupted as well.
        if optimizer.is_consistent and optimizer.step > saved_step:
            save()
    return rows


def read_rows(path: Path) -> list[LogRow]:
    """The rows of a log as numbers.

    Raises:
        InputError: a cell that is not a number.
    """
    try:
        return [{name: float(cell) for name, cell in row.items()} for row in read_log(path)]
    except ValueError as error:
        raise InputError(f"{path}: damaged: {error}") from error
