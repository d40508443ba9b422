"""Reconstruction: posed photographs to Gaussians by seeding, optimization and pruning (SplatDistill, section 3.1)."""

import math
import os
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from gsencoder.core.archive import open_archive, write_archive
from gsencoder.core.budget import reject_options_set_by_budget
from gsencoder.core.device import choose_device
from gsencoder.core.errors import InputError, SceneWarning, error_hint, listed
from gsencoder.core.files import plain
from gsencoder.core.process import Clock, Device, Track, defer_signals, untracked
from gsencoder.core.settings import check_limits, first_difference, option
from gsencoder.data.photographs import Photographs
from gsencoder.data.seeding.from_photographs import (
    MAX_DENSE_SPACING,
    DenseConfig,
    DenseSeeds,
    densify,
    seeds_of_photographs,
)
from gsencoder.data.seeding.points import colors_or_grey, seed_from_points
from gsencoder.data.seeding.seed import SeedConfig, choose_source, seed
from gsencoder.reconstruct.optimize import (
    Anchor,
    OptimizeConfig,
    Optimizer,
    RowAdam,
    anchor_at,
    gaussians_of,
    parameters_from,
)
from gsencoder.reconstruct.plan import Plan, ReconstructBudget, apply_plan, describe_plan, make_plan, refusing_late
from gsencoder.reconstruct.score import (
    Comparison,
    LogRow,
    Report,
    Validation,
    compare,
    describe_exposure,
    predict_exposures,
)
from gsencoder.render.images import inner
from gsencoder.render.rasterize import RasterConfig
from gsencoder.types import Gaussians, Scene

MIN_PHOTOGRAPHS = 2
"""Smallest number of photographs that a splat can be fitted to."""
CHECKPOINT_FILE = "reconstruction.safetensors"
IMAGE_SCALE = "image_scale"
"""The setting that says by which factor a budget made the photographs smaller."""
PLAN = "plan"
"""The fact that holds the plan."""
ANCHOR_SHAPES: dict[str, tuple[int | str, ...]] = {"means": ("N", 3), "reach": ("N",)}


@dataclass(frozen=True, slots=True, kw_only=True)
class ReconstructConfig:
    """How photographs become Gaussians, and how the result is scored."""

    holdout: int = option(8, "hold out every n-th photograph for validation; 0 = none", ge=0)
    validate_every: int = option(500, "steps between validations; 0 = at the end alone", ge=0)
    checkpoint_every: float = option(60.0, "seconds between checkpoints", ge=0)
    seeds: SeedConfig = field(default_factory=SeedConfig)
    dense: DenseConfig = field(default_factory=DenseConfig)
    optimize: OptimizeConfig = field(default_factory=OptimizeConfig)
    budget: ReconstructBudget = field(default_factory=ReconstructBudget)
    raster: RasterConfig = field(default_factory=RasterConfig)

    def __post_init__(self) -> None:
        check_limits(self)
        if self.holdout == 1:
            raise InputError("holdout: expected 0 (none) or 2 and more, got 1")
        of_steps = replace(self.budget, megabytes=None)
        reject_options_set_by_budget(of_steps, self.optimize, OptimizeConfig(), ("steps",), "optimize")
        if self.budget.megabytes is not None and not self.optimize.steps:
            raise InputError(
                "budget.megabytes: Gaussians that do not fit are taken out as the splat is pruned, and "
                "optimize.steps=0 never prunes; leave one of the two out"
            )

    def validates_at(self, step: int, steps: int) -> bool:
        """Whether the splat is validated after `step` of `steps`."""
        return step in (0, steps) or bool(self.validate_every and step % self.validate_every == 0)

    def identity(self) -> dict[str, Any]:
        """The settings that an interrupted run must share with the run that continues it, as JSON values."""
        names = ("seeds", "dense", "optimize", "budget", "raster", "holdout")
        return {name: plain(getattr(self, name)) for name in names}


@dataclass(frozen=True, slots=True, kw_only=True)
class State:
    """A reconstruction between two steps. The first is of step 0: seeds are sought once.

    Attributes:
        adam: parameters and moments.
        anchor: what holds positions near their seeds, if anything does.
        exposures: an affine map of colors for each fitted photograph, if they are fitted; None at step 0, and
            where photographs do not differ in exposure.
        facts: how it began, as JSON values: number and source of the seeds, what was added to points, and the plan.
    """

    adam: RowAdam
    anchor: Anchor | None
    exposures: Float[Tensor, "V 3 4"] | None = None
    step: int
    seconds: float
    facts: Mapping[str, Any]


