"""The folder in which a run that may be cut off keeps its state; it goes when the results have their place."""

import os
import re
import shutil
from pathlib import Path
from types import TracebackType

from gsencoder.core.errors import InputError
from gsencoder.core.files.atomic import atomic_file, lock_folder

WORK_MARK = "unfinished.txt"
_HALF_A_MARK = re.compile(re.escape(f".{WORK_MARK}.") + "[0-9a-f]+[.]tmp")


class WorkFolder:
    """A folder with a mark in it, by which later runs know it for one of theirs.

    Enter it before the output folder and `take` it inside: then it is held, and kept from other runs, until the results
    have taken their place, and is removed after that. Whatever ends the block early leaves it as it is.

    Attributes:
        path: of the folder, behind all links.
    """

    def __init__(self, path: Path) -> None:
        """Args:
        path: the folder, which need not exist.
        """
        self.path = Path(os.path.realpath(path))
        self._descriptor: int | None = None
        self._taken = False

    def take(self, *, anew: bool) -> None:
        """Makes the folder, or takes up the one that a run has left; one that no run has made is never touched.

        Args:
            anew: forget what an earlier run left in it.

        Raises:
            InputError: it holds something else, another run is at work in it, or it cannot be made or emptied.
        """
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            names = [entry.name for entry in self.path.iterdir()]
            # A run that was killed within its first moments has left no more than the beginning of a mark.
            if WORK_MARK not in names and not all(_HALF_A_MARK.fullmatch(name) for name in names):
                raise InputError(
                    f"{self.path}: this run would keep its state here, and the folder holds something else "
                    f"(no {WORK_MARK}); give another out="
                )
            try:
                self._descriptor = lock_folder(self.path)
            except BlockingIOError:
                raise InputError(
                    f"{self.path}: another run keeps its state here now; wait for it or give another out="
                ) from None
            if anew:
                self._empty()
            with atomic_file(self.path / WORK_MARK) as stream:
                stream.write(b"The state of a run that is not finished, which removes this folder.\n")
        except OSError as error:
            self._release()
            raise InputError(
                f"{self.path}: cannot keep the state of this run here: {error.strerror or error}; give another out="
            ) from error
        except BaseException:
            self._release()
            raise
        self._taken = True

    def _empty(self) -> None:
        """Removes everything but the mark, which goes last, so that a kill leaves a folder that is known."""
        for entry in self.path.iterdir():
            if entry.name != WORK_MARK:
                if entry.is_dir() and not entry.is_symlink():
                    shutil.rmtree(entry)
                else:
                    entry.unlink()

    def _release(self) -> None:
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None

    def __enter__(self) -> "WorkFolder":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None and self._taken:
                self._empty()
                (self.path / WORK_MARK).unlink(missing_ok=True)
                self.path.rmdir()
        except OSError as refused:
            raise InputError(
                f"{self.path}: the run is finished and its results are in place, but what it kept here cannot be "
                f"removed: {refused.strerror or refused}; remove it"
            ) from refused
        finally:
            self._release()
