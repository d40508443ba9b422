"""Label images on disk: for each pixel of a photograph the number of its region, 0 = none.

A label image has the size of the photograph's file, and is undistorted and scaled with it, by the nearest pixel.
"""

import io
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Float64, Int32

from gsencoder.core.errors import InputError
from gsencoder.core.files import check_foreign, read_foreign_text
from gsencoder.data.readers.images import (
    PictureFiles,
    PixelGrid,
    check_picture_size,
    load_npy,
    read_integers,
)
from gsencoder.data.readers.undistort import CameraModel
from gsencoder.types import Views
from gsencoder.types.scene import Selected

LABEL_SUFFIXES = (".png", ".npy", ".safetensors")
LARGEST_LABEL = 2**31 - 1


class LabelFiles(PictureFiles[Int32[np.ndarray, "H W"]]):
    """Label images as int32 [H, W], undistorted and scaled as the photographs are; a view without a file is all 0.

    Attributes:
        archive: the .zip that the files are members of; None where they lie in folders.
    """

    def __init__(self, paths: Sequence[Path | None], grids: Sequence[PixelGrid], archive: Path | None = None) -> None:
        super().__init__(paths, grids)
        self.archive = archive

    def _load(self, view: int) -> Int32[np.ndarray, "H W"]:
        path, grid = self._paths[view], self.grids[view]
        if path is None:
            return np.zeros((grid.height, grid.width), np.int32)
        return self._nearest(view, read_labels(path) if self.archive is None else read_member(self.archive, path))


def label_files(paths: Sequence[Path], views: Views, archive: Path | None = None) -> PictureFiles[Any]:
    """Label images of views, read on access.

    Args:
        views: where their photographs come from files, labels belong to the pixels of these files; else to the cameras.
        archive: the .zip that the files are members of; None where they lie in folders.
    """
    pictures: Any = views.images
    rows = list(range(len(views)))
    while isinstance(pictures, Selected):
        pictures, rows = pictures.items, [pictures.rows[row] for row in rows]
    if isinstance(pictures, PictureFiles):
        return LabelFiles(paths, [pictures.grids[row] for row in rows], archive)
    return LabelFiles(paths, [_grid_of(views, view) for view in range(len(views))], archive)


def _grid_of(views: Views, view: int) -> PixelGrid:
    """The pixels of a camera as they are."""
    K, width, height = views.cameras.Ks[view], int(views.cameras.widths[view]), int(views.cameras.heights[view])
    params = (float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
    camera = CameraModel(model="PINHOLE", width=width, height=height, params=params)
    return PixelGrid(source=camera, pinhole=camera, width=width, height=height)


def read_labels(path: Path) -> Int32[np.ndarray, "H W"]:
    """The label image of a PNG of 8 or 16 bits with one channel, or of a .npy or .safetensors file with one array of
    integers."""
    kind = path.suffix.lower()
    if kind not in LABEL_SUFFIXES:
        raise InputError(f"{path}: expected a label image as {', '.join(LABEL_SUFFIXES)}")
    if kind == ".png":
        return read_integers(path, "a label image")
    values = load_npy(path) if kind == ".npy" else _load_safetensors(path)
    if values.dtype.kind not in "iu":
        raise InputError(f"{path}: expected labels as integers, one a pixel and 0 = none, got {values.dtype}")
    if values.size and (int(values.min()) < 0 or int(values.max()) > LARGEST_LABEL):
        raise InputError(f"{path}: expected labels from 0 to {LARGEST_LABEL:,}, got {values.min()} to {values.max()}")
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


MAX_MEMBER_BYTES = 64 << 20  # Larger files in an archive are no label images


def members_by_stem(archive: Path) -> dict[str, Path]:
    """The .png files of an archive by their stems."""
    try:
        check_foreign(archive)
        with zipfile.ZipFile(archive) as file:
            names = [name for name in file.namelist() if name.lower().endswith(".png")]
    except (zipfile.BadZipFile, OSError, ValueError) as error:
        raise InputError(f"{archive}: cannot be read as .zip: {' '.join(str(error).split())[:120]}") from error
    members: dict[str, Path] = {}
    for name in names:
        stem = PurePosixPath(name).stem
        if stem in members:
            raise InputError(f"{archive}: has several files called {stem}.png, such as {name}; expected one a frame")
        members[stem] = Path(name)
    return members


def read_member(archive: Path, member: Path) -> Int32[np.ndarray, "H W"]:
    """The label image that is a member of an archive."""
    path = archive / member
    try:
        check_foreign(archive)
        with zipfile.ZipFile(archive) as file:
            size = file.getinfo(member.as_posix()).file_size
            if size > MAX_MEMBER_BYTES:
                raise InputError(f"{path}: {size:,} bytes; a label image has at most {MAX_MEMBER_BYTES:,}")
            data = io.BytesIO(file.read(member.as_posix()))
    except InputError:
        raise
    except (zipfile.BadZipFile, zlib.error, OSError, EOFError, KeyError, RuntimeError, NotImplementedError) as error:
        raise InputError(f"{path}: cannot be read: {' '.join(str(error).split())[:120]}") from error
    return read_integers(path, "a label image", data=data)


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
