"""Structure from motion for photographs without poses, by pycolmap on a CPU."""

import json
import math
import os
import shutil
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

from gsencoder.core.errors import InputError, SceneWarning, error_hint, listed
from gsencoder.core.files import atomic_file, read_foreign_text, sha256_of
from gsencoder.core.process import Clock, Track, untracked
from gsencoder.core.settings import CheckedConfig, option
from gsencoder.data.readers.images import check_picture
from gsencoder.data.readers.posed import inside, load_pycolmap
from gsencoder.data.scenes import SceneConfig, distinct_paths, find_scenes, is_scene, listed_paths, load_scene
from gsencoder.data.video import SUFFIXES as VIDEO_SUFFIXES
from gsencoder.data.video import VideoConfig, is_video, take_frames
from gsencoder.reconstruct.run import CHECKPOINT_FILE
from gsencoder.types import Scene

SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".ppm")
OTHER_SUFFIXES = (".webp", ".heic", ".heif", ".avif", ".gif", ".dng", ".cr2", ".nef", ".arw", *VIDEO_SUFFIXES)
"""Pictures and videos that pycolmap does not read; that they are left out is said."""
CAMERA = "SIMPLE_RADIAL"
"""COLMAP's camera model, of one focal length and one coefficient of distortion."""
PLACED_FILE = "placed.json"
BYTES_PER_FEATURE, TYPICAL_FEATURES = 160, 8192
"""In the database: descriptor and place. Photographs seldom have more, whatever is allowed."""
MAX_EXHAUSTIVE = 150
"""Up to this many photographs all pairs are compared."""
MAX_THOROUGH, ENOUGH_PLACED = 30, 0.8
"""Up to this many photographs, of which less than this share could be placed, are looked at once more: thoroughly."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SfmConfig(CheckedConfig):
    """How photographs are placed."""

    pairs: Literal["auto", "exhaustive", "sequential"] = option(
        "auto",
        "which photographs are compared: all pairs, or neighbors by name; auto = all pairs up to "
        f"{MAX_EXHAUSTIVE} photographs",
    )
    size: int = option(1600, "longer side in pixels at which features are sought", ge=64, le=100_000)
    features: int = option(8192, "most features of a photograph", ge=64, le=1_000_000)


@dataclass(frozen=True, slots=True, kw_only=True)
class Placed:
    """What structure from motion made of a folder of photographs.

    Attributes:
        placed: names of the photographs that have a pose.
        error: mean reprojection error in pixels.
    """

    model: Path
    placed: tuple[str, ...]
    missing: tuple[str, ...]
    points: int
    error: float


def photographs_in(folder: Path) -> list[str]:
    """Names of the pictures directly in a folder, sorted; hidden files are none."""
    return _names_with(folder, SUFFIXES)


def _names_with(folder: Path, suffixes: tuple[str, ...]) -> list[str]:
    entries = (entry for entry in folder.iterdir() if not entry.name.startswith("."))
    return sorted(entry.name for entry in entries if entry.suffix.lower() in suffixes)


def register_photographs(
    folder: Path,
    work: Path,
    config: SfmConfig = SfmConfig(),
    *,
    single_camera: bool = False,
    in_time: Callable[[], None] = lambda: None,
) -> Placed:
    """Finds poses and intrinsics, once every photograph was decoded. Few photographs that do not fit together are
    looked at a second time, for features that match from farther aside.

    Args:
        work: an existing folder for COLMAP's database; the model is written to `sparse/0` in it.
        single_camera: whether one camera took them all with one focal length, as the frames of a video.
        in_time: is called before each part of the work, and may end it.

    Warns:
        SceneWarning: files that look like photographs or films, and cannot be used.
    """
    names = photographs_in(folder)
    if len(names) < 3:
        raise InputError(f"{folder}: expected at least 3 photographs ({', '.join(SUFFIXES)}), found {len(names)}")
    _check(folder, names)
    # Before they are looked at: a photograph that changes meanwhile is not the one that was placed.
    inputs = _inputs(folder, names, config)
    pycolmap = load_pycolmap()
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL
    attempts, model = work / "attempts", work / "sparse" / "0"
    for stale in (work / PLACED_FILE, work / "database.db", attempts, model.parent):
        shutil.rmtree(stale, ignore_errors=True)
        stale.unlink(missing_ok=True)
    _check_room(work, len(names), config)
    models: list[Any] = []
    for thorough in (False, True):
        attempt = attempts / ("thorough" if thorough else "usual")
        attempt.mkdir(parents=True)
        try:
            models += _map(pycolmap, attempt, folder, names, config, single_camera, in_time, thorough)
        except InputError:
            raise
        except (RuntimeError, ValueError) as error:
            message = " ".join(str(error).split())[:160]
            raise InputError(f"{folder}: pycolmap cannot place these photographs: {message}") from error
        most = max((each.num_reg_images() for each in models), default=0)
        if len(names) > MAX_THOROUGH or most >= ENOUGH_PLACED * len(names):
            break
    if not models:
        raise InputError(
            f"{folder}: none of {len(names)} photographs could be placed: no two show enough of the same from places "
            "that lie apart; take more, with larger overlap, of a scene that holds still and has texture"
        )
    best: Any = max(models, key=lambda each: (each.num_reg_images(), each.num_points3D()))
    partial = model.with_name("unfinished")
    partial.mkdir(parents=True)
    best.write(partial)
    os.replace(partial, model)
    shutil.rmtree(attempts, ignore_errors=True)
    placed = sorted(best.images[number].name for number in best.reg_image_ids())
    summary = {
        "placed": placed,
        "missing": [name for name in names if name not in set(placed)],
        "points": best.num_points3D(),
        "error": float(best.compute_mean_reprojection_error()),
    }
    with atomic_file(work / PLACED_FILE) as stream:
        stream.write(json.dumps({"asked": inputs, "found": summary, "files": _digests(model)}).encode())
    return _placed(model, summary)


def load_placement(folder: Path, work: Path, config: SfmConfig = SfmConfig()) -> Placed | None:
    """The result of an earlier call in `work`, if it was completed for the same photographs and settings, and its files
    have their checksums. A second run of structure from motion with several threads need not give the same poses."""
    model = work / "sparse" / "0"
    try:
        record = json.loads(read_foreign_text(work / PLACED_FILE))
        same = model.is_dir() and record["asked"] == _inputs(folder, photographs_in(folder), config)
        sound = record["files"] == _digests(model)
        placed = _placed(model, record["found"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
    return placed if same and sound else None


def _digests(model: Path) -> dict[str, str]:
    """The SHA-256 of each file of a model."""
    return {path.name: sha256_of(path) for path in sorted(model.iterdir())}


def _inputs(folder: Path, names: list[str], config: SfmConfig) -> dict[str, Any]:
    """What tells the photographs from others of their names, and the settings."""
    states = [(folder / name).stat() for name in names]
    stamps = [[name, state.st_size, state.st_mtime_ns] for name, state in zip(names, states, strict=True)]
    return {"photographs": stamps, "settings": asdict(config)}


def _check_room(work: Path, count: int, config: SfmConfig) -> None:
    """pycolmap ends the whole process where the disk fills under its database."""
    needed, free = count * min(config.features, TYPICAL_FEATURES) * BYTES_PER_FEATURE, shutil.disk_usage(work).free
    if free < needed:
        raise InputError(
            f"{work}: placing {count} photographs may take {needed / 2**20:.0f} MiB, and {free / 2**20:.0f} are free "
            "on this disk; make room, or give a smaller sfm.features"
        )


def _check(folder: Path, names: list[str]) -> None:
    """What pycolmap would pass over in silence, or stumble over."""
    others = _names_with(folder, OTHER_SUFFIXES)
    if others:
        warnings.warn(
            f"{folder}: {len(others)} files are in formats that cannot be placed and are not used: "
            f"{listed(others)}; expected {', '.join(SUFFIXES)}, or a video by itself",
            SceneWarning,
            stacklevel=3,
        )
    for name in names:
        try:
            name.encode()
        except UnicodeEncodeError:
            raise InputError(
                f"{folder}: {name!r} has bytes that are no text; give the photograph another name"
            ) from None
        check_picture(folder / name)


def _placed(model: Path, found: Mapping[str, Any]) -> Placed:
    names = {kind: tuple(found[kind]) for kind in ("placed", "missing")}
    return Placed(model=model, **names, points=found["points"], error=found["error"])


def _map(
    pycolmap: Any,
    work: Path,
    folder: Path,
    names: list[str],
    config: SfmConfig,
    single_camera: bool,
    in_time: Callable[[], None],
    thorough: bool,
) -> list[Any]:
    """The models that COLMAP makes of the photographs, in a folder of their own: features, matches, poses."""
    database, cpu = work / "database.db", pycolmap.Device.cpu
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.max_image_size = config.size
    extraction.use_gpu = False
    extraction.sift.max_num_features = config.features
    # Features that follow the slant of surfaces match from farther aside, and take several times as long.
    extraction.sift.estimate_affine_shape = extraction.sift.domain_size_pooling = thorough
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = CAMERA
    mode = pycolmap.CameraMode.SINGLE if single_camera else pycolmap.CameraMode.AUTO
    options = {"camera_mode": mode, "reader_options": reader, "extraction_options": extraction, "device": cpu}
    pycolmap.extract_features(database, folder, image_names=names, **options)
    in_time()
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu = False
    matching.guided_matching = thorough
    if config.pairs == "exhaustive" or (config.pairs == "auto" and len(names) <= MAX_EXHAUSTIVE):
        pycolmap.match_exhaustive(database, matching_options=matching, device=cpu)
    else:
        # Neighbors by name, and those 2, 4, 8, … places away.
        pairing = pycolmap.SequentialPairingOptions()
        pairing.overlap = max(10, math.ceil(math.log2(len(names))))
        pairing.quadratic_overlap = True
        pycolmap.match_sequential(database, matching_options=matching, pairing_options=pairing, device=cpu)
    in_time()
    mapping = pycolmap.IncrementalPipelineOptions()
    mapping.random_seed = 0
    mapping.ba_refine_principal_point = False
    if thorough:
        # Half of COLMAP's own: few photographs have few matches in common.
        mapping.mapper.abs_pose_min_num_inliers, mapping.mapper.init_min_num_inliers = 15, 50
        mapping.mapper.abs_pose_min_inlier_ratio = 0.15
    return list(pycolmap.incremental_mapping(database, folder, work, options=mapping).values())


START_AGAIN = "give resume=false to start again"
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
    """What can be reconstructed at paths: scenes, folders of photographs alone, videos, folders of these, and lists
    (.txt) of them."""
    chosen: list[Path] = []
    for path in listed_paths(paths):
        if not path.exists():
            raise InputError(f"{path}: no such file or folder")
        scenes = [path]
        if path.is_dir() and not is_scene(path) and _pictures_of(path) is None:
            entries = sorted(entry for entry in path.iterdir() if not entry.name.startswith("."))
            scenes = [
                entry
                for entry in entries
                if is_video(entry) or (entry.is_dir() and (is_scene(entry) or _pictures_of(entry) is not None))
            ]
        # Of a path that holds nothing `find_scenes` says what was expected.
        chosen += scenes or find_scenes([path])
    return distinct_paths(chosen)


def _pictures_of(path: Path) -> Path | None:
    """The folder of the photographs of a scene: itself, or its folder images."""
    return next((folder for folder in (path, path / "images") if folder.is_dir() and photographs_in(folder)), None)


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
        work: an existing folder for the COLMAP model; one that an interrupted run completed there is used again.
        splat: file of Gaussians to refine; empty = none.
        video: which frames of a video are taken; they are written to `images` in `work`.
        in_time: is called while photographs are registered, and may end it.

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
            "start again"
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
    with error_hint(START_AGAIN):
        scene = load_scene(work, options=replace(data, images=str(pictures)))
    return OpenedScene(scene=scene, sfm=placed, photographs=pictures, is_video=path.is_file(), seconds=clock.seconds)
