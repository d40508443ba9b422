"""Posed images, the result of every reader of views, and checks that readers share: paths, numbers, poses, origin;
and undistortion: the pinhole camera that replaces a distorted one, and the map from its pixels to those of the
file.

The center of every pinhole pixel is turned into a ray and projected through the distorted model by pycolmap, so the
map is exact; nothing is fitted. A pixel is used only if that ray lies within 85° of the axis, lands inside the
picture, and is what the model gives back when it is inverted there: a polynomial that folds over itself puts several
rays on one pixel, and only the innermost is real.

The pinhole keeps the picture's size and principal point. Both focal lengths are multiplied by one zoom, the smallest
between 0.7 and 1.3 at which the whole pinhole picture is covered by the distorted one. Where no such zoom exists it is
1, and the pixels without content are masked. The optical center and the axes stay, so poses and depths do too.
"""

import math
import signal
import sys
import threading
import warnings
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.files import read_foreign_text
from gsencoder.types.scene import (
    SceneObject,
    intrinsic_matrix,
    invert_rigid,
    pixel_centers,
    project_points,
    unproject_points,
)

MAX_HALF_FIELD = math.radians(85)  # Rays further from the optical axis than this (a field of view of 170°) are not used
MIN_ZOOM, MAX_ZOOM = 0.7, 1.3
MIN_USED = 0.5  # A camera of which fewer pixels than this share can be undistorted is refused
MAX_SIDE = 65_535
PIXEL_TOLERANCE = 0.01  # How far, in pixels, a ray may come back from its place when a model is inverted there

