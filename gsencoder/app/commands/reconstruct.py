"""`gsencoder reconstruct SCENE`: photographs to Gaussians, on a CPU or a GPU."""

import os
import shutil
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from gsencoder.app.commands.reconstruct_scene import ANEW, open_scene
from gsencoder.app.runs.output_folder import output_folder, refuse_to_replace_inputs
from gsencoder.app.runs.progress import Progress, console
from gsencoder.app.runs.summary import Summary
from gsencoder.app.runs.work_folder import WorkFolder
from gsencoder.app.settings.config import CommonConfig, settings
from gsencoder.core.errors import InputError, SceneWarning, advised
from gsencoder.core.even_indices import evenly
from gsencoder.core.files.step_log import LOG_FILE, Log, read_log
from gsencoder.core.runtime.device import choose_device
from gsencoder.core.runtime.device_names import Device
from gsencoder.core.runtime.heap import keep_heap
from gsencoder.data.scenes import SceneConfig
from gsencoder.data.seeding.seed import SeedConfig
from gsencoder.data.splats import READABLE, save_splat
from gsencoder.infer.draw.pictures import contact_sheet
from gsencoder.reconstruct.anchor import leash_of
from gsencoder.reconstruct.checkpoint import CHECKPOINT_FILE, State, load_state, save_state
from gsencoder.reconstruct.dense import DenseConfig
from gsencoder.reconstruct.optimize import OptimizeConfig, Optimizer
from gsencoder.reconstruct.parameters import parameters_from
from gsencoder.reconstruct.photographs import Photographs
from gsencoder.reconstruct.prune import PruneConfig
from gsencoder.reconstruct.row_adam import RowAdam
from gsencoder.reconstruct.score import FEWEST, Score, score, seen_pixels, split, unmasked
from gsencoder.reconstruct.sfm import SfmConfig
from gsencoder.reconstruct.start import start_of
from gsencoder.render.rasterize import RasterConfig
from gsencoder.types import Scene

