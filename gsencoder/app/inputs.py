"""Scenes to fuse: with Gaussians and views, whatever the files hold."""

from pathlib import Path

from gsencoder.app.run import Run
from gsencoder.core.errors import InputError
from gsencoder.data.check.scene_check import warn_of_faults
from gsencoder.data.orbits import CamerasOfSplat
from gsencoder.data.scenes import SceneConfig, load_scene
from gsencoder.data.seeding.seed import SeedConfig, with_gaussians
from gsencoder.data.up import with_up
from gsencoder.render import BlendConfig
from gsencoder.types import Scene


def load_fusable(
    path: Path,
    run: Run,
    *,
    splat: str,
    data: SceneConfig,
    seeds: SeedConfig,
    orbits: int,
    cameras: CamerasOfSplat,
    blend: BlendConfig,
    labels: bool,
) -> Scene:
    """Loads a scene with Gaussians and views: seeds if it has no splat, and at most `orbits` cameras, which `blend`
    renders, if it has no views. `labels` says whether a teacher needs labels, which a bare splat has not."""
    with run.step("load"):
        scene = load_scene(path, splat=splat or None, options=data)
    with run.step("check"):
        warn_of_faults(scene)
        if splat:
            from gsencoder.fusion.fit import with_fitting_splat

            scene = with_fitting_splat(scene, splat, data)
    if scene.views is None and labels:
        raise InputError(
            f"{path}: a splat without views has no labels for teacher=labels; give a teacher that looks at pictures, "
            "such as teacher=mosaic text=minilm, or teacher=palette"
        )
    if scene.gaussians is None:
        with run.step("seeds"):
            scene = with_gaussians(scene, seeds, track=run.track)
    scene, up = with_up(scene)
    run.report_up(scene.name, up)
    if scene.views is not None:
        return scene
    from gsencoder.fusion.cameras import INSIDE, with_views

    with run.step("cameras"):
        scene, reason = with_views(scene, orbits, blend, cameras=cameras)
    assert scene.views is not None
    where = "inside" if scene.views.names[0].startswith(INSIDE) else "around"
    run.results["cameras"] = where
    run.print(f"{scene.name}: a bare splat; rendered from {len(scene.views)} cameras {where} it, because {reason}")
    return scene
