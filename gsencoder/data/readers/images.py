"""Pictures on disk as lazy sequences: photographs, sensor depth and instance maps, decoded on access; masks.py has
masks.

Rules that hold for all of them:

- The size in a file's header is checked before anything is decoded; more than `PIXEL_LIMIT` pixels are refused.
- Only PNG, JPEG, WebP, TIFF, BMP and PPM are opened, and .npy for depth. A file that cannot be decoded to its
  end is an InputError that names it.
- The EXIF orientation is ignored, as COLMAP does: poses and intrinsics belong to the pixels as they are stored.
- Grey becomes RGB by repetition, 16-bit grey keeps its upper 8 bits. An alpha channel composites the color over
  black, which is what a splat rendered without a background gives.
- Distorted pictures are resampled once (undistort.py): color bilinearly, everything else by the nearest pixel.
- A smaller scale averages color over areas; depth and instances take the pixel at the new center.
"""

import io
import operator
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar, overload

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, UInt8

from gsencoder.core.errors import InputError
from gsencoder.data.readers.undistort import CameraModel, Pinhole, RemapCache, pinhole_for
from gsencoder.types.cameras import pixel_centers, unproject_points

if TYPE_CHECKING:
    from PIL.Image import Image

PIXEL_LIMIT = 80_000_000
"""Pictures of more pixels are refused before they are decoded (Pillow's own warning starts a little above this)."""
FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP", "PPM")
DEEP_GREY = ("I;16", "I;16B", "I;16L", "I")
"""Pillow's modes of pictures with one channel of more than 8 bits."""
Array = TypeVar("Array", bound=np.ndarray)


def check_picture_size(path: Path, width: int, height: int) -> None:
    """Raises InputError where a picture has no pixels, or more than `PIXEL_LIMIT`."""
    if width < 1 or height < 1 or width * height > PIXEL_LIMIT:
        raise InputError(f"{path}: {width}×{height} pixels, expected 1 to {PIXEL_LIMIT:,}; make the picture smaller")


def picture_of(path: Path, data: io.BytesIO) -> "Image":
    """A picture whose header was read from bytes of a file of that name.

    Raises:
        InputError: unreadable, or more than `PIXEL_LIMIT` pixels.
    """
    return _open(path, data)


def _open(path: Path, data: io.BytesIO | None = None) -> "Image":
    """Reads a picture's header. Pillow raises nearly anything on hostile files, hence the wide net."""
    from PIL import Image

    try:
        picture = Image.open(path if data is None else data, formats=FORMATS)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except Exception as error:
        raise InputError(f"{path}: not a readable picture ({_brief(error)}); expected {', '.join(FORMATS)}") from error
    try:
        check_picture_size(path, *picture.size)
    except InputError:
        picture.close()
        raise
    return picture


def _brief(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())[:120]}"


def _decode(path: Path, picture: "Image") -> "Image":
    try:
        picture.load()
    except Exception as error:
        raise InputError(f"{path}: cannot be decoded ({_brief(error)}); the file is cut short or damaged") from error
    return picture


def check_picture(path: Path) -> None:
    """Decodes a picture to its end.

    Raises:
        InputError: missing, of another format, too large, or damaged; the file is named.
    """
    with _open(path) as picture:
        _decode(path, picture)


def load_npy(path: Path, *, header_only: bool = False) -> np.ndarray:
    """The array of a .npy file; its header is checked before its values are read.

    Args:
        path: the file.
        header_only: whether to leave the values unread, for the shape and the type. Those of a file that is cut off
            afterwards must not be touched: the system would end the process.

    Raises:
        InputError: unreadable, no array of numbers [H, W], too large, or cut off.
    """
    values = _checked_npy(path, "r")
    return values if header_only else _checked_npy(path, None)


def _checked_npy(path: Path, mapped: Literal["r"] | None) -> np.ndarray:
    try:
        values = np.load(path, mmap_mode=mapped, allow_pickle=False)
    except Exception as error:
        raise InputError(f"{path}: not a readable .npy array ({_brief(error)})") from error
    if not isinstance(values, np.ndarray) or values.dtype.kind not in "fiu":
        raise InputError(f"{path}: expected a .npy array of numbers [H, W]")
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[..., 0]
    if values.ndim != 2:
        raise InputError(f"{path}: expected an array [H, W], got {list(values.shape)}")
    check_picture_size(path, values.shape[1], values.shape[0])
    return values


