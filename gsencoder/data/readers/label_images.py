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
    open_picture,
    read_integers,
)
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
        views: where their photographs come from files, labels belong to the pixels of these files; else to the cameras.

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


class ArchivedLabels(LabelFiles):
    """Label images of views in one archive, as int32 [H, W]; paths are those of members below that of the archive."""

    @property
    def archive(self) -> Path:
        """The .zip."""
        path = self._paths[0]
        assert path is not None
        return archive_of(path)

    def _read(self, path: Path) -> Int32[np.ndarray, "H W"]:
        return read_integers(path, "a label image", wide=False, data=member_bytes(path))


def members_by_stem(archive: Path) -> dict[str, Path]:
    """The .png files of an archive by their stems, as paths below that of the archive."""
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
        members[stem] = archive / name
    return members


def archived_size(path: Path) -> tuple[int, int]:
    """(width, height) of a member, from its header."""
    with open_picture(path, member_bytes(path)) as picture:
        return picture.size


def archive_of(path: Path) -> Path:
    """The archive that a member's path is below."""
    return next(each for each in path.parents if each.suffix.lower() == ".zip" and each.is_file())


def member_bytes(path: Path) -> io.BytesIO:
    """The content of a member."""
    archive = archive_of(path)
    name = path.relative_to(archive).as_posix()
    try:
        check_foreign(archive)
        with zipfile.ZipFile(archive) as file:
            size = file.getinfo(name).file_size
            if size > MAX_MEMBER_BYTES:
                raise InputError(f"{path}: {size:,} bytes; a label image has at most {MAX_MEMBER_BYTES:,}")
            return io.BytesIO(file.read(name))
    except InputError:
        raise
    except (zipfile.BadZipFile, zlib.error, OSError, EOFError, KeyError, RuntimeError, NotImplementedError) as error:
        raise InputError(f"{path}: cannot be read: {' '.join(str(error).split())[:120]}") from error


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
    lines = table_lines(path)
    expected = " or ".join(f"{'n' if rows is None else rows}×{columns}" for rows, columns in shapes)
    lengths = {len(words) for words in lines}
    if len(lengths) > 1:
        odd = next(number for number, words in enumerate(lines) if len(words) != len(lines[0]))
        raise InputError(
            f"{path}: row {odd + 1} has {len(lines[odd])} values and the first {len(lines[0])}; expected {expected}"
        )
    try:
        values = np.array(lines, np.float64).reshape(len(lines), len(lines[0]) if lines else 0)
    except ValueError as error:
        raise InputError(f"{path}: not a table of numbers ({' '.join(str(error).split())[:120]})") from error
    if not len(lines) or not any(
        values.shape[1] == columns and rows in (None, values.shape[0]) for rows, columns in shapes
    ):
        raise InputError(f"{path}: expected {expected} numbers, got {list(values.shape)}")
    return values