def save_state(path: Path, state: State, settings: Mapping[str, Any]) -> None:
    """Writes the state; `settings` are what a run must have in common to go on from here, as JSON values."""
    arrays = {
        f"{kind}.{name}": value.detach().cpu().numpy()
        for kind in RowAdam.KINDS
        for name, value in getattr(state.adam, kind).items()
    }
    if state.anchor is not None:
        arrays |= {f"anchor.{name}": getattr(state.anchor, name).cpu().numpy() for name in ANCHOR_SHAPES}
    if state.exposures is not None:
        arrays["exposure.maps"] = state.exposures.numpy()
    header = {
        "step": state.step,
        "adam_steps": state.adam.steps,
        "seconds": state.seconds,
        "facts": dict(state.facts),
        "settings": dict(settings),
    }
    write_archive(path, arrays, header)


def image_scale_of(path: Path) -> float | None:
    """The factor by which an unfinished run makes photographs smaller; None where there is no such run, or its
    checkpoint does not say so or is damaged, which `load_state` says."""
    if not os.path.lexists(path):
        return None
    with suppress(InputError), open_archive(path) as file:
        scale = file.value("settings", dict).get(IMAGE_SCALE)
        return scale if isinstance(scale, float) and 0 < scale <= 1 else None
    return None


def load_state(path: Path, settings: Mapping[str, Any], *, sh_degree: int, device: torch.device | str = "cpu") -> State:
    """The state that a run has left; the colors are of `sh_degree`, or of the degree of the plan in its facts.

    Raises:
        InputError: damaged, or of a run with other settings; the first that differs is named.
    """
    with error_hint(f"give resume=false to start again, or remove {path}"), open_archive(path) as file:
        earlier = file.value("settings", dict)
        if earlier != settings:
            raise InputError(f"{path}: was made with {first_difference(earlier, settings)}")
        step, adam_steps = file.value("step", int), file.value("adam_steps", int)
        seconds, facts = float(file.value("seconds", float, int)), file.value("facts", dict)
        if not (0 <= adam_steps <= step and 0 <= seconds < math.inf):
            raise InputError(f"a state that no run was in (step {step})")
        degree = facts.get(PLAN, {}).get("sh_degree", sh_degree)
        if degree not in range(sh_degree + 1):
            raise InputError(f"colors of a degree that no run has ({degree!r})")
        shapes: dict[str, tuple[int, ...]] = {"means": (3,), "quats": (4,), "log_scales": (3,), "logit_opacities": ()}
        shapes |= {"sh0": (1, 3), "shN": ((degree + 1) ** 2 - 1, 3)}
        tables = {
            kind: {
                name: torch.from_numpy(file.array(f"{kind}.{name}", "float32", ("N", *shape)).copy()).to(device)
                for name, shape in shapes.items()
            }
            for kind in RowAdam.KINDS
        }
        anchor = None
        if "anchor.means" in file:
            arrays = {name: file.array(f"anchor.{name}", "float32", shape) for name, shape in ANCHOR_SHAPES.items()}
            anchor = Anchor(**{name: torch.from_numpy(value.copy()).to(device) for name, value in arrays.items()})
        exposures = None
        if "exposure.maps" in file:
            exposures = torch.from_numpy(file.array("exposure.maps", "float32", ("V", 3, 4)).copy())
    adam = RowAdam.restored(tables, adam_steps)
    return State(adam=adam, anchor=anchor, exposures=exposures, step=step, seconds=seconds, facts=facts)


def split(photographs: Photographs, every: int) -> tuple[list[int], list[int]]:
    """Row numbers of the views to fit, and of every n-th view, which is held out; those of which a mask leaves no
    window of pixels are in neither.

    Warns:
        SceneWarning: some are masked all over; they are named.
    """
    count = len(photographs.names)
    held_out = [view for view in range(count) if every and view % every == 0]
    training = [view for view in range(count) if view not in held_out]
    if len(training) < MIN_PHOTOGRAPHS:
        raise InputError(
            f"reconstruct: expected at least {MIN_PHOTOGRAPHS} photographs to fit, got {len(training)} of {count}; "
            "give more photographs" + (f", or hold out fewer than every {every}th (holdout=)" if every else "")
        )
    masked = {view for view, mask in enumerate(photographs.masks) if mask is not None and not inner(mask).any()}
    for views, subject, least in (
        (training, "photographs to fit", MIN_PHOTOGRAPHS),
        (held_out, "held-out photographs", 0),
    ):
        names = [photographs.names[view] for view in views if view in masked]
        message = f"{len(names)} of {len(views)} {subject} are masked all over"
        if names and len(views) - len(names) < least:
            raise InputError(
                f"reconstruct: {message}: {listed(names)}; look at their masks, or at their alpha channels"
            )
        if names:
            warnings.warn(f"{message} and not used: {listed(names)}", SceneWarning, stacklevel=2)
    return [view for view in training if view not in masked], [view for view in held_out if view not in masked]