def picture_size(path: Path) -> tuple[int, int]:
    """(width, height) from the header alone.

    Raises:
        InputError: unreadable, or more than `PIXEL_LIMIT` pixels.
    """
    if path.suffix.lower() == ".npy":
        height, width = load_npy(path, header_only=True).shape
        return width, height
    with _open(path) as picture:
        return picture.size


def picture_info(path: Path) -> tuple[tuple[int, int], bool]:
    """((width, height), whether there is transparency) from the header alone; errors as in `picture_size`."""
    with _open(path) as picture:
        try:
            return picture.size, bool(picture.has_transparency_data)
        except Exception as error:
            raise InputError(f"{path}: not a readable picture ({_brief(error)})") from error


def is_deep_grey(path: Path) -> bool:
    """Whether a picture has one channel of 16 bits, as depth images have, from the header alone.

    Raises:
        InputError: unreadable.
    """
    with _open(path) as picture:
        return picture.mode in DEEP_GREY


def read_rgba(path: Path) -> tuple[UInt8[np.ndarray, "H W 3"], UInt8[np.ndarray, "H W"] | None]:
    """Color (composited over black) and alpha, None where the file has none.

    Raises:
        InputError: unreadable, damaged, too large, or of a kind that is not color.
    """
    with _open(path) as opened:
        picture = _decode(path, opened)
        try:
            if picture.mode.startswith("I"):
                wide = np.asarray(picture).astype(np.int64)
                if wide.min() < 0 or wide.max() > 65_535:
                    raise InputError(f"{path}: grey values beyond 16 bits; expected an 8- or 16-bit photograph")
                return np.repeat((wide >> 8).astype(np.uint8)[..., None], 3, axis=2), None
            if picture.mode == "F":
                raise InputError(f"{path}: a floating-point picture; expected an 8- or 16-bit photograph")
            if not picture.has_transparency_data:
                return np.array(picture.convert("RGB")), None
            rgba = np.asarray(picture.convert("RGBA"))
        except InputError:
            raise
        except Exception as error:
            raise InputError(f"{path}: cannot be turned into RGB ({_brief(error)})") from error
    alpha = rgba[..., 3]
    color = (rgba[..., :3].astype(np.uint16) * alpha[..., None] + 127) // 255
    return color.astype(np.uint8), alpha.copy()


