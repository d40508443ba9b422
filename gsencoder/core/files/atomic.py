"""Atomic files, folder locks and the detection of full disks."""

import errno
import os
import re
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from gsencoder.core.errors import InputError

try:
    import fcntl
except ImportError:  # Without it, runs do not see each other's locks.
    fcntl = None  # type: ignore[assignment]


def lock_folder(folder: str | Path, *, wait: bool = False) -> int | None:
    """Locks a folder and returns the open descriptor; the system releases the lock when it is closed or the process
    ends. None where folders cannot be locked (some network file systems).

    Args:
        folder: an existing one.
        wait: whether to wait until another run releases its lock.

    Raises:
        BlockingIOError: another run holds the lock.
        OSError: there is no such folder, or it may not be opened.
    """
    if fcntl is None:
        return None
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        os.close(descriptor)
        raise
    except OSError:
        os.close(descriptor)
        return None
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


def is_full_disk(error: BaseException) -> bool:
    """Whether an error of the system or of a library means that the disk or the quota is full."""
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return True
    # numpy reports "4096 requested and 100 written"; safetensors quotes the system's message in its error.
    short = (
        isinstance(error, OSError) and error.errno is None and re.search(r"\d+ requested and \d+ written", str(error))
    )
    return bool(short) or os.strerror(errno.ENOSPC) in str(error)


@contextmanager
def atomic_file(path: str | Path) -> Iterator[BinaryIO]:
    """Opens a binary file that appears at `path` only if the block ends without an error.

    It is written under a temporary name in the same folder, synced to disk and renamed, so that a kill or a full disk
    leaves an earlier file as it was.

    Raises:
        InputError: the folder is missing, or the system refuses the write.
    """
    target = Path(path)
    if target.is_dir():
        raise InputError(f"{target}: is a folder; give the name of a file to write")
    if not target.parent.is_dir():
        raise InputError(f"{target}: the folder {target.parent} does not exist; make it first")
    temporary = target.parent / f".{target.name[:100]}.{secrets.token_hex(6)}.tmp"
    try:
        with open(temporary, "xb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, target)
    except OSError as error:
        raise InputError(f"{target}: cannot write: {error.strerror or error}") from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
