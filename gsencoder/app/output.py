"""Where a run writes: the file or folder of results, with its record, and the folder of unfinished work."""

import ctypes
import errno
import os
import re
import secrets
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any

from gsencoder.core.errors import BusyError, InputError
from gsencoder.core.files import (
    SUMMARY_NAME,
    UNFINISHED_FILE,
    atomic_file,
    check_writable,
    checksums_of,
    is_full_disk,
    json_bytes,
    lock_folder,
    locked,
    sha256_of,
    short_name,
    write_bytes,
    write_json,
)

Record = Callable[[], dict[str, Any]]
"""Makes the record of a run, for summary.json."""


def check_output_files(paths: Iterable[Path], overwrite: bool) -> None:
    """Checks, before the work, that files of results can be written and replace none that may not be replaced."""
    for path in paths:
        _refuse_existing(path, overwrite)
        check_writable(path)


def _refuse_existing(path: Path, overwrite: bool) -> None:
    if path.is_dir():
        raise InputError(f"{path}: is a folder; give the name of a file to write")
    if os.path.lexists(path) and not overwrite:
        raise InputError(f"{path}: exists; give another out= or overwrite=true")


@contextmanager
def output_file(path: Path, *, overwrite: bool, record: Record) -> Iterator[None]:
    """Lets one run at a time write a file, and writes its record as FILE.summary.json, with the file's checksum: two
    runs of one out= would otherwise leave the file of one with the record of the other."""
    with ExitStack() as stack:
        # Where the folder is missing or refuses, whoever writes the file says so.
        with suppress(OSError):
            stack.enter_context(locked(path.resolve().parent, wait=True))
        _refuse_existing(path, overwrite)
        yield
        write_json(f"{path}.{SUMMARY_NAME}", record() | {"files": {path.name: sha256_of(path)}})


AT_FDCWD, RENAME_EXCHANGE = -100, 2