PLY_FILE, PICTURES_FILE = "splat.ply", "held_out.png"
SHOWN_VIEWS = 4
Row = dict[str, int | float]
"""One line of the log: step, seconds, gaussians, and what a Score holds."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReconstructConfig(CommonConfig):
    """Settings of `reconstruct`."""

    paths: tuple[str, ...] = field(
        default=(),
        metadata={
            "help": "a scene with photographs and poses, or a folder of photographs alone",
            "metavar": "SCENE",
            "required": True,
        },
    )
    splat: str = field(default="", metadata={"help": f"Gaussians to refine; empty = seeds. {READABLE}"})
    holdout: int = field(default=8, metadata={"help": "of so many photographs one is kept to judge by; 0 = none"})
    validate_every: int = field(default=500, metadata={"help": "steps between judgements; 0 = at the end alone"})
    checkpoint_every: float = field(default=60.0, metadata={"help": "seconds between checkpoints"})
    resume: bool = field(default=True, metadata={"help": "go on where a run that was cut off stopped"})
    device: Device = field(default="auto", metadata={"help": "where to compute; on CUDA gsplat renders"})
    data: SceneConfig = field(default_factory=SceneConfig)
    seeds: SeedConfig = field(default_factory=SeedConfig)
    sfm: SfmConfig = field(default_factory=SfmConfig)
    dense: DenseConfig = field(default_factory=DenseConfig)
    optimize: OptimizeConfig = field(default_factory=OptimizeConfig)
    prune: PruneConfig = field(default_factory=PruneConfig)
    raster: RasterConfig = field(default_factory=RasterConfig)

    def __post_init__(self) -> None:
        if len(self.paths) > 1:
            raise InputError(f"paths: expected one scene, got {len(self.paths)}")
        if self.holdout < 0 or self.holdout == 1:
            raise InputError(f"holdout: expected 0 (none) or 2 and more, got {self.holdout}")
        for name in ("validate_every", "checkpoint_every"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise InputError(f"{name}: expected 0 or more, got {getattr(self, name)}")


def run(config: ReconstructConfig, summary: Summary) -> None:
    """Reads or places photographs, seeds, optimises, and writes splat, log and pictures into out=."""
    keep_heap()
    device = choose_device(config.device)
    given = Path(config.paths[0])
    out = config.out or Path("outputs") / (given.resolve().name or "scene") / "reconstruction"
    real = Path(os.path.realpath(out))
    work = real.with_name(f"{real.name}.reconstruction")
    track = Progress(quiet=config.quiet)
    with WorkFolder(work) as kept, output_folder(out, overwrite=config.overwrite, summary=summary) as folder:
        refuse_to_replace_inputs(kept.path, settings(config))
        kept.take(anew=not config.resume)
        scene = open_scene(given, kept.path, config.splat, config.data, config.sfm, summary)
        assert scene.views is not None
        with summary.step("read"):
            photographs = Photographs(scene.views, track=track)
        training, held_out = split(len(photographs), config.holdout)
        training = unmasked(photographs, training, "photographs to fit", least=FEWEST)
        held_out = unmasked(photographs, held_out, "held-out photographs")
        identity = {"scene": str(given.resolve()), "photographs": photographs.digest(), **_identity(config)}
        optimize, checkpoint = config.optimize, kept.path / CHECKPOINT_FILE
        begun = os.path.lexists(checkpoint)
        if begun:
            shape = {"steps": optimize.steps, "sh_degree": optimize.sh_degree}
            state = load_state(checkpoint, identity, **shape, device=device)
        else:
            with summary.step("seeds"):
                state = begin(scene, photographs, training, config, track, device)
        summary.results.update(state.facts)
        optimizer = Optimizer(
            state.adam,
            photographs,
            training,
            optimize,
            prune=config.prune,
            raster=config.raster,
            leash=state.leash,
            step=state.step,
        )
        if not begun:
            save_state(checkpoint, state, identity)
        with summary.step("optimise"):
            rows = optimise(optimizer, state, held_out, config, kept.path, identity, track)
        write_results(folder, scene, optimizer, held_out, rows, kept.path, summary)
    told = f"; {_told(rows[-1])} on {len(held_out)} held-out photographs" if rows else ""
    console(config.quiet).print(f"{out / PLY_FILE}: {summary.results['gaussians']:,} Gaussians{told}")


def begin(
    scene: Scene,
    photographs: Photographs,
    training: Sequence[int],
    config: ReconstructConfig,
    track: Progress,
    device: torch.device,
) -> State:
    """The state before the first step, and how it came about."""
    begun = start_of(scene, photographs, training, config.seeds, config.dense, track=track)
    facts: dict[str, Any] = {"seeds": len(begun.gaussians), "source": begun.source}
    if begun.dense is not None:
        dense = begun.dense
        facts |= {"swept": dense.swept, "filled": dense.filled, "coverage": list(dense.coverage)}
        console(config.quiet).print(
            f"points reach {dense.coverage[0]:.0%} of the pictures' cells: {dense.swept:,} were added from plane "
            f"sweeps and {dense.filled:,} between them, which reach {dense.coverage[1]:.0%}"
        )
        if not dense.swept:
            warnings.warn(
                f"plane sweeps found no surface, and points reach {dense.coverage[0]:.0%} of the pictures alone; what "
                "they leave bare stays empty: smaller dense.spacing, dense.samples or dense.alike may find more",
                SceneWarning,
                stacklevel=2,
            )
    adam = RowAdam(parameters_from(begun.gaussians, config.optimize.sh_degree, device))
    leash = leash_of(adam.parameters, config.optimize.leash) if begun.measured and config.optimize.leash else None
    return State(adam=adam, leash=leash, step=0, seconds=0.0, facts=facts)


def optimise(
    optimizer: Optimizer,
    state: State,
    held_out: Sequence[int],
    config: ReconstructConfig,
    work: Path,
    identity: dict[str, Any],
    track: Progress,
) -> list[Row]:
    """All steps that are left; the rows of the log. Whatever stops the run between two steps leaves a checkpoint."""
    screen, steps = console(config.quiet), config.optimize.steps
    with advised(ANEW):
        log = Log(work, done=optimizer.step, events=False, begun=bool(held_out and optimizer.step))
        rows = rows_of(work / LOG_FILE)
    seen = seen_pixels(optimizer.photographs, held_out, optimizer.training)
    begun, saved_at, saved = time.monotonic() - state.seconds, time.monotonic(), optimizer.step

    def judge() -> None:
        every = config.validate_every
        due = optimizer.step in (0, steps) or (every and optimizer.step % every == 0)
        # A run that is taken up may stand where one was due and cut off, or where one is in the log.
        if not held_out or not due or (rows and rows[-1]["step"] == optimizer.step):
            return
        found = {name: value for name, value in score(optimizer, held_out, seen)._asdict().items() if value is not None}
        row: Row = {"seconds": time.monotonic() - begun, "gaussians": len(optimizer.raw["means"]), **found}
        log.add(optimizer.step, row)
        rows.append({"step": optimizer.step, **row})
        screen.print(
            f"step {optimizer.step} of {steps}: {_told(row)}, {row['gaussians']:,} Gaussians, {row['seconds']:.0f} s"
        )

    def save() -> None:
        now = State(
            adam=optimizer.adam,
            leash=optimizer.leash,
            step=optimizer.step,
            seconds=time.monotonic() - begun,
            facts=state.facts,
        )
        save_state(work / CHECKPOINT_FILE, now, identity)

    try:
        judge()
        for _ in track(range(optimizer.step, steps), "optimising"):
            optimizer.advance()
            judge()
            if time.monotonic() - saved_at >= config.checkpoint_every:
                save()
                saved_at, saved = time.monotonic(), optimizer.step
    finally:
        # Also at the end: what is left to do, writing the results, may be cut off as well.
        if optimizer.whole and optimizer.step > saved:
            save()
    return rows


def rows_of(path: Path) -> list[Row]:
    """The log.

    Raises:
        InputError: a cell that is no number.
    """
    try:
        return [{name: float(cell) for name, cell in row.items()} for row in read_log(path)]
    except ValueError as error:
        raise InputError(f"{path}: damaged: {error}") from error


def write_results(
    folder: Path,
    scene: Scene,
    optimizer: Optimizer,
    held_out: Sequence[int],
    rows: Sequence[Row],
    work: Path,
    summary: Summary,
) -> None:
    """The splat in the world of the scene, the log, and held-out photographs beside what the splat shows."""
    gaussians = optimizer.gaussians()
    save_splat(folder / PLY_FILE, gaussians, origin=scene.origin if scene.origin.any() else None)
    shutil.copy(work / LOG_FILE, folder / LOG_FILE)
    shown = [held_out[place] for place in evenly(len(held_out), SHOWN_VIEWS)]
    if shown:
        from PIL import Image

        pictures, titles = [], []
        for view in shown:
            shot = optimizer.photographs.shot(view)
            for picture, title in ((shot.image, "photograph"), (optimizer.picture(view, shot), "splat")):
                pictures.append((picture * 255 + 0.5).to(torch.uint8).numpy())
                titles.append(f"{optimizer.photographs.names[view]}: {title}")
        Image.fromarray(contact_sheet(pictures, titles, columns=2)).save(folder / PICTURES_FILE)
    last: Row = rows[-1] if rows else {}
    summary.results.update(
        gaussians=len(gaussians),
        steps=optimizer.step,
        views=len(optimizer.training),
        held_out=len(held_out),
        **{name: last.get(name) for name in Score._fields},
        splat=PLY_FILE,
        log=LOG_FILE,
    )


def _identity(config: ReconstructConfig) -> dict[str, Any]:
    """What a run must have in common with one that it continues."""
    names = ("data", "seeds", "sfm", "dense", "optimize", "prune", "raster")
    return {
        **{name: settings(getattr(config, name)) for name in names},
        "holdout": config.holdout,
        "splat": config.splat,
    }


def _told(row: Row) -> str:
    """A judgement in words."""
    whole = f"{row['psnr']:.2f} dB, SSIM {row['ssim']:.3f}"
    if "seen_psnr" not in row:
        return whole
    return f"{row['seen_psnr']:.2f} dB where a fitted photograph shows the surface ({row['seen']:.0%}), {whole} in all"
