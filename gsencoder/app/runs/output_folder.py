"""Atomic output folders, with the summary of the run, and checks of what they would replace."""

import ctypes
import errno
import os
import re
import secrets
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from hashlib import sha1
from pathlib import Path
from typing import Any

from gsencoder.app.runs.summary import Summary
from gsencoder.core.errors import BusyError, InputError
from gsencoder.core.files import SUMMARY_NAME, checksums_of, is_full_disk, json_bytes, lock_folder, write_bytes
from gsencoder.core.process import raise_dropped_stop

AT_FDCWD, RENAME_EXCHANGE = -100, 2


@contextmanager
def output_folder(path: str | Path, *, overwrite: bool = False, summary: Summary | None = None) -> Iterator[Path]:
    """Opens a folder to write into, which is renamed to `path` when the block ends without an error.

    Until then it is a hidden folder beside it, `.NAME.partial-XXXXXXXX`. It is removed if the block ends early, also by
    an interrupt; the folder of a killed run is removed by the next run that writes to the same path. Everything is
    synced to disk before the folder is renamed.

    Args:
        path: the folder; its parents are created. It may exist if it is empty.
        overwrite: replace the output of an earlier run, recognized by its summary.json. Where the system can (Linux),
            old and new are exchanged in one step.
        summary: written into the folder at the end, as summary.json, with the checksums of files that have none.

    Raises:
        InputError: the folder exists, holds something else, is being written by another run, or cannot be written;
            or the disk is full.
    """
    # Of a symbolic link the target is replaced, not the link.
    target = Path(os.path.realpath(path))
    _check_target(path, target, overwrite)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        partial, lock = _begin(path, target, overwrite)
    except BlockingIOError:
        raise BusyError(f"{path}: another run is writing this folder now; wait for it or give another out=") from None
    except FileExistsError as error:
        raise InputError(f"{path}: {error.filename} is a file, so no folder can be made in it") from error
    except OSError as error:
        raise InputError(f"{path}: cannot write here: {error.strerror or error}") from error
    try:
        yield partial
        if summary is not None:
            record = summary.to_dict() | {"files": checksums_of(partial)}
            write_bytes(partial / SUMMARY_NAME, json_bytes(record)[0])
        _sync(partial)
        _check_target(path, target, overwrite)
        raise_dropped_stop()
        _move_into_place(partial, target)
    except Exception as error:
        message = _refusal(error, partial, target, path)
        if message is None:
            raise
        raise InputError(message) from error
    finally:
        # After an exchange this is the old output.
        shutil.rmtree(partial, ignore_errors=True)
        if lock is not None:
            os.close(lock)


def _begin(path: str | Path, target: Path, overwrite: bool) -> tuple[Path, int | None]:
    """Creates and locks the hidden folder. Runs that start at the same moment do so one after the other: a folder that
    is created and not yet locked would be mistaken for that of a killed run.

    Raises:
        BlockingIOError: another run is writing `target`.
        InputError: results are there by now, and are not to be replaced.
    """
    parent_lock = lock_folder(target.parent, wait=True)
    try:
        if _remove_stale(target):
            raise BlockingIOError
        _put_back(target)
        # Another run may have written the folder since it was looked at.
        _check_target(path, target, overwrite)
        partial = target.parent / f".{_short(target.name)}.partial-{secrets.token_hex(4)}"
        partial.mkdir()
        return partial, lock_folder(partial)
    finally:
        if parent_lock is not None:
            os.close(parent_lock)


def _check_target(path: str | Path, target: Path, overwrite: bool) -> None:
    try:
        os.lstat(target)
    except (FileNotFoundError, NotADirectoryError):
        return
    except OSError as error:
        raise InputError(f"{path}: cannot write here: {error.strerror or error}") from error
    if not target.is_dir():
        raise InputError(f"{path}: is a file, and the results are a folder; give another out=")
    if os.path.ismount(target):
        raise InputError(f"{path}: is a mount point, which cannot be exchanged for the results; give a folder in it")
    with suppress(OSError):
        if not any(target.iterdir()):
            return
    if not (target / SUMMARY_NAME).is_file():
        raise InputError(
            f"{path}: is a folder with other contents (no {SUMMARY_NAME}), which is never replaced; give another out="
        )
    if not overwrite:
        raise InputError(f"{path}: holds the results of an earlier run; give another out= or overwrite=true")


def refuse_to_replace_inputs(out: Path | None, values: Mapping[str, Any]) -> None:
    """Checks that a folder that is about to be replaced holds none of the inputs, and that a file is none.

    Args:
        out: the folder or file.
        values: the settings of the run; every text in them that names an existing file or folder is an input.

    Raises:
        InputError: it holds one, or is one.
    """
    if out is None or not os.path.exists(out):
        return
    for key, name in _texts({key: value for key, value in values.items() if key != "out"}):
        if os.path.exists(name) and lies_in(name, out):
            holds = "holds" if os.path.isdir(out) else "is"
            raise InputError(f"{out}: {holds} the input {key}={name}, so it cannot be replaced; give another out=")


