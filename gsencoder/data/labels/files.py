"""Files that others wrote: of a limited size, and never a pickle, which runs code when it is read."""

import csv
import io
import math
import os
import re
from codecs import BOM_UTF8
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int, Int64

from gsencoder.core.arrays import first_repeated
from gsencoder.core.errors import InputError, readable
from gsencoder.core.files import atomic_file, open_foreign, read_foreign, warn_if_modified
from gsencoder.data.readers.transforms_json import read_json

SCENE_BYTES = 256 << 20
"""Larger files are no predictions and no truth of one scene."""
LIST_BYTES = 1 << 30
"""Larger files are no lists of annotations or of predictions."""
PICKLE_SUFFIXES = (".p", ".pkl", ".pickle", ".pt", ".pth")
"""Of files that run code when they are read."""


def check_file(path: Path, *, max_bytes: int = SCENE_BYTES) -> None:
    """Raises an error for a file that cannot be read as text or JSON; its first bytes are looked at."""
    try:
        with open_foreign(path) as stream:
            size = os.fstat(stream.fileno()).st_size
            start = stream.read(4)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    # Pickles of protocol 2 and later begin with this byte, and no text in UTF-8 does.
    if path.suffix.lower() in PICKLE_SUFFIXES or start[:1] == b"\x80":
        raise InputError(
            f"{path}: is a pickle, which is refused since reading it can run code; load it where you trust it, and "
            "write its content as text, JSON or .npz"
        )
    if start == b"PK\x03\x04":
        raise InputError(f"{path}: is an archive (of torch.save, perhaps), and no text; write text, JSON or .npz")
    if size > max_bytes:
        raise InputError(f"{path}: {size:,} bytes; at most {max_bytes:,} are read")
    warn_if_modified(path)


def read_checked(path: Path, *, max_bytes: int = SCENE_BYTES) -> bytes:
    """The bytes of a file."""
    check_file(path, max_bytes=max_bytes)
    with readable(path):
        return read_foreign(path, max_bytes)


def read_checked_text(path: Path, *, max_bytes: int = SCENE_BYTES) -> str:
    """The text of a file in UTF-8, with or without a byte order mark."""
    try:
        return read_checked(path, max_bytes=max_bytes).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not a text file ({error.reason} at byte {error.start})") from error


LARGEST = 2**31 - 1
CHUNK = 1 << 20
"""Numbers that become text at once."""
NO_NUMBER = re.compile(rb"^(?![ \t]*[+-]?[0-9]+[ \t]*\r?$)", re.MULTILINE)


def read_integer_lines(path: Path, *, hint: str = "") -> Int64[np.ndarray, " n"]:
    """The numbers of a file with one a line, from -LARGEST to LARGEST.

    Args:
        hint: appended to the message about a line that is no whole number.
    """
    return _parsed(path, read_checked(path).removeprefix(BOM_UTF8), hint)


def read_mask(path: Path) -> Bool[np.ndarray, " n"]:
    """Which numbers of a file with one a line are not 0."""
    data = read_checked(path).removeprefix(BOM_UTF8)
    # Lines of one digit, as nearly all masks have them, need no parser.
    codes = np.frombuffer(data if data.endswith(b"\n") else data + b"\n", np.uint8)
    digits, ends = codes[::2], codes[1::2]
    if len(digits) == len(ends) and (ends == ord("\n")).all() and ((digits >= ord("0")) & (digits <= ord("9"))).all():
        return digits != ord("0")
    return _parsed(path, data, "") != 0


def _parsed(path: Path, data: bytes, hint: str) -> Int64[np.ndarray, " n"]:
    if not data:
        return np.zeros(0, np.int64)
    lines = data.removesuffix(b"\n")
    other = NO_NUMBER.search(lines)
    values = np.zeros(0, np.int64) if other else np.fromstring(lines, np.int64, sep="\n")
    large = np.flatnonzero((values > LARGEST) | (values < -LARGEST))
    if other or len(large):
        row = lines.count(b"\n", 0, other.start()) if other else int(large[0])
        word = lines.split(b"\n")[row].strip()[:40].decode("utf-8", "replace")
        raise InputError(f"{path}: line {row + 1}: expected one whole number, got {word!r}{hint}")
    return values


def write_integer_lines(path: Path, values: Int[np.ndarray, " n"]) -> None:
    """Writes one number a line, atomically."""
    with atomic_file(path) as stream:
        for start in range(0, len(values), CHUNK):
            stream.write("".join(f"{value}\n" for value in values[start : start + CHUNK].tolist()).encode())


