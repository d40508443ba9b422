"""`gsencoder reconstruct SCENE`: photographs to Gaussians, on a CPU or a GPU."""

import os
import shutil
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsencoder.config import CommonConfig, settings
from gsencoder.data.scenes import SceneConfig, find_scenes, load_scene
from gsencoder.data.seeds import SeedConfig
from gsencoder.data.splats import READABLE, save_splat
from gsencoder.errors import InputError, SceneWarning
from gsencoder.infer.pictures import contact_sheet
from gsencoder.models.device import Device, choose_device
from gsencoder.models.heap import keep_heap
from gsencoder.outputs import close_work_folder, open_work_folder, output_folder, refuse_to_replace_inputs
from gsencoder.progress import Progress, console
from gsencoder.reconstruct.checkpoint import CHECKPOINT_FILE, load_state, save_state
from gsencoder.reconstruct.dense import DenseConfig
from gsencoder.reconstruct.optimize import OptimizeConfig, Optimizer
from gsencoder.reconstruct.photographs import Photographs
from gsencoder.reconstruct.prune import PruneConfig
from gsencoder.reconstruct.sfm import SfmConfig, photographs_in, place_photographs
from gsencoder.reconstruct.start import start_of
from gsencoder.render.rasterize import RasterConfig
from gsencoder.summary import Summary
from gsencoder.train.log import LOG_FILE, Log, read_log
from gsencoder.types import Scene

PLY_FILE, PICTURES_FILE = "splat.ply", "held_out.png"
SHOWN_VIEWS = 4
Row = dict[str, int | float]
"""One line of the log, without the step: seconds, gaussians, psnr, ssim."""


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
    with output_folder(out, overwrite=config.overwrite, summary=summary) as folder:
        refuse_to_replace_inputs(work, settings(config))
        open_work_folder(work, anew=not config.resume)
        scene = open_scene(given, work, config, summary)
        assert scene.views is not None
        with summary.step("read"):
            photographs = Photographs(scene.views, track=track)
        training, held_out = split(len(photographs), config.holdout)
        optimizer = start(scene, photographs, training, config, summary, track, device)
        identity = {"scene": str(given.resolve()), **_identity(config)}
        spent = 0.0
        if (work / CHECKPOINT_FILE).is_file():
            spent = load_state(work / CHECKPOINT_FILE, optimizer, identity)
        with summary.step("optimise"):
            rows = optimise(optimizer, held_out, config, work, identity, spent, track)
        write_results(folder, scene, optimizer, held_out, rows, work, summary)
    close_work_folder(work)
    last: Row = rows[-1] if rows else {}
    told = f"; {last['psnr']:.2f} dB, SSIM {last['ssim']:.3f} on {len(held_out)} held-out photographs" if last else ""
    console(config.quiet).print(f"{out / PLY_FILE}: {summary.results['gaussians']:,} Gaussians{told}")


def open_scene(given: Path, work: Path, config: ReconstructConfig, summary: Summary) -> Scene:
    """The scene; a folder that holds photographs and nothing else is placed first.

    Raises:
        InputError: no photographs, or none could be placed.
    """
    pictures = next(
        (folder for folder in (given, given / "images") if folder.is_dir() and photographs_in(folder)), None
    )
    try:
        (path,) = find_scenes([given])
    except InputError:
        if pictures is None:
            raise
        path = None
    if path is None and pictures is not None:
        with summary.step("place"):
            placed = place_photographs(pictures, work, config.sfm)
        summary.results.update(placed=len(placed.placed), missing=list(placed.missing), sfm_error=placed.error)
        if placed.missing:
            warnings.warn(
                f"{len(placed.missing)} of {len(placed.placed) + len(placed.missing)} photographs could not be placed "
                f"and are not used: {', '.join(placed.missing[:8])}{', …' if len(placed.missing) > 8 else ''}",
                SceneWarning,
                stacklevel=2,
            )
        return load_scene(work, options=replace(config.data, images=str(pictures)))
    assert path is not None
    scene = load_scene(path, splat=config.splat or None, options=config.data)
    if scene.views is None:
        raise InputError(f"{given}: a splat without photographs; there is nothing to fit it to")
    return scene