@contextmanager
def output_folder(path: str | Path, *, overwrite: bool = False, record: Record | None = None) -> Iterator[Path]:
    """Opens a folder to write into, which is renamed to `path` when the block ends without an error.

    Until then it is the hidden folder `.NAME.partial-XXXXXXXX` next to it. It is removed if the block ends early, also
    by an interrupt; the folder of a killed run is removed by the next run that writes to the same path. Everything is
    synced to disk before the folder is renamed.

    Args:
        path: the folder; its parents are created. It may exist if it is empty.
        overwrite: replace the output of an earlier run, recognized by its summary.json. Where the system can (Linux),
            old and new are exchanged in one step.
        record: what it returns at the end is written into the folder, as summary.json, with the checksums of files that
            have none.
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
        if record is not None:
            written = record() | {"files": checksums_of(partial)}
            write_bytes(partial / SUMMARY_NAME, json_bytes(written)[0])
        _sync(partial)
        _check_target(path, target, overwrite)
        _replace_target(partial, target)
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


def _hidden(target: Path, suffix: str) -> Path:
    return target.parent / f".{short_name(target.name)}.{suffix}"


def _begin(path: str | Path, target: Path, overwrite: bool) -> tuple[Path, int | None]:
    """Creates and locks the hidden folder."""
    backup, partial = _hidden(target, "earlier"), _hidden(target, f"partial-{secrets.token_hex(4)}")
    # One run after the other: a folder that is created and not yet locked would be mistaken for that of a killed run.
    parent_lock = lock_folder(target.parent, wait=True)
    try:
        if _remove_stale(target):
            raise BlockingIOError
        if backup.is_dir() and not os.path.lexists(target):
            # A run that was replacing these results was killed between two names.
            os.rename(backup, target)
        shutil.rmtree(backup, ignore_errors=True)
        # Another run may have written the folder since it was looked at.
        _check_target(path, target, overwrite)
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
    """Checks that a folder or file that is about to be replaced is none of the inputs and holds none: every text of the
    settings `values` that names an existing file or folder is an input."""
    if out is None or not os.path.exists(out):
        return
    for key, name in _texts({key: value for key, value in values.items() if key != "out"}):
        if os.path.exists(name) and is_within(name, out):
            holds = "holds" if os.path.isdir(out) else "is"
            raise InputError(f"{out}: {holds} the input {key}={name}, so it cannot be replaced; give another out=")


def is_within(path: str | Path, folder: str | Path) -> bool:
    """Whether a path is in a folder or is the folder, with symbolic links resolved."""
    inner, outer = os.path.realpath(path), os.path.realpath(folder)
    return os.path.commonpath([inner, outer]) == outer


def _texts(value: Any, key: str = "") -> Iterator[tuple[str, str]]:
    """All strings in nested settings that could be paths, with their keys."""
    if isinstance(value, str) and 0 < len(value) < 4096 and "\0" not in value:
        yield key, value
    elif isinstance(value, Mapping):
        for name, item in value.items():
            yield from _texts(item, f"{key}.{name}" if key else str(name))
    elif isinstance(value, (list, tuple)):
        for item in value:
            yield from _texts(item, key)


def _remove_stale(target: Path) -> bool:
    """Removes the hidden folders of killed runs, where folders can be locked; returns whether a run is writing now."""
    pattern = re.compile(re.escape(_hidden(target, "partial-").name) + "[0-9a-f]{8}")
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


def _replace_target(partial: Path, target: Path) -> None:
    """Renames `partial` to `target`; an existing `target` is renamed to `partial`."""
    old = target.is_dir() and any(target.iterdir())
    if old and not _exchange(partial, target):
        # The earlier results have another name for a moment.
        backup = _hidden(target, "earlier")
        os.rename(target, backup)
        os.rename(partial, target)
        os.rename(backup, partial)
    elif not old:
        os.rename(partial, target)
    _sync_one(target.parent)


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
    for name in names:
        if name.startswith(str(partial)):
            return f"{name.replace(str(partial), str(path))}: cannot write: {reason or error}"
    if str(target) in names:
        return f"{path}: cannot be replaced by the results: {reason or error}"
    if str(target.parent) in names:
        return f"{path}: the results are written; the system cannot sync {target.parent}: {reason or error}"
    return None


MARKER_FILE, DISCARDED_FILE = UNFINISHED_FILE, "discarded.txt"
"""The marker of a state that can be continued, and its name while the state is removed."""
_PARTIAL_MARKER = re.compile(re.escape(f".{MARKER_FILE}.") + "([0-9a-f]+[.])?tmp")


def sibling_folder(out: Path, suffix: str) -> Path:
    """The folder OUT.suffix next to an output folder; of a symbolic link, next to the folder that it leads to."""
    target = Path(os.path.realpath(out))
    return target.with_name(f"{target.name}.{suffix}")


def prepared_folder(prepared: Path | None, out: Path) -> Path:
    """Where a training finds what it has prepared, or prepares it: `prepared`, or OUT.prepared where that is None. It
    cannot be in the output folder or in that of the state, which are replaced and removed."""
    prepared = prepared or sibling_folder(out, "prepared")
    for name, folder in (
        ("out", Path(os.path.realpath(out))),
        ("the state of the run", sibling_folder(out, "training")),
    ):
        if is_within(prepared, folder):
            raise InputError(f"prepared={prepared}: is in the folder of {name}, {folder}; give another folder")
    return prepared


class WorkFolder:
    """A folder with a marker file, by which later runs recognize it.

    Enter it before the output folder and `take` it inside: it is then locked until the results have been renamed into
    place, and removed after that. If the block ends early, the folder stays as it is, and a note of the error says so;
    one that holds no state yet is removed.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(os.path.realpath(path))
        self._descriptor: int | None = None
        self._taken = False

    def take(self, *, resume: bool) -> None:
        """Creates and locks the folder, or that of an interrupted run, whose state is removed without `resume`."""
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            names = [entry.name for entry in self.path.iterdir()]
            # A run that was killed at its start may have left an incomplete marker file alone.
            if not {MARKER_FILE, DISCARDED_FILE} & {*names} and not all(map(_PARTIAL_MARKER.fullmatch, names)):
                raise InputError(
                    f"{self.path}: this run would save its state here, and the folder holds something else "
                    f"(no {MARKER_FILE}); give another out="
                )
            try:
                self._descriptor = lock_folder(self.path)
            except BlockingIOError:
                raise BusyError(
                    f"{self.path}: another run saves its state here now; wait for it or give another out="
                ) from None
            stale = not resume or DISCARDED_FILE in names
            if stale:
                self._discard()
            with atomic_file(self.path / MARKER_FILE) as stream:
                stream.write(b"The state of a run that is not finished, which removes this folder.\n")
            if stale:
                (self.path / DISCARDED_FILE).unlink(missing_ok=True)
        except OSError as error:
            self._release()
            raise InputError(
                f"{self.path}: cannot save the state of this run here: {error.strerror or error}; give another out="
            ) from error
        except BaseException:
            self._release()
            raise
        self._taken = True

    def _discard(self) -> None:
        """Removes everything but a marker of another name, by which the next run removes what a kill leaves of it."""
        with suppress(FileNotFoundError):
            os.replace(self.path / MARKER_FILE, self.path / DISCARDED_FILE)
        for entry in self.path.iterdir():
            if entry.name != DISCARDED_FILE:
                if entry.is_dir() and not entry.is_symlink():
                    shutil.rmtree(entry)
                else:
                    entry.unlink()

    def _release(self) -> None:
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None

    def _has_state(self) -> bool:
        """Whether something was computed; not where the folder cannot be read any more."""
        with suppress(OSError):
            return any(entry.name != MARKER_FILE for entry in self.path.iterdir())
        return False

    def __enter__(self) -> "WorkFolder":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None and self._taken:
                self._discard()
                (self.path / DISCARDED_FILE).unlink(missing_ok=True)
                self.path.rmdir()
            elif self._taken and not self._has_state():
                with suppress(OSError):
                    (self.path / MARKER_FILE).unlink()
                    self.path.rmdir()
            elif error is not None and self._taken and str(self.path) not in str(error):
                # An error that is about the folder says itself what to do with it.
                error.add_note(
                    f"{self.path} holds what was computed; a run with the same out= and settings continues it"
                )
        except OSError as failure:
            raise InputError(
                f"{self.path}: the run is finished and its results are written, but the state that it saved here "
                f"cannot be removed: {failure.strerror or failure}; remove it"
            ) from failure
        finally:
            self._release()