def read_rows(
    path: Path, columns: Sequence[str], *, max_bytes: int, delimiter: str = ","
) -> list[tuple[dict[str, str], str]]:
    """The rows of a table with these columns, each with its place for messages; cells that a row lacks are empty."""
    text = read_checked_text(path, max_bytes=max_bytes)
    reader = csv.DictReader(io.StringIO(text, newline=""), delimiter=delimiter, restval="", strict=delimiter == ",")
    try:
        rows = [(row, f"{path}: line {reader.line_num}") for row in reader]
    except csv.Error as error:
        raise InputError(f"{path}: not a readable table ({' '.join(str(error).split())[:120]})") from error
    header = reader.fieldnames or ()
    missing = [column for column in columns if column not in header]
    if missing or len(set(header)) < len(header):
        wrong = f"lacks {', '.join(missing)}" if missing else "has a column twice"
        raise InputError(f"{path}: expected a table with the columns {', '.join(columns)}; its first line {wrong}")
    return rows


MAX_TEXT = 20_000
"""Characters of a question, an answer or a caption; the longest published ones have some hundred."""
MAX_ID = 200
"""Characters of an id or of the name of a class."""
MAX_COORDINATE = 1e9
"""Larger coordinates are no places."""

Corner = tuple[float, float, float]
Entry = tuple[Mapping[str, Any], str]
"""An object of a file, and its place for messages."""
_SIGNS = ((1, 1, 1), (1, 0, 1), (0, 0, 1), (0, 1, 1), (1, 1, 0), (1, 0, 0), (0, 0, 0), (0, 1, 0))


def read_benchmark_json(path: Path) -> Any:
    """The content of a JSON file, in which no object has a key twice."""
    check_file(path, max_bytes=LIST_BYTES)
    return read_json(path, unique_keys=True)


def entries_of(rows: Any, path: Path, expected: str, *, key: str = "") -> tuple[Entry, ...]:
    """The entries of a list of JSON objects, each with its place for messages.

    Args:
        key: under which the list stands in the file; empty = the file is the list.
    """
    if not isinstance(rows, list):
        expectation = f"{key} must be" if key else "expected"
        raise InputError(f"{path}: {expectation} a list of objects with {expected}, got {brief(rows)}")
    wheres = [f"{path}: {key}[{index}]" if key else f"{path}: entry {index}" for index in range(len(rows))]
    return tuple((object_of(row, where, expected), where) for row, where in zip(rows, wheres, strict=True))


def refuse_repeated(path: Path, keys: Iterable[Hashable], name: Callable[[Any], str], *, what: str = "id") -> None:
    """Raises an error if two entries of a file, in order, have one key."""
    if repeated := first_repeated(keys):
        key, first, second = repeated
        raise InputError(f"{path}: entries {first} and {second} have one {what}: {name(key)}; expected each once")


def brief(value: Any) -> str:
    """A value for a message, on one line and cut off; the type alone of what may be large."""
    if isinstance(value, (list, dict)):
        return "a list" if isinstance(value, list) else "an object"
    return "nothing" if value is None else repr(value[:60] if isinstance(value, str) else value)[:80]


def object_of(value: Any, where: str, expected: str) -> Mapping[str, Any]:
    """The value, which must be a JSON object."""
    if not isinstance(value, dict):
        raise InputError(f"{where}: expected an object with {expected}, got {brief(value)}")
    return value


def text_value(value: Any, where: str, field: str, *, empty: bool = False) -> str:
    """The value, which must be a text of at most `MAX_TEXT` characters, and not of blanks alone unless `empty`."""
    if not isinstance(value, str):
        raise InputError(f"{where}: {field} must be a text, got {brief(value)}")
    if len(value) > MAX_TEXT:
        raise InputError(
            f"{where}: {field} has {len(value):,} characters, expected at most {MAX_TEXT:,}: {brief(value)}"
        )
    if not empty and not value.strip():
        raise InputError(f"{where}: {field} is empty; expected a text")
    return value


def text_list(value: Any, where: str, field: str, *, empty: bool = False) -> tuple[str, ...]:
    """The value, which must be a list of texts; `empty` as in `text_value`, for each of them."""
    if not isinstance(value, list):
        raise InputError(f"{where}: {field} must be a list of texts, got {brief(value)}")
    return tuple(text_value(each, where, f"{field}[{index}]", empty=empty) for index, each in enumerate(value))


def scene_name(value: Any, where: str) -> str:
    """The name of a scene, such as scene0011_00."""
    name = text_value(value, where, "the scene")
    if name in (".", "..") or "/" in name or len(name) > 255 or not name.isprintable():
        raise InputError(f"{where}: the scene must be a name that a folder can have, got {brief(name)}")
    return name


def id_value(value: Any, where: str, field: str) -> str:
    """An id as text; files write them as texts and as whole numbers."""
    if isinstance(value, int) and not isinstance(value, bool):
        return str(value)
    return name_value(value, where, field, expected="a whole number or a text")


def annotation_id(value: Any, where: str, field: str = "ann_id") -> str:
    """The number of an annotation about an object, as text: 7, "7" and "07" are the same."""
    text = id_value(value, where, field)
    return str(int(text)) if text.isascii() and text.isdigit() else text