def split(count: int, every: int) -> tuple[list[int], list[int]]:
    """Views to fit, and every so manyth that is kept to judge by.

    Raises:
        InputError: too few.
    """
    held_out = [view for view in range(count) if every and view % every == 0]
    training = [view for view in range(count) if view not in held_out]
    if len(training) < 2:
        raise InputError(f"reconstruct: expected at least 2 photographs to fit, got {len(training)} of {count}")
    return training, held_out


def start(
    scene: Scene,
    photographs: Photographs,
    training: Sequence[int],
    config: ReconstructConfig,
    summary: Summary,
    track: Progress,
    device: torch.device,
) -> Optimizer:
    """The optimiser of a scene at its first step."""
    with summary.step("seeds"):
        begun = start_of(scene, photographs, training, config.seeds, config.dense, track=track)
    summary.results.update(seeds=len(begun.gaussians), source=begun.source)
    if begun.dense is not None:
        dense = begun.dense
        summary.results.update(swept=dense.swept, filled=dense.filled, coverage=list(dense.coverage))
        console(config.quiet).print(
            f"points reach {dense.coverage[0]:.0%} of the pictures' cells: {dense.swept:,} were added from plane "
            f"sweeps and {dense.filled:,} between them, which reach {dense.coverage[1]:.0%}"
        )
    return Optimizer(
        begun.gaussians,
        photographs,
        training,
        config.optimize,
        prune=config.prune,
        raster=config.raster,
        device=device,
    )


def optimise(
    optimizer: Optimizer,
    held_out: Sequence[int],
    config: ReconstructConfig,
    work: Path,
    identity: dict[str, Any],
    spent: float,
    track: Progress,
) -> list[Row]:
    """All steps that are left; the rows of the log. Whatever stops the run between two steps leaves a checkpoint."""
    screen, steps = console(config.quiet), config.optimize.steps
    log = Log(work, done=optimizer.step, events=False)
    rows: list[Row] = [{name: float(cell) for name, cell in row.items()} for row in read_log(work / LOG_FILE)]
    begun, saved = time.monotonic() - spent, time.monotonic()

    def judge() -> None:
        quality, similarity = optimizer.score(held_out)
        seconds, count = time.monotonic() - begun, len(optimizer.raw["means"])
        row: Row = {"seconds": seconds, "gaussians": count, "psnr": quality, "ssim": similarity}
        log.add(optimizer.step, row)
        rows.append(row)
        screen.print(
            f"step {optimizer.step} of {steps}: {quality:.2f} dB, SSIM {similarity:.3f}, {count:,} Gaussians, "
            f"{seconds:.0f} s"
        )

    if held_out and not rows and not optimizer.step:
        judge()
    try:
        for _ in track(range(optimizer.step, steps), "optimising"):
            optimizer.advance()
            due = optimizer.step == steps or (config.validate_every and optimizer.step % config.validate_every == 0)
            if held_out and due:
                judge()
            if time.monotonic() - saved >= config.checkpoint_every:
                save_state(work / CHECKPOINT_FILE, optimizer, time.monotonic() - begun, identity)
                saved = time.monotonic()
    except BaseException:
        if optimizer.whole and optimizer.step:
            save_state(work / CHECKPOINT_FILE, optimizer, time.monotonic() - begun, identity)
        raise
    return rows


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
    shown = (
        [held_out[i] for i in np.unique(np.linspace(0, len(held_out) - 1, SHOWN_VIEWS).round().astype(int))]
        if held_out
        else []
    )
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
        psnr=last.get("psnr"),
        ssim=last.get("ssim"),
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
