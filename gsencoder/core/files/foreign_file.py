"""Files that others named or wrote: regular ones of a limited size, so that nothing that is read goes on for ever."""

import os
import stat
from pathlib import Path
from typing import BinaryIO

from gsencoder.core.errors import InputError

TEXT_BYTES = 256 << 20
"""Larger files are no JSON and no text of one scene: some 100 MB describe a hundred thousand photographs."""
MODEL_BYTES = 16 << 30
"""Larger files are no camera model: COLMAP's largest published ones have 2 GB."""


def open_foreign(path: str | Path, max_bytes: int | None = None) -> BinaryIO:
    """Opens a regular file, or a link to one, for reading; a pipe does not block and a device is not read.

    Raises:
        OSError: as `open`.
        InputError: it is a folder, a pipe, a socket or a device, or has more bytes.
    """
    # Opening a pipe waits for a writer, unless it is asked not to; what was opened is then looked at, not its name.
    flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0) | getattr(os, "O_NOCTTY", 0)
    descriptor = os.open(path, flags)
    try:
        _check(path, os.fstat(descriptor), max_bytes)
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def check_foreign(path: str | Path, max_bytes: int | None = None) -> None:
    """Checks what `open_foreign` does, of a file that a library opens by its name.

    Raises:
        OSError: there is no such file, or the system refuses.
        InputError: as `open_foreign`.
    """
    _check(path, os.stat(path), max_bytes)


def read_foreign(path: str | Path, max_bytes: int = TEXT_BYTES) -> bytes:
    """The bytes of a file; errors as those of `open_foreign`."""
    with open_foreign(path, max_bytes) as stream:
        return stream.read()


def read_foreign_text(path: str | Path, max_bytes: int = TEXT_BYTES) -> str:
    """The text of a file in UTF-8, with or without a byte order mark, any line ends as \\n; errors as those of
    `open_foreign`, and UnicodeDecodeError."""
    return read_foreign(path, max_bytes).decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")


def _check(path: str | Path, status: os.stat_result, max_bytes: int | None) -> None:
    if not stat.S_ISREG(status.st_mode):
        what = "is a folder" if stat.S_ISDIR(status.st_mode) else "is not a regular file (a pipe or a device)"
        raise InputError(f"{path}: {what}; expected a file")
    if max_bytes is not None and status.st_size > max_bytes:
        raise InputError(f"{path}: {status.st_size:,} bytes; at most {max_bytes:,} are read")
