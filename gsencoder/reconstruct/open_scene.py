"""The scene that a reconstruction starts from: one with poses, or photographs or a video that SfM registers first."""

import os
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from gsencoder.core.errors import InputError, SceneWarning, advised, listed
from gsencoder.core.process import Clock, Track, untracked
from gsencoder.data.readers.posed import inside
from gsencoder.data.scenes import DistinctPaths, SceneConfig, find_scenes, is_scene, listed_paths, load_scene
from gsencoder.data.video import VideoConfig, is_video, take_frames
from gsencoder.reconstruct.checkpoint import CHECKPOINT_FILE
from gsencoder.reconstruct.sfm import (
    PLACED_FILE,
    Placed,
    SfmConfig,
    load_placement,
    photographs_in,
    register_photographs,
)
from gsencoder.types import Scene

START_AGAIN = "give resume=false to begin anew"
FRAMES_FOLDER = "images"
"""Frames of a video, in the working folder and in the results; the name that COLMAP scenes use."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OpenedScene:
    """A scene with posed photographs.

    Attributes:
        scene: its poses may come from structure from motion.
        sfm: the result of structure from motion; None if the scene had poses.
        photographs: the folder of photographs that structure from motion registered; None if the scene had poses.
        is_video: whether they were taken from a video, and lie in the working folder.
        seconds: wall-clock time of taking frames from a video, under "frames", and of structure from motion, under
            "place".
    """

    scene: Scene
    sfm: Placed | None
    photographs: Path | None
    is_video: bool
    seconds: dict[str, float]


def find_photographed(paths: Sequence[str]) -> tuple[Path, ...]:
    """What can be reconstructed at paths: scenes, folders of photographs alone, videos, those in folders of such, and
    those that a list (.txt) names.

    Raises:
        InputError: a path does not exist, holds nothing of the kind, or is given twice.
    """
    chosen = DistinctPaths()
    for path in listed_paths(paths):
        if not path.exists():
            # Not when its turn comes, after hours of others.
            raise InputError(f"{path}: no such file or folder")
        scenes = [path]
        if path.is_dir() and not is_scene(path) and _pictures_of(path) is None:
            entries = sorted(entry for entry in path.iterdir() if not entry.name.startswith("."))
            scenes = [entry for entry in entries if is_video(entry) or (entry.is_dir() and _is_photographed(entry))]
        # Of a path that holds nothing `find_scenes` says what was expected.
        chosen.add(scenes or find_scenes([path]))
    return chosen.paths


def _pictures_of(path: Path) -> Path | None:
    """The folder of the photographs of a scene: itself, or its folder images."""
    return next((folder for folder in (path, path / "images") if folder.is_dir() and photographs_in(folder)), None)


def _is_photographed(folder: Path) -> bool:
    return is_scene(folder) or _pictures_of(folder) is not None


def open_scene(
    path: Path,
    work: Path,
    *,
    splat: str = "",
    data: SceneConfig = SceneConfig(),
    sfm: SfmConfig = SfmConfig(),
    video: VideoConfig = VideoConfig(),
    track: Track = untracked,
    in_time: Callable[[], None] = lambda: None,
) -> OpenedScene:
    """Reads a scene; photographs alone, or frames of a video, are registered by structure from motion first.

    Args:
        path: a scene, a folder of photographs, or a video.
        work: an existing folder for the COLMAP model; one that an interrupted run completed there is used again.
        splat: file of Gaussians to refine; empty = none.
        data: how the scene is read.
        sfm: how photographs are placed.
        video: which frames of a video are taken; they are written to `images` in `work`.
        track: progress of decoding a video.
        in_time: is called while photographs are registered, and may end it.

    Raises:
        InputError: no photographs, several scenes, a video that cannot be used, or structure from motion fails.

    Warns:
        SceneWarning: photographs that could not be placed.
    """
    clock = Clock()
    if is_video(path):
        pictures: Path | None = work / FRAMES_FOLDER
        with clock("frames"):
            take_frames(path, work / FRAMES_FOLDER, video, track=track)
    else:
        pictures = _pictures_of(path)
    # A folder of photographs may also hold scenes of others, or the results of a run: the photographs are meant.
    scenes = [] if pictures is not None and (path.is_file() or not is_scene(path)) else find_scenes([path])
    if len(scenes) > 1:
        names = listed([scene.name for scene in scenes])
        raise InputError(f"{path}: holds {len(scenes)} scenes ({names}); give one of them")
    if pictures is None or scenes:
        scene = load_scene(scenes[0], splat=splat or None, options=data)
        if scene.views is None:
            raise InputError(f"{path}: a splat without photographs; there is nothing to fit it to")
        return OpenedScene(scene=scene, sfm=None, photographs=None, is_video=False, seconds=clock.seconds)
    if splat:
        raise InputError(
            f"{path}: splat={splat} lies in a world of its own, and photographs without poses are placed "
            "in another; give a scene with the poses that belong to the splat"
        )
    for name in () if is_video(path) else photographs_in(pictures):
        # Placing them takes minutes, after which the reader of the scene would refuse links that lead elsewhere.
        inside(pictures, name, str(pictures), allow_outside=data.allow_outside)
    placed = load_placement(pictures, work, sfm)
    if placed is None and os.path.lexists(work / CHECKPOINT_FILE):
        raise InputError(
            f"{work}: a run was cut off here, and where its photographs were placed ({PLACED_FILE}, sparse/0) is "
            "gone or damaged, or belongs to other photographs or settings; put these back, or give resume=false to "
            "begin anew"
        )
    if placed is None:
        with clock("place"):
            placed = register_photographs(pictures, work, sfm, single_camera=is_video(path), in_time=in_time)
        # What was found stays: the same command with more seconds need not look for it again.
        in_time()
    if placed.missing:
        warnings.warn(
            f"{len(placed.missing)} of {len(placed.placed) + len(placed.missing)} photographs could not be placed "
            f"and are not used: {listed(placed.missing)}; each should show much of what another one shows, from some "
            "20° aside at most",
            SceneWarning,
            stacklevel=2,
        )
    with advised(START_AGAIN):
        scene = load_scene(work, options=replace(data, images=str(pictures)))
    return OpenedScene(scene=scene, sfm=placed, photographs=pictures, is_video=path.is_file(), seconds=clock.seconds)
