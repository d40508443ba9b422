"""Structure from motion for photographs without poses, by pycolmap on a CPU."""

import hashlib
import json
import math
import os
import shutil
import warnings
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from gsencoder.core.errors import InputError, SceneWarning, listed
from gsencoder.core.files import atomic_file, read_foreign_text, sha256_of
from gsencoder.data.readers.images import check_picture
from gsencoder.data.readers.undistort import load_pycolmap
from gsencoder.data.video import SUFFIXES as VIDEO_SUFFIXES

SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".ppm")
OTHER_SUFFIXES = (".webp", ".heic", ".heif", ".avif", ".gif", ".dng", ".cr2", ".nef", ".arw", *VIDEO_SUFFIXES)
"""Pictures and videos that pycolmap does not read; that they are left out is said."""
MAX_PIXELS, MAX_FEATURES = 100_000, 1_000_000
PLACED_FILE = "placed.json"
BYTES_PER_FEATURE, TYPICAL_FEATURES = 160, 8192
"""In the database: descriptor and place. Photographs seldom have more, whatever is allowed."""
MAX_EXHAUSTIVE = 150
"""Up to so many photographs all pairs are compared."""
MAX_THOROUGH, ENOUGH_PLACED = 30, 0.8
"""Up to so many photographs, of which less than this share could be placed, are looked at once more: thoroughly."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SfmConfig:
    """How photographs are placed."""

    pairs: Literal["auto", "exhaustive", "sequential"] = field(
        default="auto",
        metadata={
            "help": "which photographs are compared: all pairs, or neighbors by name; auto = all pairs up to "
            f"{MAX_EXHAUSTIVE} photographs"
        },
    )
    size: int = field(default=1600, metadata={"help": "longer side in pixels at which features are sought"})
    features: int = field(default=8192, metadata={"help": "most features of a photograph"})
    camera: str = field(default="SIMPLE_RADIAL", metadata={"help": "COLMAP's camera model"})

    def __post_init__(self) -> None:
        for name, most in (("size", MAX_PIXELS), ("features", MAX_FEATURES)):
            if not 64 <= getattr(self, name) <= most:
                raise InputError(f"{name}: expected 64 to {most}, got {getattr(self, name)}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Placed:
    """What structure from motion made of a folder of photographs.

    Attributes:
        model: folder of the COLMAP model.
        placed: names of the photographs that have a pose.
        missing: names of those that have none.
        points: points of the model.
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
    """Finds poses and intrinsics. Every photograph is decoded before. Few photographs that do not fit together are
    looked at a second time, for features that match from farther aside.

    Args:
        folder: of the photographs.
        work: an existing folder for COLMAP's database; the model is written to `sparse/0` in it.
        config: settings.
        single_camera: whether one camera took them all with one focal length, as the frames of a video.
        in_time: is called before each part of the work, and may end it.

    Raises:
        InputError: fewer than three photographs, one that cannot be decoded or has a name that is no UTF-8, no two
            that fit together, or pycolmap refuses.

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
    camera_models = sorted(set(pycolmap.CameraModelId.__members__) - {"INVALID"})
    if config.camera not in camera_models:
        raise InputError(f"sfm.camera: expected one of {', '.join(camera_models)}, got {config.camera!r}")
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
    record = {"asked": inputs, "found": summary, "files": _digests(model)}
    with atomic_file(work / PLACED_FILE) as stream:
        stream.write(json.dumps({**record, "digest": _digest(record)}).encode())
    return _placed(model, summary)


def load_placement(folder: Path, work: Path, config: SfmConfig = SfmConfig()) -> Placed | None:
    """The result of an earlier call in `work`, if it was completed for the same photographs and settings, and its files
    have their checksums. A second run of structure from motion with several threads need not give the same poses.

    Args:
        folder: of the photographs.
        work: that the call was given.
        config: that it was given.
    """
    model = work / "sparse" / "0"
    try:
        record = json.loads(read_foreign_text(work / PLACED_FILE))
        same = model.is_dir() and record["asked"] == _inputs(folder, photographs_in(folder), config)
        sound = record.pop("digest") == _digest(record) and record["files"] == _digests(model)
        placed = _placed(model, record["found"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
    return placed if same and sound else None


def _digests(model: Path) -> dict[str, str]:
    """The SHA-256 of each file of a model."""
    return {path.name: sha256_of(path) for path in sorted(model.iterdir())}


def _digest(record: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()


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


def _placed(model: Path, summary: Mapping[str, Any]) -> Placed:
    if not isinstance(summary["placed"], list) or not isinstance(summary["missing"], list):
        raise TypeError("expected lists of names")
    return Placed(
        model=model,
        placed=tuple(summary["placed"]),
        missing=tuple(summary["missing"]),
        points=summary["points"],
        error=summary["error"],
    )


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
    """The models that COLMAP makes of the photographs, in a folder of their own."""
    database = work / "database.db"
    _find_features(pycolmap, database, folder, names, config, single_camera, thorough)
    in_time()
    _match(pycolmap, database, len(names), config, thorough)
    in_time()
    models = pycolmap.incremental_mapping(database, folder, work, options=_mapping(pycolmap, thorough))
    return list(models.values())


def _find_features(
    pycolmap: Any,
    database: Path,
    folder: Path,
    names: list[str],
    config: SfmConfig,
    single_camera: bool,
    thorough: bool,
) -> None:
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.max_image_size = config.size
    extraction.use_gpu = False
    extraction.sift.max_num_features = config.features
    # Features that follow the slant of surfaces match from farther aside, and take several times as long.
    extraction.sift.estimate_affine_shape = extraction.sift.domain_size_pooling = thorough
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = config.camera
    pycolmap.extract_features(
        database,
        folder,
        image_names=names,
        camera_mode=pycolmap.CameraMode.SINGLE if single_camera else pycolmap.CameraMode.AUTO,
        reader_options=reader,
        extraction_options=extraction,
        device=pycolmap.Device.cpu,
    )


def _match(pycolmap: Any, database: Path, count: int, config: SfmConfig, thorough: bool) -> None:
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu = False
    matching.guided_matching = thorough
    every = config.pairs == "exhaustive" or (config.pairs == "auto" and count <= MAX_EXHAUSTIVE)
    if every:
        pycolmap.match_exhaustive(database, matching_options=matching, device=pycolmap.Device.cpu)
        return
    # Neighbors by name, and those 2, 4, 8, … places away.
    pairing = pycolmap.SequentialPairingOptions()
    pairing.overlap = max(10, math.ceil(math.log2(count)))
    pairing.quadratic_overlap = True
    pycolmap.match_sequential(database, matching_options=matching, pairing_options=pairing, device=pycolmap.Device.cpu)


def _mapping(pycolmap: Any, thorough: bool) -> Any:
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = 0
    options.ba_refine_principal_point = False
    if thorough:
        # Half of COLMAP's own: few photographs have few matches in common.
        options.mapper.abs_pose_min_num_inliers, options.mapper.init_min_num_inliers = 15, 50
        options.mapper.abs_pose_min_inlier_ratio = 0.15
    return options
