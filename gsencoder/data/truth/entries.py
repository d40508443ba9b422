"""Checked values of the JSON files in which benchmarks of language in scenes are published."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gsencoder.core.errors import InputError
from gsencoder.data.readers.transforms_json import read_json

MAX_BYTES = 1 << 30
"""Larger files are no annotations."""
MAX_TEXT = 20_000
"""Largest number of characters of a question, an answer or a caption; the longest published ones have some hundred."""
MAX_ID = 200
"""Largest number of characters of an id."""
PICKLES = (".pkl", ".pickle", ".p", ".pt", ".pth")
"""Suffixes of files that run code when they are read."""

Corner = tuple[float, float, float]
_SIGNS = ((1, 1, 1), (1, 0, 1), (0, 0, 1), (0, 1, 1), (1, 1, 0), (1, 0, 0), (0, 0, 0), (0, 1, 0))


def read_benchmark_json(path: Path) -> Any:
    """The content of a JSON file, in which no object has a key twice.

    Raises:
        InputError: unreadable, a pickle, too large, not JSON, or a key is there twice.
    """
    refuse_pickle(path)
    return read_json(path, unique_keys=True)


def refuse_pickle(path: Path) -> None:
    """Raises an error for a file that cannot be a text file of annotations.

    Raises:
        InputError: missing, too large, or a pickle, which could run any code when it is read.
    """
    try:
        size = path.stat().st_size
        if path.is_dir():
            raise InputError(f"{path}: is a folder; expected a file")
        with open(path, "rb") as stream:
            start = stream.read(4)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    if path.suffix.lower() in PICKLES or start[:1] == b"\x80" or start == b"PK\x03\x04":
        raise InputError(
            f"{path}: is a pickle or an archive of one, which can run code when it is read; expected JSON: load it "
            "where you trust it and write the same lists and names with json.dump"
        )
    if size > MAX_BYTES:
        raise InputError(f"{path}: {size:,} bytes, at most {MAX_BYTES:,} in a file of annotations")


def shown(value: Any) -> str:
    """The first characters of a value, on one line, for a message."""
    text = value[:60] if isinstance(value, str) else value
    return repr(text)[:60]


def object_of(value: Any, where: str, expected: str) -> Mapping[str, Any]:
    """The value, which must be a JSON object.

    Raises:
        InputError: it is something else.
    """
    if not isinstance(value, dict):
        raise InputError(f"{where}: expected an object with {expected}, got {shown(value)}")
    return value


def text_value(value: Any, where: str, what: str, *, empty: bool = False) -> str:
    """The value, which must be a text of at most `MAX_TEXT` characters.

    Args:
        value: of the file.
        where: file and entry.
        what: name of the value.
        empty: whether a text without a character other than blanks is one.

    Raises:
        InputError: no text, an empty one, or one that is too long.
    """
    if not isinstance(value, str):
        raise InputError(f"{where}: {what} must be a text, got {shown(value)}")
    if len(value) > MAX_TEXT:
        raise InputError(
            f"{where}: {what} has {len(value):,} characters, expected at most {MAX_TEXT:,}: {shown(value)}"
        )
    if not empty and not value.strip():
        raise InputError(f"{where}: {what} is empty; expected a text")
    return value


def text_list(value: Any, where: str, what: str, *, empty: bool = False) -> tuple[str, ...]:
    """The value, which must be a list of texts; `empty` as in `text_value`, for each of them.

    Raises:
        InputError: no list, or a member that is no text.
    """
    if not isinstance(value, list):
        raise InputError(f"{where}: {what} must be a list of texts, got {shown(value)}")
    return tuple(text_value(each, where, f"{what}[{index}]", empty=empty) for index, each in enumerate(value))


def scene_name(value: Any, where: str) -> str:
    """The name of a scene, such as scene0011_00.

    Raises:
        InputError: no text, or one that a folder cannot be called.
    """
    name = text_value(value, where, "the scene")
    if name in (".", "..") or "/" in name or len(name) > 255 or not name.isprintable():
        raise InputError(f"{where}: the scene must be a name that a folder can have, got {shown(name)}")
    return name


def id_value(value: Any, where: str, what: str) -> str:
    """An id as text; files write them as texts and as whole numbers.

    Raises:
        InputError: neither of both, empty, or with characters that cannot be printed on a line.
    """
    if isinstance(value, int) and not isinstance(value, bool):
        return str(value)
    if isinstance(value, str) and value.strip() and value.isprintable() and len(value) <= MAX_ID:
        return value
    raise InputError(
        f"{where}: {what} must be a whole number or a text of one line with 1 to {MAX_ID} characters, got "
        f"{shown(value)}"
    )


def object_id(value: Any, where: str, what: str = "object_id") -> int:
    """The `objectId` of an object in ScanNet's aggregation file, from 0; files write it as a number and as a text.

    Raises:
        InputError: no whole number from 0.
    """
    if isinstance(value, str) and value.isdecimal() and value.isascii() and len(value) < 10:
        return int(value)
    if isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**31:
        return value
    raise InputError(f"{where}: {what} must be a whole number from 0, got {shown(value)}")


def number(value: Any, where: str, what: str) -> float:
    """A finite number.

    Raises:
        InputError: something else.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputError(f"{where}: {what} must be a number, got {shown(value)}")
    if not abs(value) < 1e15 or not math.isfinite(value):
        raise InputError(f"{where}: {what} must be a finite number, got {shown(value)}")
    return float(value)


def corner_bounds(value: Any, where: str, what: str) -> tuple[Corner, Corner]:
    """Lower and upper corner of a box that is written by its eight corners, as the official scripts take them.

    Raises:
        InputError: not eight corners of three finite numbers.
    """
    if not isinstance(value, list) or len(value) != 8:
        raise InputError(f"{where}: {what} must be a list of 8 corners [x, y, z], got {shown(value)}")
    corners = []
    for row, corner in enumerate(value):
        if not isinstance(corner, list) or len(corner) != 3:
            raise InputError(f"{where}: {what}[{row}] must be a corner [x, y, z], got {shown(corner)}")
        corners.append([number(each, where, f"{what}[{row}]") for each in corner])
    lower, upper = ([pick(axis) for axis in zip(*corners, strict=True)] for pick in (min, max))
    return (lower[0], lower[1], lower[2]), (upper[0], upper[1], upper[2])


def box_corners(lower: Corner, upper: Corner) -> list[list[float]]:
    """The eight corners of an axis-aligned box as the official scripts of ScanRefer, Scan2Cap and ScanQA write them:
    around the top, then around the bottom (utils/box_util.py).
    """
    return [[(lower, upper)[side][axis] for axis, side in enumerate(sides)] for sides in _SIGNS]