def name_value(value: Any, where: str, field: str, *, expected: str = "a text") -> str:
    """The name of a class: a text of one line."""
    if not isinstance(value, str) or not value.strip() or not value.isprintable() or len(value) > MAX_ID:
        raise InputError(
            f"{where}: {field} must be {expected} of one line with 1 to {MAX_ID} characters, got {brief(value)}"
        )
    return value


def flag_value(value: Any, where: str, field: str) -> bool | None:
    """0 or 1, or false or true; None if there is none."""
    if value is None:
        return None
    if not isinstance(value, int) or value not in (0, 1):
        raise InputError(f"{where}: {field} must be 0 or 1, got {brief(value)}")
    return bool(value)


def object_id(value: Any, where: str, field: str = "object_id") -> int:
    """The `objectId` of an object in ScanNet's aggregation file, from 0; files write it as a number and as a text."""
    if isinstance(value, str) and value.isdecimal() and value.isascii() and len(value) < 10:
        return int(value)
    if isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**31:
        return value
    raise InputError(f"{where}: {field} must be a whole number from 0, got {brief(value)}")


def number(value: Any, where: str, field: str, *, largest: float = 1e15) -> float:
    """A finite number."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputError(f"{where}: {field} must be a number, got {brief(value)}")
    if not abs(value) <= largest or not math.isfinite(value):
        raise InputError(f"{where}: {field} must be a finite number of at most {largest:g}, got {brief(value)}")
    return float(value)


def corner_bounds(value: Any, where: str, field: str) -> tuple[Corner, Corner]:
    """Lower and upper corner of an axis-aligned box, which is written by its eight corners, as the official scripts
    take them and of which the lowest and highest coordinates count, or by its lower and its upper corner.
    """
    rows = value if isinstance(value, list) else []
    if len(rows) not in (2, 8):
        raise InputError(
            f"{where}: {field} must be a list of 8 corners [x, y, z], or of a lower and an upper one, got "
            f"{brief(value)}"
        )
    corners = []
    for row, corner in enumerate(rows):
        if not isinstance(corner, list) or len(corner) != 3:
            raise InputError(f"{where}: {field}[{row}] must be a corner [x, y, z], got {brief(corner)}")
        corners.append([number(each, where, f"{field}[{row}]", largest=MAX_COORDINATE) for each in corner])
    lower, upper = ([pick(axis) for axis in zip(*corners, strict=True)] for pick in (min, max))
    if len(corners) == 2 and lower != corners[0]:
        raise InputError(f"{where}: {field}: the lower corner {corners[0]} is not below the upper {corners[1]}")
    return (lower[0], lower[1], lower[2]), (upper[0], upper[1], upper[2])


def box_corners(lower: Corner, upper: Corner) -> list[list[float]]:
    """The eight corners of an axis-aligned box as the official scripts of ScanRefer, Scan2Cap and ScanQA write them:
    around the top, then around the bottom (utils/box_util.py).
    """
    return [[(lower, upper)[side][axis] for axis, side in enumerate(sides)] for sides in _SIGNS]


VOLUME_EPSILON = 1e-8
"""Volume that both add to a union, in cubic world units (metres, in ScanNet)."""


def box_ious(boxes: Float64[np.ndarray, "K 2 3"], box: Float64[np.ndarray, "2 3"]) -> Float64[np.ndarray, " K"]:
    """IoU of boxes, by lower and upper corners, with one: common volume / (volume + volume - common volume + 1e-8).

    So boxes without volume overlap nothing, and a box that is one quarter of another is below 0.25.
    """
    common = np.maximum(np.minimum(boxes[:, 1], box[1]) - np.maximum(boxes[:, 0], box[0]), 0)
    sizes, size = boxes[:, 1] - boxes[:, 0], box[1] - box[0]
    volume = common[:, 0] * common[:, 1] * common[:, 2]
    # The order of the operations decides ties at a threshold.
    union = sizes[:, 0] * sizes[:, 1] * sizes[:, 2] + size[0] * size[1] * size[2] - volume + VOLUME_EPSILON
    return volume / union


MAX_BYTES = 16 << 20


def read_split(path: Path) -> tuple[str, ...]:
    """The names of the scenes of a split, in the order of the file; blank lines are left out."""
    lines = read_checked_text(path, max_bytes=MAX_BYTES).splitlines()
    first: dict[str, int] = {}
    for number, line in enumerate(lines, start=1):
        name = line.strip()
        if not name:
            continue
        if name in (".", "..") or any(each in name for each in "/\\\0") or len(name) > 255 or len(name.split()) > 1:
            raise InputError(f"{path}: line {number}: expected the name of a scene, got {name[:60]!r}")
        if name in first:
            raise InputError(f"{path}: line {number}: {name!r} is already on line {first[name]}")
        first[name] = number
    if not first:
        raise InputError(f"{path}: lists no scene; expected one name a line")
    return tuple(first)
