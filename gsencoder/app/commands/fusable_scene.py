"""Loading scenes that a teacher's features can be lifted onto, for the commands that do so."""

from pathlib import Path

from gsencoder.app.commands.scene_up import with_reported_up
from gsencoder.app.runs.progress import Progress, console
from gsencoder.app.runs.summary import Summary
from gsencoder.core.errors import InputError
from gsencoder.data.check.scene_check import warn_of_faults
from gsencoder.data.scenes import SceneConfig, load_scene
from gsencoder.data.seeding.seed import SeedConfig, with_gaussians
from gsencoder.fusion.cameras import INSIDE, CamerasOfSplat, with_explained_views
from gsencoder.fusion.fit import with_fitting_splat
from gsencoder.render import BlendConfig
from gsencoder.types import Scene


def load_fusable(
    path: Path,
    summary: Summary,
    *,
    splat: str,
    data: SceneConfig,
    seeds: SeedConfig,
    orbits: int,
    cameras: CamerasOfSplat,
    blend: BlendConfig,
    labels: bool,
    quiet: bool,
) -> Scene:
    """Loads a scene with Gaussians and views: seeds if it has no splat, orbit cameras if it has no views.

    Args:
        path: of the scene.
        summary: takes the seconds of the steps.
        splat: file of the Gaussians, or empty.
        data: how the scene is read.
        seeds: how Gaussians are made.
        orbits: largest number of cameras placed in a bare splat.
        cameras: where they stand.
        blend: how a bare splat is rendered.
        labels: whether a teacher needs labels, which a bare splat has not.
        quiet: print nothing.

    Raises:
        InputError: the scene cannot be read, or has neither views nor what they would be rendered from.
    """
    with summary.step("load"):
        scene = load_scene(path, splat=splat or None, options=data)
    with summary.step("check"):
        warn_of_faults(scene)
        scene = with_fitting_splat(scene, splat, data)
    if scene.views is None and labels:
        raise InputError(
            f"{path}: a splat without views has no labels for teacher=labels; give a teacher that looks at pictures, "
            "such as teacher=mosaic text=minilm, or teacher=palette"
        )
    if scene.gaussians is None:
        with summary.step("seeds"):
            scene = with_gaussians(scene, seeds, track=Progress(quiet=quiet))
    scene = with_reported_up(scene, summary, quiet=quiet)
    if scene.views is not None:
        return scene
    with summary.step("cameras"):
        scene, reason = with_explained_views(scene, orbits, blend, cameras=cameras)
    assert scene.views is not None
    where = "inside" if scene.views.names[0].startswith(INSIDE) else "around"
    summary.results["cameras"] = where
    console(quiet).print(
        f"{scene.name}: a bare splat; rendered from {len(scene.views)} cameras {where} it, because {reason}"
    )
    return scene
