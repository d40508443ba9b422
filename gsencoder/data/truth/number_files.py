"""Text files with one whole number a line: labels of vertices, instances of truth, and masks, in ScanNet's formats."""

import re
import warnings
from codecs import BOM_UTF8
from contextlib import suppress
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int, Int64

from gsencoder.core.errors import InputError
from gsencoder.core.files import atomic_file
from gsencoder.data.truth.checked_files import read_checked

LARGEST = 2**31 - 1
"""Largest number, and negative of the smallest."""
CHUNK = 1 << 20
"""Numbers that become text at once."""


def read_whole_numbers(path: Path, *, hint: str = "") -> Int64[np.ndarray, " n"]:
    """The numbers of a file with one a line.

    Args:
        path: of the file.
        hint: appended to the message about a line that is no whole number.

    Raises:
        InputError: unreadable, or a line that is no whole number.
    """
    return _parsed(path, read_checked(path).removeprefix(BOM_UTF8), hint)


def read_mask(path: Path) -> Bool[np.ndarray, " n"]:
    """Which numbers of a file with one a line are not 0.

    Raises:
        InputError: as `read_whole_numbers`.
    """
    data = read_checked(path).removeprefix(BOM_UTF8)
    # Lines of one digit, as nearly all masks have them, need no parser.
    codes = np.frombuffer(data if data.endswith(b"\n") else data + b"\n", np.uint8)
    digits, ends = codes[::2], codes[1::2]
    if len(digits) == len(ends) and (ends == ord("\n")).all() and ((digits >= ord("0")) & (digits <= ord("9"))).all():
        return digits != ord("0")
    return _parsed(path, data, "") != 0


def write_whole_numbers(path: Path, values: Int[np.ndarray, " n"]) -> None:
    """Writes one number a line, atomically.

    Raises:
        InputError: the file cannot be written.
    """
    with atomic_file(path) as stream:
        for start in range(0, len(values), CHUNK):
            stream.write("".join(f"{value}\n" for value in values[start : start + CHUNK].tolist()).encode())


def mask_bytes(mask: Bool[np.ndarray, " n"]) -> bytes:
    """A mask as text, 0 or 1 a line."""
    codes = np.full((len(mask), 2), ord("\n"), np.uint8)
    codes[:, 0] = mask + ord("0")
    return codes.tobytes()


def _parsed(path: Path, data: bytes, hint: str) -> Int64[np.ndarray, " n"]:
    lines, values = data.count(b"\n") + (not data.endswith(b"\n") and bool(data)), np.zeros(0, np.int64)
    with warnings.catch_warnings(), suppress(ValueError):
        # At what it cannot read, numpy warns and stops, or from 2.3 on raises.
        warnings.simplefilter("ignore", DeprecationWarning)
        values = np.fromstring(data, np.int64, sep="\n") if data.strip() else values
    if len(values) == lines and (not lines or max(values.max(), -values.min()) <= LARGEST) and _plain(data):
        return values
    for number, line in enumerate(data.splitlines(), start=1):
        word = line.strip()
        digits = word[1:] if word[:1] in (b"-", b"+") else word
        # Of thousands of digits Python makes no number.
        short = digits.lstrip(b"0") or b"0"
        if not digits.isdigit() or len(short) > 10 or int(short) > LARGEST:
            start = word[:40].decode("utf-8", "replace")
            raise InputError(f"{path}: line {number}: expected one whole number, got {start!r}{hint}")
    raise InputError(f"{path}: expected one whole number a line")


def _plain(data: bytes) -> bool:
    """Whether a file has digits, signs before digits, and blanks alone."""
    if data.translate(None, b"0123456789+- \t\r\n"):
        return False
    # numpy reads a sign alone as 0.
    return not ((b"+" in data or b"-" in data) and re.search(rb"[+-](?![0-9])", data))