class Start(NamedTuple):
    """The first Gaussians.

    Attributes:
        source: splat, depth, points, photographs, mesh or tsdf.
        dense: what was added to structure-from-motion or triangulated points; None where nothing was.
        triangulated: number of points that were triangulated, for the source photographs.
    """

    gaussians: Gaussians
    source: str
    dense: DenseSeeds | None = None
    triangulated: int | None = None


def initial_gaussians(
    scene: Scene,
    photographs: Photographs,
    training: Sequence[int],
    seeds: SeedConfig = SeedConfig(),
    dense: DenseConfig = DenseConfig(),
    *,
    track: Track = untracked,
) -> Start:
    """The first Gaussians of a scene: its own splat, else seeds from what its training views hold.

    Args:
        training: the views that may be looked at.
        dense: when points are added to those of structure from motion.
    """
    if scene.gaussians is not None:
        return Start(scene.gaussians, "splat")
    assert scene.views is not None
    views = scene.views.select(training)
    seen = replace(scene, views=views)
    source = choose_source(seen, seeds)
    added: DenseSeeds | None = None
    triangulated = None
    if source == "photographs":
        added = seeds_of_photographs(photographs, views, dense, training=training, track=track)
        triangulated = added.triangulated
    elif source == "points" and scene.sfm_points is not None and dense.enough > 0:
        colors = colors_or_grey(scene.sfm_points, scene.sfm_colors)
        added = densify(photographs, training, scene.sfm_points, colors, dense, track=track)
        seen = replace(seen, sfm_colors=colors)
    if added is None:
        return Start(seed(seen, seeds, track=track), source)
    gaussians = seed_from_points(added.points, added.colors, views=views, largest_spacing=MAX_DENSE_SPACING)
    return Start(gaussians, source, added, triangulated)


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
    if (dense := start.dense) is not None:
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
    adam, anchor = RowAdam(parameters_from(start.gaussians, config.optimize.sh_degree, device)), None
    # Points of photographs are estimates, and a splat was optimized: neither holds what begins there.
    if start.source in ("depth", "mesh", "tsdf") and config.optimize.anchor_sigmas:
        anchor = anchor_at(adam.parameters, config.optimize.anchor_sigmas)
    return State(adam=adam, anchor=anchor, step=0, seconds=0.0, facts=seeding)


