"""`gsencoder reconstruct SCENE`: photographs to Gaussians, on a CPU or a GPU."""

import shutil
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

import numpy as np

from gsencoder.app.options import SharedScenesConfig, settings
from gsencoder.app.run import Run
from gsencoder.core.budget import MEGABYTE
from gsencoder.core.device import choose_device
from gsencoder.core.errors import SceneWarning, counted
from gsencoder.core.files import write_picture
from gsencoder.core.logs import LOG_FILE
from gsencoder.core.process import Device, retain_freed_memory
from gsencoder.core.settings import option
from gsencoder.data.check.scene_check import warn_of_faults
from gsencoder.data.scenes import SceneConfig
from gsencoder.data.splats.files import READABLE, save_splat
from gsencoder.data.video import RECORD_FILE, VideoConfig
from gsencoder.fusion.fit import with_fitting_splat
from gsencoder.infer.draw import contact_sheet
from gsencoder.reconstruct.plan import choose_scale, refuse_late
from gsencoder.reconstruct.run import (
    CHECKPOINT_FILE,
    IMAGE_SCALE,
    ReconstructConfig,
    Reconstruction,
    image_scale_of,
    reconstruct,
)
from gsencoder.reconstruct.score import LogRow, Score, describe
from gsencoder.reconstruct.sfm import FRAMES_FOLDER, OpenedScene, SfmConfig, find_photographed, open_scene

PLY_FILE, PICTURES_FILE, MODEL_FOLDER = "splat.ply", "held_out.png", "sparse/0"


@dataclass(frozen=True, slots=True, kw_only=True)
class ReconstructCommandConfig(ReconstructConfig, SharedScenesConfig):
    """Settings of `reconstruct`."""

    paths: tuple[str, ...] = option(
        (),
        "scenes with photographs and poses, folders of photographs alone, videos, or folders of these",
        metavar="SCENE",
        required=True,
    )
    splat: str = option("", f"Gaussians to refine; empty = seeds. {READABLE}")
    resume: bool = option(True, "continue an interrupted run; false = start again")
    device: Device = option("auto", "where to compute; on CUDA gsplat rasterizes")
    data: SceneConfig = field(default_factory=SceneConfig)
    sfm: SfmConfig = field(default_factory=SfmConfig)
    video: VideoConfig = field(default_factory=VideoConfig)

    def __post_init__(self) -> None:
        SharedScenesConfig.__post_init__(self)
        ReconstructConfig.__post_init__(self)


def run(config: ReconstructCommandConfig, run: Run) -> None:
    """Reconstructs one scene into out=, or each of several into the folder OUT/NAME."""
    retain_freed_memory()
    choose_device(config.device)  # A missing device is an error before anything is read.
    paths = find_photographed(config.paths)
    run.scenes(paths, "reconstruction", lambda path, out, run: _reconstruct_one(path, out, config, run))


def _reconstruct_one(path: Path, out: Path, config: ReconstructCommandConfig, run: Run) -> None:
    """Reads a scene or registers photographs, reconstructs, and writes splat, log and pictures into `out`."""

    def spent() -> float:
        return time.perf_counter() - run.began

    with run.resumable(out, "reconstruction", resume=config.resume) as (folder, work):
        opened = _open(path, work, config, config.data, spent, run)
        scale = _affordable_scale(opened, work, config, spent=spent())
        if scale != 1:
            opened = _at_scale(opened, scale, path, work, config, run)
        run.add_seconds(opened.seconds)
        with run.step("check"):
            warn_of_faults(opened.scene)
            opened = replace(opened, scene=with_fitting_splat(opened.scene, config.splat, config.data))
        if opened.sfm is not None:
            sfm = opened.sfm
            run.results.update(placed=len(sfm.placed), missing=list(sfm.missing), sfm_error=sfm.error)
        parts = ("data", "sfm", "video") if opened.is_video else ("data", "sfm")
        reading = {name: settings(getattr(config, name)) for name in parts}
        made_from = {"scene": str(path.resolve()), "splat": config.splat, **reading}

        result = reconstruct(
            opened.scene,
            ReconstructConfig(**{item.name: getattr(config, item.name) for item in fields(ReconstructConfig)}),
            device=config.device,
            work=work,
            made_from={**made_from, IMAGE_SCALE: scale},
            spent=spent(),
            track=run.track,
            report=run.print,
        )
        ended = time.perf_counter()
        run.add_seconds(result.seconds)
        origin = opened.scene.origin
        save_splat(folder / PLY_FILE, result.gaussians, origin=origin if origin.any() else None)
        if opened.sfm is not None:
            # Without its poses the splat could not be fused.
            shutil.copytree(opened.sfm.model, folder / MODEL_FOLDER)
            run.results["model"] = MODEL_FOLDER
        if opened.is_video and opened.photographs is not None:
            shutil.copytree(opened.photographs, folder / FRAMES_FOLDER, ignore=shutil.ignore_patterns(RECORD_FILE))
            run.results["images"] = FRAMES_FOLDER
        shutil.copy(work / LOG_FILE, folder / LOG_FILE)
        if result.comparisons:
            pictures = [picture for each in result.comparisons for picture in (each.photograph, each.render)]
            titles = [f"{each.name}: {kind}" for each in result.comparisons for kind in ("photograph", "splat")]
            write_picture(folder / PICTURES_FILE, contact_sheet(pictures, titles, columns=2))
        last: LogRow = result.log[-1] if result.log else {}
        run.results.update(result.seeding)
        run.results.update(
            gaussians=len(result.gaussians),
            steps=result.steps,
            views=len(result.training),
            held_out=len(result.held_out),
            exposure=None if result.exposure is None else [min(result.exposure), max(result.exposure)],
            exposure_source=result.exposure_source,
            **{name: last.get(name) for name in Score._fields},
            splat=PLY_FILE,
            log=LOG_FILE,
        )
        lines: list[str] = []
        if config.budget.limits:
            seconds = result.elapsed + time.perf_counter() - ended
            # A scene without poses of its own has the name of the folder of its state.
            name = opened.scene.name if opened.sfm is None else path.name
            lines = _report_budget(name, scale, result, folder / PLY_FILE, seconds, config, run)
    run.print(*(f"{out}: {line}" for line in lines))
    scores = f"; {describe(last)} on {counted(len(result.held_out), 'held-out photograph')}" if last else ""
    run.print(f"{out / PLY_FILE}: {counted(len(result.gaussians), 'Gaussian')}{scores}")
    if opened.sfm is not None:
        images = "" if opened.is_video else f" data.images={opened.photographs}"
        run.print(
            f"{out} holds the poses of the photographs, as a COLMAP scene: gsencoder fuse {out} "
            f"splat={PLY_FILE}{images}"
        )