def read_small(path: Path, side: int) -> UInt8[np.ndarray, "h w 3"]:
    """About side × side pixels or more of a picture, for a quick look: JPEG is decoded at a fraction of its size, of
    other files every n-th pixel is taken.

    Raises:
        InputError: as `read_rgba`.
    """
    with _open(path) as opened:
        if opened.format == "JPEG":
            opened.draft("RGB", (side, side))
            picture = np.asarray(_decode(path, opened).convert("RGB"))
        else:
            picture = read_rgba(path)[0]
    step = max(1, min(picture.shape[:2]) // side)
    return picture[::step, ::step]


def read_mask(path: Path) -> Bool[np.ndarray, "H W"]:
    """Where a mask file is not 0. One that was saved as RGB is white and black like any other; alpha says nothing.

    Raises:
        InputError: unreadable or damaged.
    """
    with _open(path) as opened:
        picture = _decode(path, opened)
        values, bands = np.asarray(picture), picture.getbands()
    if values.ndim == 2:
        return np.asarray(values != 0)
    return np.asarray(values[..., : len(bands) - ("A" in bands)].any(axis=2))


def read_integers(path: Path, what: str, *, wide: bool, data: io.BytesIO | None = None) -> np.ndarray:
    """A single-channel integer PNG [H, W], int32; `wide` asks for more than 8 bits, as depth in millimetres has.

    With `data`, the content of the file is there already, and `path` names it in messages.
    """
    with _open(path, data) as opened:
        if opened.format == "JPEG":
            raise InputError(f"{path}: {what} was saved as JPEG, which changes values; expected PNG")
        allowed = DEEP_GREY + (() if wide else ("L", "P", "1"))
        if opened.mode not in allowed:
            kind = "16-bit" if wide else "8- or 16-bit"
            raise InputError(f"{path}: {what} must be a {kind} picture with one channel, got mode {opened.mode}")
        values = np.asarray(_decode(path, opened)).astype(np.int32)
    if values.size and values.min() < 0:
        raise InputError(f"{path}: {what} has negative values")
    return values


@dataclass(frozen=True, slots=True, kw_only=True)
class PixelGrid:
    """How the pixels of a view's file become the pixels of the view.

    Attributes:
        source: the camera that the file's pixels belong to.
        pinhole: the camera without distortion, at full size.
        width: of the view, after scaling.
        height: of the view, after scaling.
    """

    source: CameraModel
    pinhole: Pinhole
    width: int
    height: int


class PictureFiles(Sequence[Array]):
    """Files of V views, read on access. Slices are sequences of the same kind; nothing is kept in memory."""

    def __init__(self, paths: Sequence[Path | None], grids: Sequence[PixelGrid], remaps: RemapCache) -> None:
        self._paths, self._grids, self._remaps = tuple(paths), tuple(grids), remaps

    def __len__(self) -> int:
        return len(self._paths)

    @overload
    def __getitem__(self, index: int) -> Array: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Array]: ...
    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return self._slice(index)
        view = operator.index(index)
        if not -len(self) <= view < len(self):
            raise IndexError(f"view {view} of {len(self)}")
        return self._load(view % len(self))

    def _slice(self, rows: slice) -> "PictureFiles[Array]":
        return type(self)(self._paths[rows], self._grids[rows], self._remaps)

    @property
    def grids(self) -> tuple[PixelGrid, ...]:
        """How the pixels of each file become those of its view."""
        return self._grids

    @property
    def remaps(self) -> RemapCache:
        """The shared maps of undistortion."""
        return self._remaps

    @abstractmethod
    def _load(self, view: int) -> Array: ...

    def checked(self, view: int, shape: tuple[int, ...]) -> None:
        source = self._grids[view].source
        if shape != (source.height, source.width):
            raise InputError(
                f"{self._paths[view]}: {shape[1]}×{shape[0]} pixels, expected {source.width}×{source.height}; "
                "the file changed since the scene was loaded"
            )

    def _nearest(self, view: int, values: np.ndarray) -> np.ndarray:
        grid = self._grids[view]
        self.checked(view, values.shape)
        remap = self._remaps.get(grid.pinhole, grid.source)
        if remap is not None:
            values = remap.nearest(values)
        if values.shape != (grid.height, grid.width):
            rows = ((np.arange(grid.height) + 0.5) * (values.shape[0] / grid.height)).astype(np.int64)
            columns = ((np.arange(grid.width) + 0.5) * (values.shape[1] / grid.width)).astype(np.int64)
            values = values[rows][:, columns]
        return values


DepthMeasure = Literal["z", "ray"]
"""What the numbers of a depth file are: the coordinate z in the camera, or the distance from its center."""


def ray_lengths(K: Float64[np.ndarray, "3 3"], width: int, height: int) -> Float64[np.ndarray, "height width"]:
    """The distance from the camera of a point of depth z = 1, for each pixel."""
    rays = unproject_points(pixel_centers(width, height), np.ones((height, width)), K)
    return np.asarray(np.linalg.norm(rays, axis=2))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DepthSensor:
    """How the numbers of a depth file become depth of the photograph.

    Attributes:
        scale: world units for each step of the file.
        no_depth: a step that means none, besides 0.
        measure: whether a depth is the coordinate z or the length of the ray.
        color_from_depth: where the sensor stands beside the photograph's camera, world units; None = in one place.
    """

    scale: float = 1.0
    no_depth: int | None = None
    measure: DepthMeasure = "z"
    color_from_depth: Float64[np.ndarray, "4 4"] | None = None


