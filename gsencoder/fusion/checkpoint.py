"""The checkpoint of a fusion: the teacher's maps and the sums so far, from which an interrupted run continues."""

import hashlib
import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32

from gsencoder.core.archive import open_archive, write_archive
from gsencoder.core.errors import InputError, advised
from gsencoder.core.files import atomic_file, read_foreign_text
from gsencoder.core.settings import first_difference
from gsencoder.data.splats.files import fingerprint
from gsencoder.fusion.teacher_maps import CachedTeacher
from gsencoder.teachers.base import Teacher
from gsencoder.types import FeatureBasis, Gaussians, Views

SETTINGS_FILE, SUMS_FILE = "settings.json", "sums.safetensors"


@runtime_checkable
class RunningSums(Protocol):
    """What a checkpoint saves of the sums over views (`fusion.lift.FeatureSums`, which needs torch).

    Attributes:
        sums: of the first `views` views.
        weights: the same.
        views: how many views were added.
    """

    sums: Float32[np.ndarray, "N columns"]
    weights: Float32[np.ndarray, " N"]
    views: int


class FusionCheckpoint:
    """The folder of a fusion that is not finished: the teacher's maps, and the sums over the views so far."""

    def __init__(self, folder: Path, settings: dict[str, Any], every_seconds: float = 20.0) -> None:
        """Opens the checkpoint of an earlier run. The folder is made when the first map or sum is written.

        Maps and sums without settings are what a run left that was killed while it removed its checkpoint. Nobody knows
        what they were made from, and they are removed.

        Args:
            folder: of the maps and the sums.
            settings: all that maps and sums depend on, the scene included, as JSON values.
            every_seconds: time between two checkpoints of the sums.

        Raises:
            InputError: the folder holds a checkpoint of other settings (the difference is named), or cannot be used.
        """
        self.folder, self._every_seconds = folder, every_seconds
        self._saved_at = time.monotonic()
        self._settings = json.loads(json.dumps(settings))
        self._exists = (folder / SETTINGS_FILE).is_file()
        if self._exists:
            earlier = _read_settings(folder / SETTINGS_FILE)
            if earlier != self._settings:
                difference = first_difference(earlier, self._settings)
                raise InputError(f"{folder}: holds a fusion begun with {difference}; delete it to start anew")
        else:
            try:
                for path in (folder / SUMS_FILE, *folder.glob("map_*.safetensors")):
                    path.unlink(missing_ok=True)
            except OSError as error:
                raise InputError(f"{folder}: cannot be used: {error.strerror or error}; delete it") from error

    def _make_folder(self) -> None:
        """Makes the folder and writes its settings. Not done before the first map: a run that ends earlier, because its
        settings are wrong, must not leave a folder that refuses the next run."""
        if self._exists:
            return
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{self.folder}: cannot be made: {error.strerror or error}") from error
        with atomic_file(self.folder / SETTINGS_FILE) as stream:
            stream.write(json.dumps(self._settings).encode())
        self._exists = True

    def resume(self, sums: RunningSums) -> None:
        """Puts the sums of an interrupted run into new ones.

        Raises:
            InputError: the checkpoint is damaged, or of other sizes.
        """
        if (earlier := self.load_sums(*sums.sums.shape)) is not None:
            sums.views, sums.sums, sums.weights = earlier

    def save_if_due(self, sums: RunningSums) -> None:
        """Saves the sums from time to time; to be called after each view."""
        if self.due():
            self.save_sums(sums.views, sums.sums, sums.weights)

    def due(self) -> bool:
        """Whether the sums should be saved again."""
        return time.monotonic() - self._saved_at >= self._every_seconds

    def cached(self, teacher: Teacher) -> CachedTeacher:
        """The teacher with its maps cached in this folder."""
        return CachedTeacher(teacher, self.folder, before_write=self._make_folder, advice=self._advice)

    def save_sums(self, done: int, sums: Float32[np.ndarray, "N columns"], weights: Float32[np.ndarray, " N"]) -> None:
        """Writes the sums over the first `done` views."""
        self._make_folder()
        write_archive(self.folder / SUMS_FILE, {"sums": sums, "weights": weights}, {"done": done})
        self._saved_at = time.monotonic()

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


def open_checkpoint(
    folder: Path,
    config: Mapping[str, Any],
    teacher: Teacher,
    gaussians: Gaussians,
    views: Views,
    rows: Sequence[int],
    basis: FeatureBasis | None,
) -> FusionCheckpoint:
    """Opens the checkpoint in a folder, which belongs to one scene, one teacher, one set of settings and one basis.

    Args:
        folder: of the maps and the sums.
        config: settings of the fusion, as JSON values.
        teacher: what is lifted.
        gaussians: what is lifted onto.
        views: of the scene; photographs count by their names alone.
        rows: the views that are lifted, in this order.
        basis: one that was given to the fusion; one that it fits itself depends on nothing else.

    Raises:
        InputError: as `FusionCheckpoint`.
    """
    settings: dict[str, Any] = {"fuse": dict(config), "teacher": teacher.settings(), "views": list(rows)}
    if basis is not None:
        settings["basis"] = hashlib.sha256(basis.mean.tobytes() + basis.components.tobytes()).hexdigest()[:16]
    digest = hashlib.sha256(repr(views.names).encode("utf-8", "backslashreplace"))
    for name in ("cam_from_world", "Ks", "widths", "heights"):
        digest.update(np.ascontiguousarray(getattr(views.cameras, name)).tobytes())
    settings["scene"] = {"gaussians": fingerprint(gaussians)[:16], "views": digest.hexdigest()[:16]}
    return FusionCheckpoint(folder, settings)


def _read_settings(path: Path) -> dict[str, Any]:
    try:
        settings = json.loads(read_foreign_text(path))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: cannot be read ({error}); delete {path.parent} to start anew") from error
    if not isinstance(settings, dict):
        raise InputError(f"{path}: expected an object; delete {path.parent} to start anew")
    return settings