def _open(
    path: Path, work: Path, config: ReconstructCommandConfig, data: SceneConfig, spent: Callable[[], float], run: Run
) -> OpenedScene:
    subject, advice = "registering the photographs", "more seconds, fewer photographs, or a smaller sfm.size"
    return open_scene(
        path,
        work,
        splat=config.splat,
        data=data,
        sfm=config.sfm,
        video=config.video,
        track=run.track,
        in_time=lambda: refuse_late(config.budget, spent(), subject, advice),
    )


def _report_budget(
    scene: str,
    scale: float,
    result: Reconstruction,
    file: Path,
    seconds: float,
    config: ReconstructCommandConfig,
    run: Run,
) -> list[str]:
    """Reports what limits chose; returns a line for each limit that is kept."""
    budget, plan = config.budget, result.plan
    image_scale = scale * config.data.image_scale
    chosen = {"image_scale": image_scale, "steps": result.steps, "sh_degree": plan.sh_degree}
    options = [f"data.image_scale={image_scale!r}", f"optimize.steps={plan.steps}"]
    if plan.max_gaussians is not None:
        chosen["most_gaussians"] = plan.max_gaussians
    options += [f"optimize.sh_degree={plan.sh_degree}", "budget.minutes=0"]
    predicted = {name: value for name in budget.limits if (value := getattr(plan, name)) is not None}
    run.report_choice(scene, chosen, predicted=predicted, notes=plan.notes, options=options)
    return run.report_budget(budget, {"seconds": seconds, "megabytes": file.stat().st_size / MEGABYTE})


def _affordable_scale(opened: OpenedScene, work: Path, config: ReconstructCommandConfig, *, spent: float) -> float:
    """The factor by which photographs are made smaller for the budget; 1 where data.image_scale states one.

    That of an interrupted run stays: with other threads or on another device the same minutes would allow another.
    """
    views = opened.scene.views
    if views is None or config.data.image_scale != 1:
        return 1.0
    begun = image_scale_of(work / CHECKPOINT_FILE)
    if begun is not None:
        return begun
    device = choose_device(config.device)
    return choose_scale(views.cameras, config.budget, device, config.optimize, spent=spent)


def _at_scale(
    opened: OpenedScene, scale: float, path: Path, work: Path, config: ReconstructCommandConfig, run: Run
) -> OpenedScene:
    """The scene with photographs that are larger by a factor."""
    views = opened.scene.views
    assert views is not None
    data = replace(config.data, image_scale=scale)
    with warnings.catch_warnings():
        # They were printed when the scene was read at its full size.
        warnings.simplefilter("ignore", SceneWarning)
        smaller = _open(path, work, config, data, lambda: 0.0, run)
    width, height = (int(np.median(sizes)) for sizes in (views.cameras.widths, views.cameras.heights))
    budget = config.budget
    option = f"budget.minutes={budget.minutes:g}" if budget.seconds is None else budget.option("seconds")
    run.print(
        f"photographs of {width}×{height} are looked at {scale:g} times as large, because of {option} "
        "(data.image_scale= states another size)"
    )
    return replace(smaller, sfm=opened.sfm, seconds=opened.seconds)