class ImageFiles(PictureFiles[UInt8[np.ndarray, "H W 3"]]):
    """Photographs as uint8 [H, W, 3] RGB, undistorted and scaled."""

    def _load(self, view: int) -> UInt8[np.ndarray, "H W 3"]:
        from PIL import Image

        path, grid = self._paths[view], self._grids[view]
        assert path is not None
        color = read_rgba(path)[0]
        self.checked(view, color.shape[:2])
        remap = self._remaps.get(grid.pinhole, grid.source)
        if remap is not None:
            color = remap.bilinear(color)
        if color.shape[:2] != (grid.height, grid.width):
            small = Image.fromarray(color).resize((grid.width, grid.height), Image.Resampling.BOX)
            color = np.array(small)
        return color


class DepthFiles(PictureFiles[Float32[np.ndarray, "H W"]]):
    """Sensor depth as float32 [H, W], z in world units, 0 = none; a view without a file is all zero.

    PNG holds integers and .npy any number type; both are multiplied by the view's scale. In .npy, NaN and infinity
    also mean none. Depth of a sensor that stands beside the photograph's camera is carried over (registration.py).
    """

    def __init__(
        self,
        paths: Sequence[Path | None],
        grids: Sequence[PixelGrid],
        remaps: RemapCache,
        sensors: Sequence[DepthSensor],
    ) -> None:
        super().__init__(paths, grids, remaps)
        self._sensors = tuple(sensors)

    def _slice(self, rows: slice) -> "DepthFiles":
        return DepthFiles(self._paths[rows], self._grids[rows], self._remaps, self._sensors[rows])

    def _load(self, view: int) -> Float32[np.ndarray, "H W"]:
        path, grid = self._paths[view], self._grids[view]
        if path is None:
            return np.zeros((grid.height, grid.width), np.float32)
        if path.suffix.lower() == ".npy":
            read = load_npy(path)
            with np.errstate(over="ignore"):
                values = np.where(np.isfinite(read), read, 0).astype(np.float64)
            if values.size and values.min() < 0:
                raise InputError(f"{path}: depth has negative values")
        else:
            values = read_integers(path, "depth", wide=True).astype(np.float64)
        sensor = self._sensors[view]
        if sensor.no_depth is not None:
            values[values == sensor.no_depth] = 0
        if sensor.color_from_depth is None:
            depth = self._nearest(view, values) * sensor.scale
            if sensor.measure == "ray":
                depth /= ray_lengths(grid.pinhole.matrix(grid.width, grid.height), grid.width, grid.height)
        else:
            depth = self._registered(view, values * sensor.scale, sensor)
        if depth.size and depth.max() > np.finfo(np.float32).max:
            raise InputError(f"{path}: depth of {depth.max():g} world units; check the depth scale")
        return depth.astype(np.float32)

    def _registered(self, view: int, depth: np.ndarray, sensor: DepthSensor) -> Float32[np.ndarray, "H W"]:
        """The depth of a sensor that stands elsewhere, as the photograph's camera sees it."""
        # The kernel needs numba and torch, which scenes without such sensors do without.
        from gsencoder.data.readers.registration import register_depth

        grid = self._grids[view]
        self.checked(view, depth.shape)
        source = grid.source
        pinhole = pinhole_for(source, str(self._paths[view]))
        remap = self._remaps.get(pinhole, source)
        if remap is not None:
            depth = remap.nearest(depth)
        K = pinhole.matrix(pinhole.width, pinhole.height)
        if sensor.measure == "ray":
            depth = depth / ray_lengths(K, pinhole.width, pinhole.height)
        assert sensor.color_from_depth is not None
        return register_depth(
            depth.astype(np.float32),
            K,
            sensor.color_from_depth,
            grid.pinhole.matrix(grid.width, grid.height),
            grid.width,
            grid.height,
        )


class InstanceFiles(PictureFiles[Int32[np.ndarray, "H W"]]):
    """Instance maps as int32 [H, W], 0 = none; a view without a file is all zero."""

    def _load(self, view: int) -> Int32[np.ndarray, "H W"]:
        path, grid = self._paths[view], self._grids[view]
        if path is None:
            return np.zeros((grid.height, grid.width), np.int32)
        return self._nearest(view, read_integers(path, "an instance map", wide=False))
