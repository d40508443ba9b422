"""What `gsencoder reconstruct` begins with: a scene with poses, or photographs that are given some."""

import os
import warnings
from dataclasses import replace
from pathlib import Path

from gsencoder.app.runs.summary import Summary
from gsencoder.core.errors import InputError, SceneWarning, advised, listed
from gsencoder.data.scenes import SceneConfig, find_scenes, is_scene, load_scene
from gsencoder.reconstruct.checkpoint import CHECKPOINT_FILE
from gsencoder.reconstruct.sfm import PLACED_FILE, SfmConfig, photographs_in, place_photographs, placed_before
from gsencoder.types import Scene

ANEW = "give resume=false to begin anew"


def open_scene(given: Path, work: Path, splat: str, data: SceneConfig, sfm: SfmConfig, summary: Summary) -> Scene:
    """The scene; a folder that holds photographs and nothing else is placed first.

    Args:
        given: a scene, or photographs.
        work: folder for what placing finds; what an earlier run found there is taken up.
        splat: Gaussians to refine, or empty.
        data: how the scene is read.
        sfm: how photographs are placed.
        summary: is told of those that have a place, and of the others.

    Raises:
        InputError: no photographs, or none could be placed.
    """
    pictures = next(
        (folder for folder in (given, given / "images") if folder.is_dir() and photographs_in(folder)), None
    )
    # Photographs that lie beside the scenes of others, or the results of a run, are what was asked for.
    scenes = [] if pictures is not None and not is_scene(given) else find_scenes([given])
    if len(scenes) > 1:
        names = listed([scene.name for scene in scenes])
        raise InputError(f"{given}: holds {len(scenes)} scenes ({names}); give one of them")
    if pictures is not None and not scenes:
        if splat:
            raise InputError(
                f"{given}: splat={splat} lies in a world of its own, and photographs without poses are placed "
                "in another; give a scene with the poses that belong to the splat"
            )
        placed = placed_before(pictures, work, sfm)
        if placed is None and os.path.lexists(work / CHECKPOINT_FILE):
            raise InputError(
                f"{work}: a run was cut off here, and where its photographs were placed ({PLACED_FILE}, sparse/0) is "
                "gone or damaged, or belongs to other photographs or settings; put these back, or give resume=false to "
                "begin anew"
            )
        if placed is None:
            with summary.step("place"):
                placed = place_photographs(pictures, work, sfm)
        summary.results.update(placed=len(placed.placed), missing=list(placed.missing), sfm_error=placed.error)
        if placed.missing:
            warnings.warn(
                f"{len(placed.missing)} of {len(placed.placed) + len(placed.missing)} photographs could not be placed "
                f"and are not used: {listed(placed.missing)}",
                SceneWarning,
                stacklevel=2,
            )
        with advised(ANEW):
            return load_scene(work, options=replace(data, images=str(pictures)))
    scene = load_scene(scenes[0], splat=splat or None, options=data)
    if scene.views is None:
        raise InputError(f"{given}: a splat without photographs; there is nothing to fit it to")
    return scene
