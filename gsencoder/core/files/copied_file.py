"""Copies of files, checked after they were copied."""

from collections.abc import Callable
from pathlib import Path
from shutil import copyfile

from gsencoder.core.errors import InputError


def copy_checked(source: Path, target: Path, check: Callable[[Path], object]) -> None:
    """Copies a file and checks the copy, since the source may have been cut off while it was copied.

    Args:
        source: the file.
        target: its copy.
        check: reads the copy; raises InputError where it is damaged.

    Raises:
        InputError: the copy cannot be written, or is damaged; then the source is named.
    """
    try:
        copyfile(source, target)
    except OSError as error:
        raise InputError(f"{target}: cannot be written: {error.strerror or error}") from error
    try:
        check(target)
    except InputError as error:
        raise InputError(str(error).replace(str(target), str(source))) from error
