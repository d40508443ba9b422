"""Masks and label images on disk as lazy sequences: which pixels of a view to use, which show that nothing is there,
and the number of each pixel's region, 0 = none.

A pixel of the photograph is used if its mask file is not 0, alpha is at least one half, it is no background of one
color, and it has content in the distorted picture; each counts only where it exists. After scaling a
pixel counts only if all that it covers does.

A background of one color, as renderings and product pictures of objects have, is looked for along the borders of some
photographs. It counts where nearly all of them have it along nearly all of their border, to within rounding or the
noise of JPEG: walls and skies of real photographs vary by more, and windows do not surround the picture. In a view the
background is what has this color and is connected to the border, so that white parts of an object stay.

A label image has the size of the photograph's file, and is undistorted and scaled with it, by the nearest pixel.
"""

import io
import zipfile
import zlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Bool, Int32, UInt8

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError
from gsencoder.core.files import check_foreign
from gsencoder.data.readers.images import (
    PictureFiles,
    PixelGrid,
    check_picture_size,
    load_npy,
    read_integers,
    read_mask,
    read_rgba,
    read_small,
)
from gsencoder.data.readers.posed import CameraModel, remap_between
from gsencoder.types import Views
from gsencoder.types.scene import Selected

LOOKED_AT = 16  # Photographs that are looked at, evenly spaced
EXCEPTIONS = 3  # Photographs that may lack the background, since the object fills them
MIN_PICTURES = 3
BORDER_SHARE = 0.8  # Share of a picture's border that has the color
EXACT, LOSSY = 2, 10
"""Largest difference of a color's channels from the background's, of 255, in files that keep every value and others."""
LOSSY_SUFFIXES = (".jpg", ".jpeg", ".webp")
SMALLEST_OBJECT = 24  # Islands of fewer pixels in the background of a lossy file are noise
DARK = 24  # A darker color may also be a part of the picture that the lens or undistortion leaves empty …
SAME_OUTLINE = 0.97
"""… which is the same in all pictures: of the pixels that are dark in either, this share is dark in both."""
MIN_SHARE, MAX_SHARE = 0.02, 0.995  # Mean share of the pictures' pixels that a background has
SEAM = 2  # Pixels this near to the background mix both colors, and are not used
SMALL_SIDE = 400  # JPEG files are looked at in about this many pixels a side


@dataclass(frozen=True, slots=True, kw_only=True)
class Background:
    """A background of one color."""

    color: tuple[int, int, int]  # RGB
    share: float  # of the pixels that have it, in the photographs that were looked at

    def describe(self) -> str:
        """The color and the share in words."""
        names = {(255, 255, 255): "white", (0, 0, 0): "black"}
        return f"{names.get(self.color, f'RGB {self.color}')}, {self.share:.0%} of the pixels"


