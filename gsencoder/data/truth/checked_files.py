"""Files that others wrote: of a limited size, and never a pickle, which runs code when it is read."""

import os
from pathlib import Path

from gsencoder.core.errors import InputError, readable
from gsencoder.core.files import check_written, open_foreign, read_foreign

SCENE_BYTES = 256 << 20
"""Larger files are no predictions and no truth of one scene."""
LIST_BYTES = 1 << 30
"""Larger files are no lists of annotations or of predictions."""
PICKLE_SUFFIXES = (".p", ".pkl", ".pickle", ".pt", ".pth")
"""Of files that run code when they are read."""


def check_file(path: Path, *, max_bytes: int = SCENE_BYTES) -> None:
    """Raises an error for a file that cannot be read as text or JSON; its first bytes are looked at.

    Raises:
        InputError: there is no such file, it is a folder, it is too large, or it is a pickle or an archive.
    """
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
    check_written(path)


def read_checked(path: Path, *, max_bytes: int = SCENE_BYTES) -> bytes:
    """The bytes of a file.

    Raises:
        InputError: as `check_file`, or the file cannot be read.
    """
    check_file(path, max_bytes=max_bytes)
    with readable(path):
        return read_foreign(path, max_bytes)


def read_checked_text(path: Path, *, max_bytes: int = SCENE_BYTES) -> str:
    """The text of a file in UTF-8, with or without a byte order mark.

    Raises:
        InputError: as `read_checked`, or the file is not UTF-8.
    """
    try:
        return read_checked(path, max_bytes=max_bytes).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not a text file ({error.reason} at byte {error.start})") from error