_FOCALS = {
    "SIMPLE_PINHOLE": 1, "SIMPLE_RADIAL": 1, "RADIAL": 1, "SIMPLE_FISHEYE": 1, "SIMPLE_RADIAL_FISHEYE": 1,
    "RADIAL_FISHEYE": 1, "SIMPLE_DIVISION": 1, "PINHOLE": 2, "OPENCV": 2, "FULL_OPENCV": 2, "OPENCV_FISHEYE": 2,
    "FOV": 2, "FISHEYE": 2, "EUCM": 2, "DIVISION": 2, "THIN_PRISM_FISHEYE": 2, "RAD_TAN_THIN_PRISM_FISHEYE": 2,
}  # fmt: skip
_STRAIGHT_AT_ZERO = ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "SIMPLE_DIVISION", "DIVISION")


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraModel:
    """A camera as a file describes it, distortion included."""

    model: str  # one of COLMAP's camera model names
    width: int  # of the picture, pixels
    height: int  # of the picture, pixels
    # COLMAP's parameters of that model: focal lengths, principal point (pixel centers at .5), distortion.
    params: tuple[float, ...]

    @property
    def is_pinhole(self) -> bool:
        """True where there is no distortion to remove."""
        distortion = self.params[_FOCALS.get(self.model, 2) + 2 :]
        return self.model in ("PINHOLE", "SIMPLE_PINHOLE") or (self.model in _STRAIGHT_AT_ZERO and not any(distortion))

    def pinhole_params(self) -> tuple[float, float, float, float]:
        """(fx, fy, cx, cy) of the model, distortion left out."""
        if _FOCALS[self.model] == 1:
            return (self.params[0], *self.params[:3])  # type: ignore[return-value]
        return self.params[:4]  # type: ignore[return-value]

    def matrix(self, width: int, height: int) -> Float64[np.ndarray, "3 3"]:
        """K of the model, distortion left out, for the same picture resized to width × height."""
        fx, fy, cx, cy = self.pinhole_params()
        sx, sy = width / self.width, height / self.height
        return intrinsic_matrix(fx * sx, fy * sy, cx * sx, cy * sy)

    def reduced(self, factor: int) -> "CameraModel":
        """The pinhole of pixels that stand for factor × factor of this one's; the last ones may be cut off."""
        width, height = (-(-side // factor) for side in (self.width, self.height))
        params = tuple(value / factor for value in self.pinhole_params())
        return CameraModel(model="PINHOLE", width=width, height=height, params=params)


def focal_count(camera: CameraModel) -> int:
    """Whether a model has one focal length or two; they come first in its parameters."""
    return _FOCALS.get(camera.model, 2)


def check_camera(camera: CameraModel, where: str) -> None:
    """Raises InputError where the camera cannot be used."""
    if camera.model not in _FOCALS:
        raise InputError(f"{where}: camera model {camera.model} is not supported; expected {', '.join(_FOCALS)}")
    if not (0 < camera.width <= MAX_SIDE and 0 < camera.height <= MAX_SIDE):
        raise InputError(f"{where}: picture size {camera.width}×{camera.height}, expected sides of 1 to {MAX_SIDE}")
    if len(camera.params) < _FOCALS[camera.model] + 2 or not all(map(math.isfinite, camera.params)):
        raise InputError(f"{where}: intrinsics of {camera.model} must be finite numbers, got {list(camera.params)}")
    fx, fy, cx, cy = camera.pinhole_params()
    side = max(camera.width, camera.height)
    # A fisheye lens that sees half of the world has a focal length of a third of its picture.
    if not (min(fx, fy) >= 1e-4 * side and max(fx, fy, abs(cx), abs(cy)) <= 1e4 * side):
        raise InputError(
            f"{where}: focal length {fx:g}, {fy:g} or principal point {cx:g}, {cy:g} is not a camera's in pixels"
        )
    if camera.is_pinhole:
        half = max(abs(side_x) / fx for side_x in (cx, camera.width - cx))
        half = max(half, max(abs(side_y) / fy for side_y in (cy, camera.height - cy)))
        if half > math.tan(MAX_HALF_FIELD):
            raise InputError(f"{where}: focal length {fx:g}, {fy:g} gives a field of view beyond 170°")
    else:
        _colmap_camera(camera, where)


def load_pycolmap() -> Any:
    """The pycolmap module, which must be imported through here and nowhere else.

    Its wheel for Linux (4.2.1) exports zlib's functions and depends on the system's libz. If it is what loads libz,
    libz calls into it, and the next zlib stream of anyone (a PNG written by Pillow, zlib.compress) aborts the process.
    Loading libz first, through Python's own module, keeps the two apart. It also puts handlers of its own over those of
    signals, which end the process with a page of addresses and none of the cleaning up; ours are put back.
    """
    import zlib  # noqa: F401

    first = "pycolmap" not in sys.modules
    import pycolmap

    if first and threading.current_thread() is threading.main_thread():
        for name in ("SIGTERM", "SIGHUP", "SIGINT"):
            handler = signal.getsignal(getattr(signal, name)) if hasattr(signal, name) else None
            if handler is not None:
                signal.signal(getattr(signal, name), handler)
    return pycolmap


def _colmap_camera(camera: CameraModel, where: str) -> Any:
    pycolmap = load_pycolmap()
    # Pycolmap reads past the end of a short parameter list unless it is checked first.
    converted = pycolmap.Camera(
        model=camera.model, width=camera.width, height=camera.height, params=list(camera.params)
    )
    if not converted.verify_params():
        raise InputError(f"{where}: {len(camera.params)} parameters do not fit the camera model {camera.model}")
    return converted


def _project(
    camera: CameraModel, K: Float64[np.ndarray, "3 3"], pixels: Float64[np.ndarray, "P 2"]
) -> tuple[Float64[np.ndarray, "P 2"], Bool[np.ndarray, " P"]]:
    """Where pixels of the pinhole K lie in the distorted picture, and which of them are usable."""
    rays = unproject_points(pixels, np.ones(len(pixels)), K)
    valid = np.hypot(rays[:, 0], rays[:, 1]) <= math.tan(MAX_HALF_FIELD)
    if camera.is_pinhole:
        where = np.ascontiguousarray(project_points(rays, intrinsic_matrix(*camera.pinhole_params())))
    else:
        converted = _colmap_camera(camera, camera.model)
        where = np.asarray(converted.img_from_cam(rays), dtype=np.float64)
        back = np.asarray(converted.cam_from_img(np.nan_to_num(where)), dtype=np.float64)
        with np.errstate(invalid="ignore", over="ignore"):
            valid &= (np.abs(back - rays[:, :2]) * (K[0, 0], K[1, 1])).max(axis=1) <= PIXEL_TOLERANCE
    with np.errstate(invalid="ignore"):
        valid &= (where >= 0).all(axis=1) & (where <= (camera.width, camera.height)).all(axis=1)
    return where, valid


def pinhole_for(camera: CameraModel, where: str) -> CameraModel:
    """The pinhole camera that stands for `camera` (see the head of this file)."""
    check_camera(camera, where)
    fx, fy, cx, cy = camera.pinhole_params()
    w, h = camera.width, camera.height
    zoom = 1.0
    if not camera.is_pinhole:
        across, down = np.arange(w) + 0.5, np.arange(h) + 0.5
        border = [np.column_stack([across, np.full(w, y)]) for y in (0.5, h - 0.5)]
        border += [np.column_stack([np.full(h, x), down]) for x in (0.5, w - 0.5)]
        rim = np.concatenate(border)

        def covered(zoom: float) -> bool:
            return bool(_project(camera, intrinsic_matrix(fx * zoom, fy * zoom, cx, cy), rim)[1].all())

        if covered(MIN_ZOOM):
            zoom = MIN_ZOOM
        elif covered(MAX_ZOOM):
            low, high = MIN_ZOOM, MAX_ZOOM
            for _ in range(14):
                middle = (low + high) / 2
                low, high = (low, middle) if covered(middle) else (middle, high)
            zoom = high
        coarse = np.stack(np.meshgrid(np.linspace(0.5, w - 0.5, 33), np.linspace(0.5, h - 0.5, 33)), -1).reshape(-1, 2)
        share = _project(camera, intrinsic_matrix(fx * zoom, fy * zoom, cx, cy), coarse)[1].mean()
        if share < MIN_USED:
            raise InputError(
                f"{where}: {camera.model} with {list(camera.params)} can be inverted on only {share:.0%} of its pixels "
                "within 170°; check the calibration, or undistort the images yourself"
            )
    return CameraModel(model="PINHOLE", width=w, height=h, params=(fx * zoom, fy * zoom, cx, cy))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Remap:
    """For each pixel of a pinhole picture its place in the file's picture; NaN where it has none."""

    x: Float32[np.ndarray, "H W"]  # columns in the file's picture, pixel centers at .5
    y: Float32[np.ndarray, "H W"]  # rows in the file's picture

    @property
    def valid(self) -> Bool[np.ndarray, "H W"]:
        return np.isfinite(self.x)

    def bilinear(self, picture: np.ndarray) -> np.ndarray:
        """uint8 [h, w, C] resampled to [H, W, C]; pixels without content are black. Edges are repeated half a pixel."""
        h, w, channels = picture.shape
        x = np.clip(np.nan_to_num(self.x) - np.float32(0.5), 0, w - 1)
        y = np.clip(np.nan_to_num(self.y) - np.float32(0.5), 0, h - 1)
        left, top = np.minimum(x.astype(np.int32), max(w - 2, 0)), np.minimum(y.astype(np.int32), max(h - 2, 0))
        fx, fy = x - left, y - top
        at, right, below = top * w + left, int(w > 1), w if h > 1 else 0
        mixed = np.empty((*x.shape, channels), np.uint8)
        # One channel at a time is nearly twice as fast as gathering triples.
        for channel in range(channels):
            flat = picture[..., channel].astype(np.float32).reshape(-1)
            upper, lower = flat[at], flat[at + below]
            upper += (flat[at + right] - upper) * fx
            lower += (flat[at + below + right] - lower) * fx
            upper += (lower - upper) * fy
            mixed[..., channel] = upper + np.float32(0.5)
        mixed[~self.valid] = 0
        return mixed

    def nearest(self, picture: np.ndarray) -> np.ndarray:
        """[h, w] of any type resampled to [H, W] without mixing values; pixels without content are zero."""
        h, w = picture.shape
        column = np.clip(np.nan_to_num(self.x), 0, w - 1).astype(np.int32)
        row = np.clip(np.nan_to_num(self.y), 0, h - 1).astype(np.int32)
        values = picture.reshape(-1)[row * w + column]
        values[~self.valid] = 0
        return values


@lru_cache(maxsize=8)
def remap_between(target: CameraModel, source: CameraModel, reduction: int = 1) -> Remap | None:
    """The exact map from the pixels of `target` to those of `source`, both looking from the same place; None where
    they have the same pixels. The last eight are kept, since most scenes have few cameras.

    Args:
        reduction: how many times smaller both pictures are.
    """
    if (
        source.is_pinhole
        and (target.width, target.height) == (source.width, source.height)
        and target.pinhole_params() == source.pinhole_params()
    ):
        return None
    reduced = target.reduced(reduction)
    pixels = pixel_centers(reduced.width, reduced.height).reshape(-1, 2)
    where, valid = _project(source, reduced.matrix(reduced.width, reduced.height), pixels)
    where[~valid] = np.nan
    x, y = where.astype(np.float32).reshape(reduced.height, reduced.width, 2).transpose(2, 0, 1) / np.float32(reduction)
    return Remap(x=x, y=y)


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
    objects: tuple[SceneObject, ...] = ()  # labeled objects, of an objects.json
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


def pose_in(values: Mapping[str, object], key: str, where: str) -> Float64[np.ndarray, "4 4"]:
    """A rigid transform of 4 rows, or of the upper 3, in a JSON object."""
    rows, pose = numbers(values, key, where, (4, 4), (3, 4)), np.eye(4)
    pose[: len(rows)] = rows
    return rigid_pose(pose, where)


def table_lines(path: Path) -> list[list[str]]:
    """The words of each line that is neither empty nor a comment; a byte order mark is skipped."""
    try:
        text = read_foreign_text(path)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except InputError:
        raise
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not a readable text file ({' '.join(str(error).split())[:120]})") from error
    lines = (line.split("#", 1)[0].split() for line in text.splitlines())
    return [words for words in lines if words]


def read_numbers(path: Path, *shapes: tuple[int | None, int]) -> Float64[np.ndarray, "rows columns"]:
    """A table of numbers of one of the shapes; None = any number of rows from 1. NaN and infinity are numbers."""
    expected = " or ".join(f"{'n' if rows is None else rows}×{columns}" for rows, columns in shapes)
    lines = [" ".join(words) for words in table_lines(path)]
    try:
        values = np.loadtxt(lines, ndmin=2) if lines else np.zeros((0, 0))
    except ValueError as error:
        raise InputError(f"{path}: not a table of {expected} numbers ({str(error)[:120]})") from error
    if not any(values.shape[1] == columns and rows in (None, values.shape[0]) for rows, columns in shapes):
        raise InputError(f"{path}: expected {expected} numbers, got {list(values.shape)}")
    return values


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
