"""One picture file, decoded: photographs, masks, integers of depth and instance maps, and .npy arrays.

- The size in a file's header is checked before anything is decoded; more than `PIXEL_LIMIT` pixels are refused.
- Only PNG, JPEG, WebP, TIFF, BMP and PPM are opened, and .npy for depth. A file that cannot be decoded to its
  end is an InputError that names it.
- Pixels are as they are stored, as COLMAP takes them, whatever the EXIF orientation says: poses and intrinsics belong
  to these. `picture_info` reads the orientation.
- Grey becomes RGB by repetition, 16-bit grey keeps its upper 8 bits. An alpha channel composites the color over
  black, which is what a splat rendered without a background gives.
"""

import io
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Bool, UInt8

from gsencoder.core.errors import InputError
from gsencoder.core.files import check_foreign
from gsencoder.types.orientation import EXCHANGED

if TYPE_CHECKING:
    from PIL.Image import Image


PIXEL_LIMIT = 80_000_000
"""Pictures of more pixels are refused before they are decoded (Pillow's own warning starts a little above this)."""
FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP", "PPM")
EXIF_ORIENTATION = 0x0112
TIFF_UNDO = (0, 0, 0, 3, 1, 5, 2, 6, 4)
"""By EXIF orientation: Pillow's number (`Image.Transpose`) of what turns an upright picture back."""
DEEP_GREY = ("I;16", "I;16B", "I;16L", "I")
"""Pillow's modes of pictures with one channel of more than 8 bits."""


def check_picture_size(path: Path, width: int, height: int) -> None:
    """Raises InputError where a picture has no pixels, or more than `PIXEL_LIMIT`."""
    if width < 1 or height < 1 or width * height > PIXEL_LIMIT:
        raise InputError(f"{path}: {width}×{height} pixels, expected 1 to {PIXEL_LIMIT:,}; make the picture smaller")


def open_picture(path: Path, data: io.BytesIO | None = None) -> "Image":
    """A picture whose header was read, and whose pixels were not.

    Args:
        path: the file.
        data: its content, where that was read already; `path` names it in messages.

    Raises:
        InputError: unreadable, or more than `PIXEL_LIMIT` pixels.
    """
    from PIL import Image

    # Pillow raises nearly any error on hostile files.
    try:
        if data is None:
            check_foreign(path)
        picture = Image.open(path if data is None else data, formats=FORMATS)
    except InputError:
        raise
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
    """The stored pixels; Pillow turns those of TIFF files upright, and of no others."""
    orientation = _orientation(picture) if picture.format == "TIFF" else 1
    try:
        picture.load()
    except Exception as error:
        raise InputError(f"{path}: cannot be decoded ({_brief(error)}); the file is cut short or damaged") from error
    if orientation == 1:
        return picture
    from PIL import Image

    return picture.transpose(Image.Transpose(TIFF_UNDO[orientation]))


def _orientation(picture: "Image") -> int:
    """The EXIF orientation from the header; 1 where there is none that can be read."""
    from PIL import Image

    try:
        # Of PNG files Pillow's own method would decode all pixels, in case EXIF data follow them.
        value = Image.Image.getexif(picture).get(EXIF_ORIENTATION)
    except Exception:
        return 1
    return int(value) if isinstance(value, int) and 1 <= value <= 8 else 1


def _stored_size(picture: "Image") -> tuple[int, int]:
    width, height = picture.size
    return (height, width) if picture.format == "TIFF" and _orientation(picture) in EXCHANGED else (width, height)


def check_picture(path: Path) -> None:
    """Decodes a picture to its end.

    Raises:
        InputError: missing, of another format, too large, or damaged; the file is named.
    """
    with open_picture(path) as picture:
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
        check_foreign(path)
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
    with open_picture(path) as picture:
        return _stored_size(picture)


def picture_info(path: Path) -> tuple[tuple[int, int], bool, int]:
    """((width, height), whether there is transparency, EXIF orientation) from the header alone; errors as in
    `picture_size`."""
    with open_picture(path) as picture:
        try:
            return _stored_size(picture), bool(picture.has_transparency_data), _orientation(picture)
        except Exception as error:
            raise InputError(f"{path}: not a readable picture ({_brief(error)})") from error


def is_deep_grey(path: Path) -> bool:
    """Whether a picture has one channel of 16 bits, as depth images have, from the header alone.

    Raises:
        InputError: unreadable.
    """
    with open_picture(path) as picture:
        return picture.mode in DEEP_GREY


def read_rgba(path: Path, *, reduction: int = 1) -> tuple[UInt8[np.ndarray, "H W 3"], UInt8[np.ndarray, "H W"] | None]:
    """Color (composited over black) and alpha, None where the file has none.

    Args:
        path: the file.
        reduction: 1, 2, 4 or 8: JPEG is decoded so many times smaller, and files of other formats are not.

    Raises:
        InputError: unreadable, damaged, too large, or of a kind that is not color.
    """
    with open_picture(path) as file:
        if file.format == "JPEG" and reduction > 1:
            file.draft("RGB", (file.width // reduction, file.height // reduction))
        picture = _decode(path, file)
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
    with open_picture(path) as file:
        if file.format == "JPEG":
            file.draft("RGB", (side, side))
            picture = np.asarray(_decode(path, file).convert("RGB"))
        else:
            picture = read_rgba(path)[0]
    step = max(1, min(picture.shape[:2]) // side)
    return picture[::step, ::step]


def read_mask(path: Path) -> Bool[np.ndarray, "H W"]:
    """Where a mask file is not 0. One that was saved as RGB is white and black like any other; alpha says nothing.

    Raises:
        InputError: unreadable or damaged.
    """
    with open_picture(path) as file:
        picture = _decode(path, file)
        values, bands = np.asarray(picture), picture.getbands()
    if values.ndim == 2:
        return np.asarray(values != 0)
    return np.asarray(values[..., : len(bands) - ("A" in bands)].any(axis=2))


def read_integers(path: Path, subject: str, *, wide: bool, data: io.BytesIO | None = None) -> np.ndarray:
    """A single-channel integer PNG [H, W], int32; `wide` asks for more than 8 bits, as depth in millimetres has.

    With `data`, the content of the file is there already, and `path` names it in messages.
    """
    with open_picture(path, data) as file:
        if file.format == "JPEG":
            raise InputError(f"{path}: {subject} was saved as JPEG, which changes values; expected PNG")
        allowed = DEEP_GREY + (() if wide else ("L", "P", "1"))
        if file.mode not in allowed:
            kind = "16-bit" if wide else "8- or 16-bit"
            raise InputError(f"{path}: {subject} must be a {kind} picture with one channel, got mode {file.mode}")
        values = np.asarray(_decode(path, file)).astype(np.int32)
    if values.size and values.min() < 0:
        raise InputError(f"{path}: {subject} has negative values")
    return values
