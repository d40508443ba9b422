"""Results that are one file, with its summary and other files beside it."""

import os
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from gsencoder.core.errors import InputError
from gsencoder.core.files import check_writable, locked


def refuse_existing(path: str | Path, overwrite: bool) -> None:
    """Checks, for commands whose result is one file, that it does not exist or may be replaced.

    Raises:
        InputError: it exists.
    """
    if os.path.isdir(path):
        raise InputError(f"{path}: is a folder; give the name of a file to write")
    if os.path.lexists(path) and not overwrite:
        raise InputError(f"{path}: exists; give another out= or overwrite=true")


def check_output_files(paths: Iterable[Path], overwrite: bool) -> None:
    """Checks files before the work whose results they will hold: none exists that may not be replaced, and all can be
    written.

    Raises:
        InputError: one exists, its folder is missing, or the system refuses.
    """
    for path in paths:
        refuse_existing(path, overwrite)
        check_writable(path)


@contextmanager
def sole_writer(path: Path, *, overwrite: bool) -> Iterator[None]:
    """Lets one run at a time write a file and what belongs beside it.

    Two runs of one out= would otherwise leave the file of one beside the summary of the other, and the second would
    replace what the first has written since it began. Runs that write into the same folder wait for each other here,
    for as long as the writing takes.

    Args:
        path: the file.
        overwrite: whether a file that is there is replaced.

    Raises:
        InputError: another run has written the file meanwhile.
    """
    with ExitStack() as stack:
        # Where the folder is missing or refuses, whoever writes the file says so.
        with suppress(OSError):
            stack.enter_context(locked(path.resolve().parent, wait=True))
        refuse_existing(path, overwrite)
        yield
