"""Undistortion: the pinhole camera that replaces a distorted one, and the map from its pixels to those of the file.

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
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64

from gsencoder.core.errors import InputError
from gsencoder.types.scene import intrinsic_matrix, pixel_centers, project_points, unproject_points

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
