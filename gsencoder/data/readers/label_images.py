"""Label images on disk: for each pixel of a photograph the number of its region, 0 = none.

A label image has the size of the photograph's file, and is undistorted and scaled with it, by the nearest pixel.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int32

from gsencoder.core.errors import InputError
from gsencoder.core.files import check_foreign
from gsencoder.data.readers.image_file import check_picture_size, load_npy, read_integers
from gsencoder.data.readers.images import PictureFiles, PixelGrid
from gsencoder.data.readers.undistort import CameraModel, Pinhole, RemapCache
from gsencoder.types import Views
from gsencoder.types.scene import Selected

LABEL_SUFFIXES = (".png", ".npy", ".safetensors")
LARGEST_LABEL = 2**31 - 1


class LabelFiles(PictureFiles[Int32[np.ndarray, "H W"]]):
    """Label images as int32 [H, W], 0 = none, undistorted and scaled as the photographs are."""

    def _load(self, view: int) -> Int32[np.ndarray, "H W"]:
        path = self._paths[view]
        assert path is not None
        return self._nearest(view, self._read(path))

    def _read(self, path: Path) -> Int32[np.ndarray, "H W"]:
        return read_labels(path)


def label_files(paths: Sequence[Path], views: Views, kind: type[LabelFiles] = LabelFiles) -> PictureFiles[Any]:
    """Label images of views, read on access.

    Args:
        paths: a file for each view.
        views: where their photographs come from files, labels belong to the pixels of these files; else to the cameras.
        kind: how files are read.

    Returns:
        int32 [H, W] for each view, 0 = none.
    """
    pictures: Any = views.images
    rows = list(range(len(views)))
    while isinstance(pictures, Selected):
        pictures, rows = pictures.items, [pictures.rows[row] for row in rows]
    if isinstance(pictures, PictureFiles):
        return kind(paths, [pictures.grids[row] for row in rows], pictures.remaps)
    return kind(paths, [_grid_of(views, view) for view in range(len(views))], RemapCache())


def _grid_of(views: Views, view: int) -> PixelGrid:
    """The pixels of a camera as they are."""
    K, width, height = views.cameras.Ks[view], int(views.cameras.widths[view]), int(views.cameras.heights[view])
    fx, fy, cx, cy = (float(value) for value in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    return PixelGrid(
        source=CameraModel(model="PINHOLE", width=width, height=height, params=(fx, fy, cx, cy)),
        pinhole=Pinhole(fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height),
        width=width,
        height=height,
    )


def read_labels(path: Path) -> Int32[np.ndarray, "H W"]:
    """The label image of a file.

    Args:
        path: a PNG of 8 or 16 bits with one channel, a .npy array, or a .safetensors file with one array, of integers.

    Raises:
        InputError: unreadable, damaged, of another type or shape, or with labels that are negative or too large.
    """
    kind = path.suffix.lower()
    if kind not in LABEL_SUFFIXES:
        raise InputError(f"{path}: expected a label image as {', '.join(LABEL_SUFFIXES)}")
    if kind == ".png":
        return read_integers(path, "a label image", wide=False)
    values = load_npy(path) if kind == ".npy" else _load_safetensors(path)
    if values.dtype.kind not in "iu":
        raise InputError(f"{path}: expected labels as integers, one a pixel and 0 = none, got {values.dtype}")
    if values.size and (int(values.min()) < 0 or int(values.max()) > LARGEST_LABEL):
        raise InputError(
            f"{path}: expected labels from 0 (none) to {LARGEST_LABEL:,}, got {values.min()} to {values.max()}"
        )
    return np.asarray(values, np.int32)


def _load_safetensors(path: Path) -> np.ndarray:
    """The one array of a file; its header is checked before its values are read."""
    from safetensors import SafetensorError, safe_open

    try:
        check_foreign(path)
        with safe_open(path, framework="np") as stored:
            names = list(stored.keys())
            shape = tuple(stored.get_slice(names[0]).get_shape()) if len(names) == 1 else ()
            if len(shape) == 2:
                check_picture_size(path, shape[1], shape[0])
                return np.asarray(stored.get_tensor(names[0]))
    except (OSError, SafetensorError, ValueError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: cannot be read as .safetensors: {' '.join(str(error).split())[:120]}") from error
    actual = f"the shape {list(shape)}" if len(names) == 1 else f"{len(names)} arrays"
    raise InputError(f"{path}: expected one array [H, W] of labels, got {actual}")
