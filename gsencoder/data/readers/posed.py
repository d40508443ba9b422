"""Posed images, the result of every reader of views, and checks that readers share: paths, numbers, poses, origin."""

import sys
import warnings
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float64, UInt8

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.readers.undistort import CameraModel
from gsencoder.types.checks import invert_rigid

RIGID_TOLERANCE = 1e-3  # Largest difference from 1 of a singular value of a rotation; below it is rounding in the file
MAX_PATH = 4096  # Largest number of characters of a path: PATH_MAX of Linux, which other systems do not exceed
MAX_COORDINATE = 1e12  # Largest coordinate, where float64 has steps of a tenth of a millimeter
ORIGIN_STEP = 1000.0
DepthMeasure = Literal["z", "ray"]
"""What the numbers of a depth file are: the coordinate z in the camera, or the distance from its center."""
FOLDERS_OF_LAYOUT = {"COLMAP": "sparse colmap", "ScanNet": "pose intrinsic", "ScanNet++": "scans colmap nerfstudio"}
"""Folders that are read with those of the files of views."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReadOptions:
    """What the user says about a scene's files, beyond the files themselves."""

    allow_outside: bool = False  # whether files may lie outside the folder of the scene
    images: str = ""  # folder of the photographs of a COLMAP model; empty = images/ next to the model
    # fx, fy, cx, cy of the photographs, for layouts that do not state them; None = those of the layout.
    intrinsics: tuple[float, float, float, float] | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PosedImage:
    """One view of a scene as its files describe it."""

    name: str  # unique in the scene
    camera: CameraModel  # intrinsics with distortion
    cam_from_world: Float64[np.ndarray, "4 4"]  # rigid, OpenCV axes, in the world of the file (no origin subtracted)
    image: Path  # an existing photograph
    depth: Path | None = None  # sensor depth, or None
    depth_camera: CameraModel | None = None  # the camera of the depth map; None = that of the photograph
    # Where the depth camera stands, rigid, from the axes of the photograph's camera to its own, in world units; None =
    # both look from one place.
    depth_from_color: Float64[np.ndarray, "4 4"] | None = None
    depth_scale: float = 1.0  # world units for each step of the depth file
    no_depth: int | None = None  # a step of the depth file that means none, besides 0
    depth_measure: DepthMeasure = "z"  # whether a depth is the coordinate z or the length of the ray
    mask: Path | None = None  # pixels to use, or None
    instance: Path | None = None  # instance map, or None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PosedImages:
    """The views of a scene and its world; coordinates are those of the files, in float64."""

    source: str
    images: tuple[PosedImage, ...]
    metres_per_unit: float | None = None
    up: Float64[np.ndarray, "3"] | None = None
    points: Float64[np.ndarray, "P 3"] = field(default_factory=lambda: np.zeros((0, 3)))
    colors: UInt8[np.ndarray, "_ 3"] = field(default_factory=lambda: np.zeros((0, 3), np.uint8))
    points_file: Path | None = None  # a .ply that holds the points; None where another file does
    unused: tuple[str, ...] = ()  # what the files say that was not used, in words

    def unused_folders(self, root: Path | None, layout: str) -> tuple[str, ...]:
        """Folders in that of the scene, and next to those of its photographs, of which nothing was read."""
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

    A scene near zero keeps its coordinates. One that is moved by a multiple of 1000 has the same float32 coordinates.
    """
    if not len(points):
        return np.zeros(3)
    return np.round(points.mean(axis=0) / ORIGIN_STEP) * ORIGIN_STEP + 0.0


def rigid_pose(matrix: Float64[np.ndarray, "4 4"], where: str) -> Float64[np.ndarray, "4 4"]:
    """The pose with the nearest exact rotation, by SVD, since files hold a few digits only; `where` begins errors."""
    if not np.isfinite(matrix).all():
        raise InputError(f"{where}: the pose has values that are not finite")
    if np.abs(matrix[3] - (0, 0, 0, 1)).max() > 1e-6:
        raise InputError(f"{where}: the last row of the pose must be 0 0 0 1, got {matrix[3].tolist()}")
    far = np.abs(matrix[:3, 3]).max()
    if far > MAX_COORDINATE:
        raise InputError(f"{where}: the camera is {far:g} units away; at most {MAX_COORDINATE:g}")
    left, stretch, right = np.linalg.svd(matrix[:3, :3])
    if np.abs(stretch - 1).max() > RIGID_TOLERANCE:
        if stretch[2] > 0 and stretch[0] - stretch[2] <= RIGID_TOLERANCE * stretch[0]:
            scale = f"a uniform scale of {stretch.mean():.6g}"
            raise InputError(f"{where}: the pose has {scale}; divide its rotation by it")
        values = ", ".join(f"{value:.6g}" for value in stretch)
        raise InputError(f"{where}: the pose is not rigid (singular values {values}, expected 1, 1, 1)")
    rotation = left @ right
    if np.linalg.det(rotation) < 0:
        raise InputError(f"{where}: the pose mirrors the world (determinant -1), expected a rotation")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, matrix[:3, 3]
    return pose


def inside(folder: Path, relative: str, where: str, *, root: Path | None = None, allow_outside: bool = False) -> Path:
    """`folder / relative`, which may not leave `root` (None = `folder`) through "..", an absolute path or a link unless
    allowed."""
    root = folder if root is None else root
    # No file has a longer path, and resolving links takes time quadratic in the length.
    if len(relative) > MAX_PATH:
        raise InputError(f"{where}: {relative[:80]!r}… is not a path ({len(relative):,} characters)")
    try:
        path = folder / relative
        leaves = not path.resolve().is_relative_to(root.resolve())
        path.is_file()
    except (OSError, ValueError, RuntimeError) as error:
        raise InputError(f"{where}: {relative[:80]!r} is not a path ({type(error).__name__})") from error
    if leaves and not allow_outside:
        raise InputError(
            f"{where}: {relative[:200]!r} leads out of the scene folder {root} (allow_outside=true allows it)"
        )
    return path


def number(values: Mapping[str, object], key: str, where: str) -> float | None:
    """A finite number of a JSON object; None if the key is missing."""
    value = values.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputError(f"{where}: {key} must be a number, got {str(value)[:40]!r}")
    if not abs(value) <= sys.float_info.max:
        raise InputError(f"{where}: {key} must be finite, got {str(value)[:40]}")
    return float(value)


def numbers(values: Mapping[str, object], key: str, where: str, *shapes: tuple[int, ...]) -> Float64[np.ndarray, "..."]:
    """An array of one of the shapes from lists of numbers in a JSON object. NaN and infinity are numbers."""
    array = np.array(values.get(key), object)
    if array.shape in shapes and all(type(entry) in (int, float) for entry in array.flat):
        with suppress(OverflowError):
            return array.astype(np.float64)
    expected = " or ".join("×".join(map(str, shape)) for shape in shapes)
    raise InputError(f"{where}: {key} must be {expected} numbers, got {str(values.get(key))[:60]}")


def warn_left_out(missing: Iterable[str], total: int, source: str, subject: str, result: str) -> None:
    """Warns once, with a count, about files that are listed but missing, if there are any."""
    names = list(missing)
    if names:
        warnings.warn(
            f"{source}: {len(names)} of {total} {subject} are missing (first: {names[0][:200]!r}); {result}",
            SceneWarning,
            stacklevel=3,
        )


class Frames:
    """The views of a sequence as they are read, and the frames that are left out, counted by reason."""

    def __init__(self, root: Path, total: int, options: ReadOptions) -> None:
        self.root, self.total, self.options = root, total, options
        self.images: list[PosedImage] = []
        self._skipped: dict[str, list[str]] = {}

    def skip(self, reason: str, name: str) -> None:
        """Leaves a frame out."""
        self._skipped.setdefault(reason, []).append(name)

    def check_inside(self, name: str, *files: Path | None) -> None:
        """Raises InputError where a file of a frame leads out of the folder."""
        for file in filter(None, files):
            relative = str(file.relative_to(self.root))
            inside(self.root, relative, f"{self.root}: {name[:120]}", allow_outside=self.options.allow_outside)

    def pose(self, world_from_cam: Float64[np.ndarray, "4 4"], name: str, where: str) -> np.ndarray | None:
        """cam_from_world of a frame; None, and the frame is left out, where tracking was lost: sequences write -inf,
        inf or NaN there."""
        if not np.isfinite(world_from_cam).all():
            self.skip("lost tracking", name)
            return None
        return invert_rigid(rigid_pose(world_from_cam, where))

    def finish(self, *, depth: bool, up: bool = True, source: str = "") -> PosedImages:
        """The views, in metres, with z up or an unknown up; warns once for each reason to leave frames out, and, with
        `depth`, of views that lack it."""
        counts = ", ".join(f"{len(names)} {reason}" for reason, names in self._skipped.items()) or "none has a picture"
        if not self.images:
            raise InputError(f"{self.root}: no view: of {self.total} pictures {counts}")
        for reason, names in self._skipped.items():
            warnings.warn(
                f"{self.root}: {len(names)} of {self.total} frames {reason} and are left out (first: {names[0]!r})",
                SceneWarning,
                stacklevel=3,
            )
        if depth:
            without = [image.name for image in self.images if image.depth is None]
            warn_left_out(without, len(self.images), str(self.root), "depth files", "those views have no depth")
        return PosedImages(
            source=source or str(self.root),
            images=tuple(self.images),
            metres_per_unit=1.0,
            up=np.array([0.0, 0.0, 1.0]) if up else None,
        )
