"""Posed images, the result of every reader of views, and checks that readers share: paths, numbers, poses, origin."""

import math
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.readers.depth_images import DepthMeasure
from gsencoder.data.readers.undistort import CameraModel

RIGID_TOLERANCE = 1e-3
"""Largest difference from 1 of a singular value of a rotation; below it is rounding in the file."""
MAX_PATH = 4096
"""Largest number of characters of a path: PATH_MAX of Linux, which other systems do not exceed."""
MAX_COORDINATE = 1e12
"""Largest coordinate, where float64 has steps of a tenth of a millimeter."""
ORIGIN_STEP = 1000.0
FOLDERS_OF_LAYOUT = {"COLMAP": "sparse colmap", "ScanNet": "pose intrinsic", "ScanNet++": "scans colmap nerfstudio"}
"""Folders that are read beside those of the files of views."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PosedImage:
    """One view of a scene as its files describe it.

    Attributes:
        name: unique in the scene.
        camera: intrinsics with distortion.
        cam_from_world: rigid, OpenCV axes, in the world of the file (no origin subtracted).
        image: an existing photograph.
        depth: sensor depth, or None.
        depth_camera: the camera of the depth map; None = that of the photograph.
        depth_from_color: where the depth camera stands, rigid, from the axes of the photograph's camera to its own, in
            world units; None = both look from one place.
        depth_scale: world units for each step of the depth file.
        no_depth: a step of the depth file that means none, besides 0.
        depth_measure: whether a depth is the coordinate z or the length of the ray.
        mask: pixels to use, or None.
        instance: instance map, or None.
    """

    name: str
    camera: CameraModel
    cam_from_world: Float64[np.ndarray, "4 4"]
    image: Path
    depth: Path | None = None
    depth_camera: CameraModel | None = None
    depth_from_color: Float64[np.ndarray, "4 4"] | None = None
    depth_scale: float = 1.0
    no_depth: int | None = None
    depth_measure: DepthMeasure = "z"
    mask: Path | None = None
    instance: Path | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PosedImages:
    """The views of a scene and its world; coordinates are those of the files, in float64.

    Attributes:
        points_file: a .ply that holds the points; None where another file does.
        unused: what the files say that was not used, in words.
    """

    source: str
    images: tuple[PosedImage, ...]
    metres_per_unit: float | None = None
    up: Float64[np.ndarray, "3"] | None = None
    points: Float64[np.ndarray, "P 3"] = field(default_factory=lambda: np.zeros((0, 3)))
    colors: UInt8[np.ndarray, "_ 3"] = field(default_factory=lambda: np.zeros((0, 3), np.uint8))
    points_file: Path | None = None
    unused: tuple[str, ...] = ()

    def unused_folders(self, root: Path | None, layout: str) -> tuple[str, ...]:
        """Folders in that of the scene, and beside those of its photographs, of which nothing was read."""
        if root is None:
            return ()
        paths = [path for each in self.images for path in (each.image, each.depth, each.mask, each.instance)]
        used = {home for path in {*paths, self.points_file} if path for home in (path, *path.parents)}
        levels = {root, *(level for path in {each.image.parent for each in self.images} for level in path.parents)}
        folders = {
            entry.relative_to(root).as_posix()
            for level in levels
            if level.is_relative_to(root)
            for entry in level.iterdir()
            if entry.is_dir() and entry not in used and entry.name not in FOLDERS_OF_LAYOUT.get(layout, "").split()
        }
        return tuple(sorted(name for name in folders if not name.startswith(".")))


def choose_origin(points: Float64[np.ndarray, "P 3"]) -> Float64[np.ndarray, "3"]:
    """The mean of `points`, each coordinate rounded to a multiple of 1000 units; zero for none.

    A scene near zero keeps its coordinates. One far away gets a round offset, which is subtracted in float64 before
    positions are rounded to float32; a scene that is moved by a multiple of 1000 has the same float32 coordinates.
    """
    if not len(points):
        return np.zeros(3)
    return np.round(points.mean(axis=0) / ORIGIN_STEP) * ORIGIN_STEP + 0.0


def rigid_pose(matrix: Float64[np.ndarray, "4 4"], where: str) -> Float64[np.ndarray, "4 4"]:
    """The pose with the nearest exact rotation, by SVD, since files hold a few digits only."""
    if not np.isfinite(matrix).all():
        raise InputError(f"{where}: the pose has values that are not finite")
    if np.abs(matrix[3] - (0, 0, 0, 1)).max() > 1e-6:
        raise InputError(f"{where}: the last row of the pose must be 0 0 0 1, got {matrix[3].tolist()}")
    if np.abs(matrix[:3, 3]).max() > MAX_COORDINATE:
        raise InputError(
            f"{where}: the camera is {np.abs(matrix[:3, 3]).max():g} units away; at most {MAX_COORDINATE:g}"
        )
    if np.abs(matrix[:3, :3]).max() > 1e6:
        raise InputError(
            f"{where}: the pose is not rigid (entries of {np.abs(matrix[:3, :3]).max():g} in its rotation)"
        )
    left, stretch, right = np.linalg.svd(matrix[:3, :3])
    if np.abs(stretch - 1).max() > RIGID_TOLERANCE:
        if stretch[2] <= 1e-9 * stretch[0] or stretch[0] < 1e-9:
            raise InputError(f"{where}: the pose is singular (singular values {_list(stretch)}), expected a rotation")
        if stretch[0] - stretch[2] <= RIGID_TOLERANCE * stretch[0]:
            raise InputError(
                f"{where}: the pose has a uniform scale of {stretch.mean():.6g}; divide its rotation by it "
                "(poses must be rigid, scene scale belongs in the translations)"
            )
        raise InputError(f"{where}: the pose is not rigid (singular values {_list(stretch)}, expected 1, 1, 1)")
    rotation = left @ right
    if np.linalg.det(rotation) < 0:
        raise InputError(f"{where}: the pose mirrors the world (determinant -1), expected a rotation")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, matrix[:3, 3]
    return pose


def _list(values: np.ndarray) -> str:
    return ", ".join(f"{value:.6g}" for value in values)


def inside(folder: Path, relative: str, where: str, *, root: Path | None = None, allow_outside: bool = False) -> Path:
    """`folder / relative`, which may not leave `root` through "..", an absolute path or a link unless allowed.

    Args:
        relative: as written in the files of the scene.
        root: the scene folder; None = `folder`.
    """
    root = folder if root is None else root
    # No file has a longer path, and resolving links takes time quadratic in the length.
    if len(relative) > MAX_PATH:
        raise InputError(
            f"{where}: {relative[:80]!r}… is not a path ({len(relative):,} characters, at most {MAX_PATH:,})"
        )
    try:
        path = folder / relative
        leaves = not path.resolve().is_relative_to(root.resolve())
        path.is_file()
    except (OSError, ValueError, RuntimeError) as error:
        raise InputError(f"{where}: {relative[:80]!r} is not a path ({type(error).__name__})") from error
    if leaves and not allow_outside:
        raise InputError(
            f"{where}: {relative[:200]!r} leads out of the scene folder {root}; "
            "copy the file into it, or set allow_outside=true if you trust the scene"
        )
    return path


def number(values: Mapping[str, object], key: str, where: str) -> float | None:
    """A finite number of a JSON object; None if the key is missing."""
    value = values.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputError(f"{where}: {key} must be a number, got {str(value)[:40]!r}")
    try:
        finite = math.isfinite(value)
    except OverflowError:
        finite = False
    if not finite:
        raise InputError(f"{where}: {key} must be finite, got {str(value)[:40]}")
    return float(value)


def warn_left_out(missing: Iterable[str], total: int, source: str, subject: str, result: str) -> None:
    """Warns once, with a count, about files that are listed but missing, if there are any."""
    names = list(missing)
    if names:
        warnings.warn(
            f"{source}: {len(names)} of {total} {subject} are missing (first: {names[0][:200]!r}); {result}",
            SceneWarning,
            stacklevel=3,
        )