@contextmanager
def checkpointed(
    optimizer: Optimizer, every: float, save: Callable[[], None], now: Callable[[], float]
) -> Iterator[Callable[[], None]]:
    """Saves the state between two steps: after this many seconds, when the function that this gives is called, and as
    the block ends, whatever ends it."""
    saved_at, saved_step = now(), optimizer.step

    def save_if_due() -> None:
        nonlocal saved_at, saved_step
        if now() - saved_at >= every:
            save()
            saved_at, saved_step = now(), optimizer.step

    try:
        yield save_if_due
    finally:
        # Also after the last step: writing the results may be interrupted as well.
        if optimizer.is_consistent and optimizer.step > saved_step:
            save()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Reconstruction:
    """A splat that was fitted to photographs, and how well it predicts the held-out ones.

    Attributes:
        gaussians: relative to the scene's origin.
        seeding: number and source of the seeds, and what was added to structure-from-motion points, as JSON values.
        training: row numbers of the views that were fitted.
        held_out: row numbers of the views that were not.
        log: one row a validation, oldest first; empty without held-out views.
        comparisons: up to four held-out photographs with renders of their views.
        exposure: brightness of each fitted photograph, relative to their mean, from the affine maps of colors; None
            where photographs are fitted as they are.
        exposure_source: what those of held-out photographs were predicted from, see `ExposurePrediction`.
        held_out_colors: color maps to which held-out photographs are expected to be exposed, in their order; identities
            where `exposure` is None.
        seconds: wall-clock time by step of the stage.
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
    now: Callable[[], float] = time.monotonic,
    track: Track = untracked,
    report: Report = lambda line: None,  # noqa: ARG005
) -> Reconstruction:
    """Fits Gaussians to the photographs of a scene.

    The Gaussians are the scene's own splat, or seeds from its depth, mesh or structure-from-motion points. They are
    moved, recolored and pruned, and never split, so every surface has to be seeded at the start.

    Args:
        scene: with photographs and poses; depth and masks are used where it has them.
        device: where to compute; on CUDA gsplat renders.
        work: an existing folder for the checkpoint and the log. A run that was interrupted is continued from the
            checkpoint in it, with the same result; None = a temporary folder.
        made_from: what else a run must share with the run that it continues, as JSON values, such as the path and the
            reading options of the scene.
        spent: seconds that reading the scene took, which count to a limit of seconds.
        report: receives a line after seeding and after each validation.

    Raises:
        InputError: no photographs, too few of them, nothing to seed from, no Gaussian in view, a loss or gradient that
            is not finite, a limit that cannot be kept, or a checkpoint of another run.

    Warns:
        SceneWarning: photographs that are masked all over, or plane sweeps that found no surface.
    """
    if scene.views is None:
        raise InputError(f"reconstruct: scene {scene.name} has no photographs to fit a splat to")
    identity = {**made_from, **config.identity()}
    budget, began, target = config.budget, now() - spent, choose_device(device)
    with ExitStack() as stack:
        folder = work or Path(stack.enter_context(TemporaryDirectory()))
        checkpoint = folder / CHECKPOINT_FILE
        continued = os.path.lexists(checkpoint)
        in_time = track
        if budget.seconds is not None and not continued:
            in_time = refusing_late(track, budget, lambda: now() - began)
        clock = Clock()
        with clock("read"):
            photographs = Photographs(scene.views, track=in_time)
            identity["photographs"] = photographs.digest()
        training, held_out = split(photographs, config.holdout)
        with clock("seeds"):
            if continued:
                state = load_state(checkpoint, identity, sh_degree=config.optimize.sh_degree, device=target)
                # What is repeated does not count.
                began = now() - state.facts[PLAN]["spent"] - state.seconds
            else:
                state = initial_state(scene, photographs, training, config, target, in_time, report)
        optimizer = Optimizer(
            state.adam,
            photographs,
            training,
            config.optimize,
            raster=config.raster,
            anchor=state.anchor,
            exposures=state.exposures,
            step=state.step,
        )
        with clock("plan"):
            if continued:
                plan = Plan.of(state.facts[PLAN])
            else:
                plan = make_plan(
                    optimizer,
                    held_out,
                    budget,
                    lambda steps: sum(config.validates_at(step, steps) for step in range(steps + 1)),
                    double_means=bool(scene.origin.any()),
                    began=began,
                    now=now,
                )
            option = "budget.minutes" if budget.seconds is None else "budget.seconds"
            description = describe_plan(optimizer, plan.steps, option)
            apply_plan(optimizer, plan)
        for line in (description, *plan.notes):
            report(line)
        seeding = {name: value for name, value in state.facts.items() if name != PLAN}
        start, facts = now() - state.seconds, {**seeding, PLAN: asdict(plan)}

        def save() -> None:
            color_maps = None if optimizer.exposures is None or not optimizer.step else optimizer.exposures.maps
            state = State(
                adam=optimizer.adam,
                anchor=optimizer.anchor,
                exposures=color_maps,
                step=optimizer.step,
                seconds=now() - start,
                facts=facts,
            )
            save_state(checkpoint, state, identity)

        if not continued:
            save()
        validate = Validation(optimizer, held_out, folder, report)
        with clock("optimise"), checkpointed(optimizer, config.checkpoint_every, save, now) as save_if_due:
            for step in track(range(optimizer.step, plan.steps), "optimising"):
                if plan.until is not None and now() - began >= plan.until:
                    report(f"the time is over after {step:,} of {plan.steps:,} steps (budget.seconds)")
                    break
                if config.validates_at(step, plan.steps):
                    validate(now() - start)
                optimizer.advance()
                save_if_due()
            if plan.max_gaussians is not None and len(optimizer.parameters["means"]) > plan.max_gaussians:
                # The time was over before the first pruning.
                with defer_signals():
                    optimizer.prune()
            validate(now() - start)
        gaussians = gaussians_of(optimizer.parameters)
        exposure = differing = source = None
        predicted = predict_exposures(optimizer.exposures, photographs.cameras, held_out)
        if optimizer.exposures is not None:
            exposure, source = tuple(optimizer.exposures.brightness().tolist()), predicted.source
            differing = describe_exposure(min(exposure), max(exposure), source)
        if differing is not None:
            report(differing)
        comparisons = compare(optimizer, held_out, matched=differing is not None and source == "mean")
        return Reconstruction(
            gaussians=gaussians,
            seeding=seeding,
            steps=optimizer.step,
            training=optimizer.training,
            held_out=tuple(held_out),
            log=tuple(validate.rows),
            comparisons=comparisons,
            exposure=exposure,
            exposure_source=source,
            held_out_colors=predicted.maps.numpy(),
            seconds=clock.seconds,
            plan=plan,
            elapsed=now() - began,
        )
