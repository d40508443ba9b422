"""A fusion under way on disk: the teacher's maps and the sums so far, which a later run takes up."""

import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from gsencoder.core.errors import InputError, advised
from gsencoder.core.files.archive import first_difference, open_archive, write_archive
from gsencoder.core.files.atomic import atomic_file
from gsencoder.fusion.teacher_maps import CachedTeacher
from gsencoder.fusion.teachers import Teacher

SETTINGS_FILE, SUMS_FILE = "settings.json", "sums.safetensors"


class PartialFusion:
    """A fusion under way: the teacher's maps and the sums so far, in a folder that a later run takes up."""

    def __init__(self, folder: Path, settings: dict[str, Any], every_seconds: float = 20.0) -> None:
        """Looks for what an earlier run left; the folder is made when there is something to keep.

        Args:
            folder: where maps and sums are kept.
            settings: all that maps and sums depend on, the scene included.
            every_seconds: how often sums are worth saving.

        Raises:
            InputError: the folder holds maps or sums made with other settings (both are named), or cannot be used.
        """
        self.folder, self._every = folder, every_seconds
        self._last = time.monotonic()
        self._settings = json.loads(json.dumps(settings))
        self._made = (folder / SETTINGS_FILE).is_file()
        if self._made:
            found = _read_settings(folder / SETTINGS_FILE)
            if found != self._settings:
                difference = first_difference(found, self._settings)
                raise InputError(f"{folder}: holds a fusion begun with {difference}; delete it to start anew")

    def _make(self) -> None:
        """The folder with its settings. A run that ends before its first map, as its settings are wrong, leaves none
        behind that would refuse the next run."""
        if self._made:
            return
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{self.folder}: cannot be made: {error.strerror or error}") from error
        with atomic_file(self.folder / SETTINGS_FILE) as stream:
            stream.write(json.dumps(self._settings).encode())
        self._made = True

    def due(self) -> bool:
        """Whether the sums are old enough to be worth saving again."""
        return time.monotonic() - self._last >= self._every

    def cached(self, teacher: Teacher) -> CachedTeacher:
        """The teacher, its maps kept here."""
        return CachedTeacher(teacher, self.folder, before_write=self._make, advice=self._advice)

    def save_sums(self, done: int, sums: Float32[np.ndarray, "N columns"], weights: Float32[np.ndarray, " N"]) -> None:
        """Keeps the sums over the first `done` views."""
        self._make()
        write_archive(self.folder / SUMS_FILE, {"sums": sums, "weights": weights}, {"done": done})
        self._last = time.monotonic()

    def load_sums(
        self, gaussians: int, columns: int
    ) -> tuple[int, Float32[np.ndarray, "N columns"], Float32[np.ndarray, " N"]] | None:
        """(views done, sums, weights) of an earlier run, or None.

        Raises:
            InputError: the file is damaged, or of another size.
        """
        if not (self.folder / SUMS_FILE).is_file():
            return None
        with advised(self._advice), open_archive(self.folder / SUMS_FILE) as file:
            sums = file.array("sums", "float32", (gaussians, columns))
            return file.value("done", int), sums, file.array("weights", "float32", (gaussians,))

    @property
    def _advice(self) -> str:
        return f"delete {self.folder} to start anew"


def _read_settings(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: cannot be read ({error}); delete {path.parent} to start anew") from error
    if not isinstance(found, dict):
        raise InputError(f"{path}: expected an object; delete {path.parent} to start anew")
    return found
