"""Paths that are no regular files, and a limit on the time that it takes to refuse them."""

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def make_no_file(path: Path, kind: str) -> Path:
    """A pipe, a folder, a link to a device that never ends, or a link to nothing."""
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    else:
        path.symlink_to("/dev/zero" if kind == "device" else path.parent / "gone")
    return path


@contextmanager
def ends_within(seconds: float) -> Iterator[None]:
    """Raises TimeoutError in a block that takes longer."""

    def late(*_: object) -> None:
        raise TimeoutError(f"it did not end within {seconds:g} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