def find_background(paths: Sequence[Path]) -> Background | None:
    """The background that nearly all photographs, none of which has transparency, have in common; None where there is
    none. Photographs are looked at until too many lack a background, which is after four in most scenes."""
    sample = [paths[int(row)] for row in even_indices(len(paths), LOOKED_AT)]
    if len(sample) < MIN_PICTURES:
        return None
    allowed = min(EXCEPTIONS, (len(sample) - 1) // 3)
    colors: list[tuple[int, int, int]] = []
    pictures: list[tuple[UInt8[np.ndarray, "h w 3"], Path]] = []
    for path in sample:
        picture = read_small(path, SMALL_SIDE)
        color = _border_color(picture, tolerance_of(path))
        if color is None:
            allowed -= 1
            if allowed < 0:
                return None
            continue
        colors.append(color)
        pictures.append((picture, path))
    common = Counter(colors).most_common(1)[0][0]
    apart = np.abs(np.array(colors) - common).max(axis=1)
    if int((apart > EXACT).sum()) > allowed:
        return None
    regions = [
        background_pixels(picture, common, path)
        for (picture, path), far in zip(pictures, apart, strict=True)
        if far <= EXACT
    ]
    share = float(np.mean([region.mean() for region in regions]))
    if not MIN_SHARE <= share <= MAX_SHARE or (max(common) < DARK and _is_one_outline(regions)):
        return None
    return Background(color=common, share=share)


def tolerance_of(path: Path) -> int:
    """How far the background of a file may differ from its color."""
    return LOSSY if path.suffix.lower() in LOSSY_SUFFIXES else EXACT


def _border_color(picture: UInt8[np.ndarray, "h w 3"], tolerance: int) -> tuple[int, int, int] | None:
    """The color that nearly all of a picture's border has."""
    border = np.concatenate((picture[0], picture[-1], picture[:, 0], picture[:, -1])).astype(np.int64)
    middle = np.median(border, axis=0)
    near = np.abs(border - middle).max(axis=1) <= tolerance
    if near.mean() < BORDER_SHARE:
        return None
    values, counts = np.unique(border[near], axis=0, return_counts=True)
    red, green, blue = values[counts.argmax()].tolist()
    # Skies and walls may stay within the noise of JPEG, but not within half of it.
    spread = np.abs(border[near] - (red, green, blue)).max(axis=1).mean()
    return (red, green, blue) if spread <= tolerance / 8 else None


def background_pixels(
    picture: UInt8[np.ndarray, "h w 3"], color: tuple[int, int, int], path: Path
) -> Bool[np.ndarray, "h w"]:
    """The pixels of a picture that have the color of the background and are connected to the border.

    Args:
        path: the file, whose format says how exact the color is.
    """
    from scipy import ndimage

    difference = np.abs(picture.astype(np.int16) - np.array(color, np.int16)).max(axis=2)
    alike = np.asarray(difference <= tolerance_of(path))
    labels, _ = ndimage.label(alike)
    on_border = np.unique(np.concatenate((labels[0], labels[-1], labels[:, 0], labels[:, -1])))
    region = np.isin(labels, on_border[on_border > 0])
    if path.suffix.lower() in LOSSY_SUFFIXES:
        islands, count = ndimage.label(~region, structure=np.ones((3, 3), int))
        small = np.bincount(islands.ravel(), minlength=count + 1) < SMALLEST_OBJECT
        small[0] = False
        region |= small[islands]
    return np.asarray(region)


def _is_one_outline(regions: Sequence[Bool[np.ndarray, "h w"]]) -> bool:
    """Whether all pictures have the same background pixels."""
    if len({region.shape for region in regions}) > 1:
        return False
    first = regions[0]
    same = [float((first & region).sum() / max(1, (first | region).sum())) for region in regions[1:]]
    return bool(same) and float(np.median(same)) >= SAME_OUTLINE


@lru_cache(maxsize=2)
def _outline(
    path: Path,
    background: Background | None,
    modified: int,  # noqa: ARG001
    size: int,  # noqa: ARG001
) -> tuple[Bool[np.ndarray, "H W"], Bool[np.ndarray, "H W"]]:
    """Which pixels of a photograph show something, and which show that nothing is there; those between do neither.

    Alpha of one half and more shows something, none (below 1/64) that nothing is there. Next to a background of one
    color the two nearest pixels do neither. Kept, since both kinds of masks ask one after the other.
    """
    from scipy import ndimage

    picture, alpha = read_rgba(path)
    if alpha is not None:
        return np.asarray(alpha >= 128), np.asarray(alpha < 4)
    if background is None:
        return np.ones(picture.shape[:2], bool), np.zeros(picture.shape[:2], bool)
    region = background_pixels(picture, background.color, path)
    foreground = ~ndimage.binary_dilation(region, iterations=SEAM)
    return foreground, np.asarray(ndimage.binary_erosion(region, iterations=1, border_value=1))


class MaskFiles(PictureFiles[Bool[np.ndarray, "H W"]]):
    """Which pixels to use, bool [H, W]; with `empty`, which show that nothing is there: transparent ones, and a
    background of one color.

    Args:
        outlined: photographs of which transparency, or `background`, tells where something is.
    """

    def __init__(
        self,
        paths: Sequence[Path | None],
        grids: Sequence[PixelGrid],
        outlined: Sequence[Path | None],
        background: Background | None = None,
        *,
        empty: bool = False,
    ) -> None:
        super().__init__(paths, grids)
        self._outlined, self._background, self._is_empty = tuple(outlined), background, empty

    def _load(self, view: int) -> Bool[np.ndarray, "H W"]:
        from PIL import Image

        mask, photograph, grid = self._paths[view], self._outlined[view], self.grids[view]
        pixels = np.full((grid.source.height, grid.source.width), not self._is_empty)
        if photograph is not None:
            state = photograph.stat()
            outline = _outline(photograph, self._background, state.st_mtime_ns, state.st_size)
            pixels = self._turned(view, outline[self._is_empty])
            self.check_size(view, pixels.shape)
        if mask is not None and not self._is_empty:
            pixels = pixels & self._of_source(view, read_mask(mask))
        remap = remap_between(grid.pinhole, grid.source)
        if remap is not None:
            pixels = remap.nearest(pixels)
        if pixels.shape != (grid.height, grid.width):
            grey = Image.fromarray(pixels.astype(np.uint8) * 255)
            pixels = np.asarray(grey.resize((grid.width, grid.height), Image.Resampling.BOX)) == 255
        return pixels


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