def lies_in(path: str | Path, folder: str | Path) -> bool:
    """Whether a path is in a folder or is the folder, with symbolic links resolved."""
    inner, outer = os.path.realpath(path), os.path.realpath(folder)
    return os.path.commonpath([inner, outer]) == outer


def _texts(value: Any, key: str = "") -> Iterator[tuple[str, str]]:
    """Yields all strings in nested settings that could be paths, with their keys."""
    if isinstance(value, str) and 0 < len(value) < 4096 and "\0" not in value:
        yield key, value
    elif isinstance(value, Mapping):
        for name, item in value.items():
            yield from _texts(item, f"{key}.{name}" if key else str(name))
    elif isinstance(value, (list, tuple)):
        for item in value:
            yield from _texts(item, key)


def _short(name: str) -> str:
    """The name, or a digest of it if the temporary name would be longer than file systems allow."""
    raw = os.fsencode(name)
    return name if len(raw) <= 200 else sha1(raw).hexdigest()


def _remove_stale(target: Path) -> bool:
    """Removes the hidden folders of killed runs beside `target`; returns whether another run is writing it now.

    Where folders cannot be locked (some network file systems) nothing is removed and no run is detected.
    """
    pattern = re.compile(re.escape(f".{_short(target.name)}.partial-") + "[0-9a-f]{8}")
    for entry in list(os.scandir(target.parent)):
        if not pattern.fullmatch(entry.name) or not entry.is_dir(follow_symlinks=False):
            continue
        try:
            descriptor = lock_folder(entry.path)
        except BlockingIOError:
            return True
        except OSError:
            continue
        if descriptor is not None:
            shutil.rmtree(entry.path, ignore_errors=True)
            os.close(descriptor)
    return False


def _sync(folder: Path) -> None:
    for root, _, names in os.walk(folder, topdown=False):
        for name in names:
            path = os.path.join(root, name)
            if not os.path.islink(path):
                _sync_one(path)
        _sync_one(root)


def _sync_one(path: str | Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        # Some file systems cannot sync a folder; a file that cannot be synced is an error.
        if os.path.isfile(path) or error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise OSError(error.errno, error.strerror, os.fspath(path)) from error
    finally:
        os.close(descriptor)


def _move_into_place(partial: Path, target: Path) -> None:
    """Renames `partial` to `target`; an existing `target` is renamed to `partial`."""
    old = target.is_dir() and any(target.iterdir())
    if not old:
        os.rename(partial, target)
    elif not _exchange(partial, target):
        # Not the name of a hidden folder that the next run removes: a kill between the two would lose the old results.
        aside = _aside(target)
        os.rename(target, aside)
        try:
            os.rename(partial, target)
        except BaseException:
            os.rename(aside, target)
            raise
        os.rename(aside, partial)
    _sync_one(target.parent)


def _aside(target: Path) -> Path:
    """Where earlier results lie for a moment while new ones take their name, if the system cannot exchange names."""
    return target.parent / f".{_short(target.name)}.earlier"


def _put_back(target: Path) -> None:
    """Gives earlier results their name back that a run was replacing when it was killed."""
    aside = _aside(target)
    if not aside.is_dir():
        return
    if os.path.lexists(target):
        shutil.rmtree(aside, ignore_errors=True)
    else:
        os.rename(aside, target)


def _exchange(first: Path, second: Path) -> bool:
    """Exchanges two names in one step; False if the system does not support it."""
    try:
        renameat2 = ctypes.CDLL(None, use_errno=True).renameat2
    except (OSError, AttributeError, TypeError):
        return False
    return bool(renameat2(AT_FDCWD, os.fsencode(first), AT_FDCWD, os.fsencode(second), RENAME_EXCHANGE) == 0)


def _refusal(error: Exception, partial: Path, target: Path, path: str | Path) -> str | None:
    """The message for an error of writing, or None for any other error."""
    if isinstance(error, InputError) and str(partial) not in str(error):
        # Files elsewhere, such as the checkpoint of a run that can be resumed, still exist.
        return str(error)
    if (isinstance(error, OSError) and error.errno == errno.EFBIG) or os.strerror(errno.EFBIG) in str(error):
        return f"{path}: a file would grow larger than this system or shell allows (ulimit -f): no result was written"
    if is_full_disk(error):
        return f"{path}: no space left on the device: no result was written"
    if isinstance(error, InputError):
        return str(error).replace(str(partial), str(path))
    if not isinstance(error, OSError):
        return None
    # A file that is copied has the second name; an error of copying a folder lists such errors.
    names, reason = [str(each) for each in (error.filename2, error.filename) if each is not None], error.strerror
    if isinstance(error, shutil.Error) and error.args and error.args[0] and not isinstance(error.args[0], str):
        source, copy, reason = map(str, error.args[0][0])
        names = [copy, source]
        reason = reason.partition("] ")[2].partition(": ")[0] or reason
    for name in names:
        if name.startswith(str(partial)):
            return f"{name.replace(str(partial), str(path))}: cannot write: {reason or error}"
    if str(target) in names:
        return f"{path}: cannot be replaced by the results: {error.strerror or error}"
    if str(target.parent) in names:
        return f"{path}: the results are written; the system cannot sync {target.parent}: {error.strerror or error}"
    return None
