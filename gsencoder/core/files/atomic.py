"""Atomic files, folder locks and the detection of full disks."""

import errno
import os
import re
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from hashlib import sha1
from pathlib import Path
from typing import BinaryIO

from gsencoder.core.errors import InputError, WriteError

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


@contextmanager
def locked(folder: str | Path, *, wait: bool = False) -> Iterator[bool]:
    """Locks a folder for the block; gives whether it could be locked. Arguments and errors are those of
    `lock_folder`."""
    descriptor = lock_folder(folder, wait=wait)
    try:
        yield descriptor is not None
    finally:
        if descriptor is not None:
            os.close(descriptor)


def is_full_disk(error: BaseException) -> bool:
    """Whether an error of the system or of a library means that the disk or the quota is full."""
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return True
    # numpy reports "4096 requested and 100 written"; safetensors quotes the system's message in its error.
    short = (
        isinstance(error, OSError) and error.errno is None and re.search(r"\d+ requested and \d+ written", str(error))
    )
    return bool(short) or os.strerror(errno.ENOSPC) in str(error)


def full_disk(path: str | Path) -> WriteError:
    """The error of a file for which there is no room."""
    return WriteError(f"{path}: no space left on the device; make room and give the command again")


@contextmanager
def temporary_beside(target: Path) -> Iterator[Path]:
    """A file of a hidden name in the folder of `target`, to write and then to rename to it; it is removed at the end of
    the block if it is still there.

    The name is the same every time, so that the file that a killed run left is written over by the next and not left
    for good. The file is locked; a second run that writes the same target meanwhile gets a name of its own.

    Raises:
        OSError: the folder is missing, or the system refuses.
    """
    path = target.parent / f".{_short(target.name)}.tmp"
    descriptor = _locked_file(path)
    if descriptor is None:
        path = path.with_name(f".{_short(target.name)}.{secrets.token_hex(6)}.tmp")
    try:
        yield path
    finally:
        with suppress(OSError):
            # Once this file is renamed, another run may have one of the name.
            if descriptor is None or _is_file_of(path, descriptor):
                path.unlink(missing_ok=True)
        if descriptor is not None:
            os.close(descriptor)


def _is_file_of(path: Path, descriptor: int) -> bool:
    """Whether a name is that of an open file, and not of another that has taken its place."""
    try:
        here = os.stat(path, follow_symlinks=False)
    except FileNotFoundError:
        return False
    own = os.fstat(descriptor)
    return (here.st_dev, here.st_ino) == (own.st_dev, own.st_ino)


def _short(name: str) -> str:
    """The name, or a part and a digest of it if the temporary name would be longer than file systems allow."""
    raw = os.fsencode(name)
    return name if len(raw) <= 200 else f"{name[:40]}.{sha1(raw).hexdigest()}"


def _locked_file(path: Path) -> int | None:
    """Creates an empty file, or empties that of a killed run, and locks it; None if another run has it, or files cannot
    be locked here."""
    if fcntl is None:
        return None
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        # The run that had it may have renamed it before it released the lock.
        if _is_file_of(path, descriptor):
            try:
                os.ftruncate(descriptor, 0)
            except OSError:
                path.unlink(missing_ok=True)
                raise
            return descriptor
    except OSError as error:
        if error.errno not in (errno.EAGAIN, errno.EACCES, errno.ENOTSUP, errno.ENOSYS, errno.ENOLCK, errno.EINVAL):
            os.close(descriptor)
            raise
    os.close(descriptor)
    return None


@contextmanager
def atomic_file(path: str | Path) -> Iterator[BinaryIO]:
    """Opens a binary file that appears at `path` only if the block ends without an error.

    It is written under a temporary name in the same folder, synced to disk and renamed, so that a kill or a full disk
    leaves an earlier file as it was.

    Raises:
        InputError: the folder is missing, or `target` is one.
        WriteError: the disk is full, or the system refuses the write.
    """
    target = Path(path)
    with _named_errors(target):
        _check_folder(target)
        with temporary_beside(target) as temporary:
            with open(temporary, "wb") as stream:
                yield stream
                stream.flush()
                os.fsync(stream.fileno())
            os.replace(temporary, target)


def check_writable(path: str | Path) -> None:
    """Checks that `atomic_file` could write a file, by opening its temporary file: before work that takes a while.

    Raises:
        InputError: the folder is missing, or `path` is one.
        WriteError: the disk is full, or the system refuses the write.
    """
    target = Path(path)
    with _named_errors(target):
        _check_folder(target)
        with suppress(FileNotFoundError):
            os.lstat(target)  # The temporary name is shorter where this one is too long.
        with temporary_beside(target) as temporary, open(temporary, "wb"):
            pass


def _check_folder(target: Path) -> None:
    if target.is_dir():
        raise InputError(f"{target}: is a folder; give the name of a file to write")
    if not target.parent.is_dir():
        raise InputError(f"{target}: the folder {target.parent} does not exist; make it first")


@contextmanager
def _named_errors(target: Path) -> Iterator[None]:
    """Turns an error of the system in the block into one that names the file."""
    try:
        yield
    except OSError as error:
        if is_full_disk(error):
            raise full_disk(target) from error
        raise WriteError(f"{target}: cannot write: {error.strerror or error}") from error
