"""The folder for the state of a run that can be resumed; it is removed once the results are written."""

import os
import re
import shutil
from contextlib import suppress
from pathlib import Path
from types import TracebackType

from gsencoder.app.runs.output_folder import lies_in
from gsencoder.core.errors import BusyError, InputError
from gsencoder.core.files import atomic_file, lock_folder
from gsencoder.data.scenes import UNFINISHED_FILE

MARKER_FILE, DISCARDED_FILE = UNFINISHED_FILE, "discarded.txt"
"""The marker of a state that can be continued, and its name while the state is removed."""
_PARTIAL_MARKER = re.compile(re.escape(f".{MARKER_FILE}.") + "([0-9a-f]+[.])?tmp")


def folder_beside(out: Path, suffix: str) -> Path:
    """The folder OUT.suffix beside an output folder; behind a symbolic link, beside the folder that it leads to."""
    target = Path(os.path.realpath(out))
    return target.with_name(f"{target.name}.{suffix}")


def prepared_folder(prepared: Path | None, out: Path, work: Path) -> Path:
    """Where a training finds what it has prepared, or prepares it: `prepared`, or OUT.prepared where that is None.

    Raises:
        InputError: it is in the output folder or in that of the state, which are replaced and removed.
    """
    prepared = prepared or folder_beside(out, "prepared")
    for name, folder in (("out", Path(os.path.realpath(out))), ("the state of the run", work)):
        if lies_in(prepared, folder):
            raise InputError(f"prepared={prepared}: is in the folder of {name}, {folder}; give another folder")
    return prepared


class WorkFolder:
    """A folder with a marker file, by which later runs recognize it.

    Enter it before the output folder and `take` it inside: it is then locked until the results have been renamed into
    place, and removed after that. If the block ends early, the folder stays as it is, and a note of the error says so;
    one that holds no state yet is removed.

    Attributes:
        path: of the folder, with symbolic links resolved.
    """

    def __init__(self, path: Path) -> None:
        """Args:
        path: the folder, which may not exist yet.
        """
        self.path = Path(os.path.realpath(path))
        self._descriptor: int | None = None
        self._taken = False

    def take(self, *, anew: bool) -> None:
        """Creates and locks the folder, or that of an interrupted run; a folder without the marker is never changed.

        Args:
            anew: whether to remove the state of an earlier run.

        Raises:
            InputError: it holds something else, another run uses it, or it cannot be created or emptied.
        """
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            names = [entry.name for entry in self.path.iterdir()]
            # A run that was killed at its start may have left an incomplete marker file alone.
            if not {MARKER_FILE, DISCARDED_FILE} & {*names} and not all(
                _PARTIAL_MARKER.fullmatch(name) for name in names
            ):
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
            stale = anew or DISCARDED_FILE in names
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
        """Removes everything but a marker of another name: the next run removes what a kill leaves of the state, and
        does not continue from a part of it."""
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
                "cannot be "
                f"removed: {failure.strerror or failure}; remove it"
            ) from failure
        finally:
            self._release()
