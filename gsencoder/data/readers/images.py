"""Pictures on disk as lazy sequences of views: files that are decoded on access (`image_file.py`), undistorted and
scaled. `depth_images.py` has depth of sensors, `masks.py` masks.

- Distorted pictures are resampled once (undistort.py): color bilinearly, everything else by the nearest pixel.
- A smaller scale averages color over areas; depth and instances take the pixel at the new center. Photographs are
  decoded and undistorted at half, a quarter or an eighth of their size where that is at least twice the view's.
- Photographs that were read last are kept, up to `KEPT_BYTES`: checks, seeds and teachers look at the same ones.
- A file whose width and height are exchanged is turned by the photograph's EXIF orientation. Masks, depth and instance
  maps of another size than the photograph are enlarged or reduced by the nearest pixel.
"""

import math
import operator
import threading
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, overload

import numpy as np
from jaxtyping import Int32, UInt8

from gsencoder.core.errors import InputError
from gsencoder.data.readers.image_file import picture_size, read_integers, read_rgba
from gsencoder.data.readers.undistort import CameraModel, Pinhole, RemapCache
from gsencoder.types.orientation import EXCHANGED, turned

Array = TypeVar("Array", bound=np.ndarray)
KEPT_BYTES = 64 << 20
"""Of all photographs that are kept; scenes with more decode them each time they are looked at."""
_kept: dict[Any, UInt8[np.ndarray, "_ _ 3"]] = {}
_kept_lock = threading.Lock()


@dataclass(frozen=True, slots=True, kw_only=True)
class PixelGrid:
    """How the pixels of a view's file become the pixels of the view.

    Attributes:
        source: the camera that the file's pixels belong to.
        pinhole: the camera without distortion, at full size.
        width: of the view, after scaling.
        height: of the view, after scaling.
        turn: EXIF orientation by which a file is turned whose width and height are those of `source` exchanged; 1 = no
            such file is read.
    """

    source: CameraModel
    pinhole: Pinhole
    width: int
    height: int
    turn: int = 1

    @property
    def reduction(self) -> int:
        """How many times smaller a photograph is decoded: 1, 2, 4 or 8."""
        source = self.source
        most = min(source.width // (2 * self.width), source.height // (2 * self.height))
        # Pixels that are cut off are the last ones of the file; turned they would be the first.
        sides = 0 if self.turn == 1 else math.gcd(source.width, source.height)
        return max(each for each in (1, 2, 4, 8) if each <= max(1, most) and sides % each == 0)

    def is_exchanged(self, width: int, height: int) -> bool:
        """Whether a file of this size is to be turned."""
        source = self.source
        return self.turn in EXCHANGED and (width > height) != (source.width > source.height) and width != height

    def fits(self, width: int, height: int) -> bool:
        """Whether a file of this size has the shape of the photograph, to the nearest pixel."""
        if self.is_exchanged(width, height):
            width, height = height, width
        source = self.source
        return abs(width * source.height - height * source.width) < min(source.width, source.height)


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

    def check_size(self, view: int, shape: tuple[int, ...]) -> None:
        """Raises InputError where the pixels of a file are not of the size [H, W] that its header had at first."""
        source = self._grids[view].source
        if shape != (source.height, source.width):
            raise InputError(
                f"{self._paths[view]}: {shape[1]}×{shape[0]} pixels, expected {source.width}×{source.height}, as the "
                "photograph had when the scene was loaded"
            )

    def _turned(self, view: int, pixels: np.ndarray) -> np.ndarray:
        """Pixels of a file turned as those of `source`, where width and height are exchanged."""
        grid = self._grids[view]
        return turned(pixels, grid.turn) if grid.is_exchanged(pixels.shape[1], pixels.shape[0]) else pixels

    def _of_source(self, view: int, values: np.ndarray) -> np.ndarray:
        """Values of a file turned and scaled by the nearest pixel to the pixels of `source`."""
        values, grid = self._turned(view, values), self._grids[view]
        if grid.fits(values.shape[1], values.shape[0]):
            values = resized_nearest(values, grid.source.width, grid.source.height)
        self.check_size(view, values.shape)
        return values

    def _nearest(self, view: int, values: np.ndarray) -> np.ndarray:
        grid = self._grids[view]
        values = self._of_source(view, values)
        remap = self._remaps.get(grid.pinhole, grid.source)
        if remap is not None:
            values = remap.nearest(values)
        return resized_nearest(values, grid.width, grid.height)


def resized_nearest(values: np.ndarray, width: int, height: int) -> np.ndarray:
    """[h, w] at another size: the value at the center of each new pixel."""
    if values.shape == (height, width):
        return values
    rows = ((np.arange(height) + 0.5) * (values.shape[0] / height)).astype(np.int64)
    columns = ((np.arange(width) + 0.5) * (values.shape[1] / width)).astype(np.int64)
    return values[rows][:, columns]


class ImageFiles(PictureFiles[UInt8[np.ndarray, "H W 3"]]):
    """Photographs as uint8 [H, W, 3] RGB, undistorted and scaled."""

    def _load(self, view: int) -> UInt8[np.ndarray, "H W 3"]:
        path, grid = self._paths[view], self._grids[view]
        assert path is not None
        state = path.stat() if path.exists() else None
        key = (path, grid, state and (state.st_mtime_ns, state.st_size))
        with _kept_lock:
            color = _kept.pop(key, None)
        if color is None:
            color = self._decoded(view, path)
        if color.nbytes <= KEPT_BYTES:
            with _kept_lock:
                _kept[key] = color
                while sum(each.nbytes for each in _kept.values()) > KEPT_BYTES:
                    _kept.pop(next(iter(_kept)))
        return color.copy()

    def _decoded(self, view: int, path: Path) -> UInt8[np.ndarray, "H W 3"]:
        from PIL import Image

        grid = self._grids[view]
        reduction = grid.reduction
        size, color = picture_size(path), read_rgba(path, reduction=reduction)[0]
        if color.shape[:2] == size[::-1] and reduction > 1:
            color = np.array(Image.fromarray(color).reduce(reduction))
        if grid.is_exchanged(*size):
            color, size = turned(color, grid.turn), size[::-1]
        self.check_size(view, size[::-1])
        remap = self._remaps.get(grid.pinhole, grid.source, reduction)
        if remap is not None:
            color = remap.bilinear(color)
        if color.shape[:2] != (grid.height, grid.width):
            # Of two to four pixels for one a box would take some whole and some not at all.
            method = Image.Resampling.BOX if reduction == 1 else Image.Resampling.HAMMING
            whole = (0, 0, size[0] / reduction, size[1] / reduction)
            color = np.array(Image.fromarray(color).resize((grid.width, grid.height), method, box=whole))
        return color


class InstanceFiles(PictureFiles[Int32[np.ndarray, "H W"]]):
    """Instance maps as int32 [H, W], 0 = none; a view without a file is all zero."""

    def _load(self, view: int) -> Int32[np.ndarray, "H W"]:
        path, grid = self._paths[view], self._grids[view]
        if path is None:
            return np.zeros((grid.height, grid.width), np.int32)
        return self._nearest(view, read_integers(path, "an instance map", wide=False))
