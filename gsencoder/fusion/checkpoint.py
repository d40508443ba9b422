"""Teachers that are wrapped: upright pictures, maps cached in files; and the checkpoint of an unfinished fusion.

Fusing asks for a dense map twice (for the basis and for the sums), preparing a scene three times, a sweep of settings
as often as it has settings; making a map takes far longer than reading it. What is given is always what the file
holds, so all of them see the same values.
"""

import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32

from gsencoder.core.archive import open_archive, write_archive
from gsencoder.core.errors import InputError, advised
from gsencoder.core.files import atomic_file, read_foreign_text
from gsencoder.core.settings import first_difference
from gsencoder.teachers.base import Teacher
from gsencoder.types import FeatureBasis, FeatureMap, FeatureSpace, Gaussians, Views
from gsencoder.types.orientation import stored_map, upright_views

SMALLEST_SCALE = 1e-30


def write_map(path: Path, feature_map: FeatureMap, *, with_table: bool = False) -> None:
    """Writes a dense or mixed map as float16, each channel divided by its largest magnitude: float16 holds values up to
    65,504 with three digits, and backbones have channels that are a hundred times larger than others. Cells that are
    not finite are no part of the map, and are marked as such. Codes are written as they are; the table of a coded or
    mixed map where no other map has it.
    """
    arrays = {"grid": feature_map.grid_from_image}
    if with_table:
        assert feature_map.table is not None
        arrays["table"] = feature_map.table
    if feature_map.codes is not None:
        write_archive(path, {**arrays, "codes": feature_map.codes}, {})
        return
    mixed = feature_map.shares is not None
    values = feature_map.shares if mixed else feature_map.features
    assert values is not None
    valid = np.isfinite(values).all(axis=-1)
    values = np.where(valid[..., None], values, np.float32(0))
    scale = np.maximum(np.abs(values).max(axis=(0, 1), initial=0), np.float32(SMALLEST_SCALE))
    arrays["shares" if mixed else "features"] = (values / scale).astype(np.float16)
    write_archive(path, {**arrays, "channel_scale": scale, "valid": valid.astype(np.uint8)}, {})


def read_map(path: Path, space: FeatureSpace, table: Float32[np.ndarray, "C D"] | None = None) -> FeatureMap:
    """The map of a file; cells of a dense map that had none are NaN. `table` is that of a mixed map whose file does not
    hold it."""
    with open_archive(path) as file:
        grid = file.array("grid", "float64", (2, 3))
        if "table" in file:
            table = file.array("table", "float32", ("C", space.channels))
        if "codes" in file:
            codes = file.array("codes", "int32", ("h", "w"))
            return FeatureMap(codes=codes, table=table, grid_from_image=grid, space=space)
        name, columns = ("features", space.channels) if table is None else ("shares", len(table))
        values = file.array(name, "float16", ("h", "w", columns)).astype(np.float32)
        values *= file.array("channel_scale", "float32", (columns,))
        if table is not None:
            return FeatureMap(shares=values, table=table, grid_from_image=grid, space=space)
        features = values
        features[file.array("valid", "uint8", ("h", "w")) == 0] = np.nan
    return FeatureMap(features=features, grid_from_image=grid, space=space)


class WrappedTeacher:
    """A teacher that gives another one's maps in its own way; all else is as the other has it."""

    def __init__(self, teacher: Teacher) -> None:
        self.teacher = teacher
        self.space, self.table, self.mean = teacher.space, teacher.table, teacher.mean
        self.needs_images, self.cheap, self.settings = teacher.needs_images, teacher.cheap, teacher.settings

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        return self.teacher.feature_map(views, view)


class UprightTeacher(WrappedTeacher):
    """A teacher that sees upright pictures, whose maps are turned back to the stored pixels."""

    def __init__(self, teacher: Teacher) -> None:
        super().__init__(teacher)
        self._last: tuple[Views, Views] | None = None

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        if views.orientations is None:
            return self.teacher.feature_map(views, view)
        last = self._last
        if last is None or last[0] is not views:
            self._last = last = (views, upright_views(views, unmirror=True))
        size = int(views.cameras.widths[view]), int(views.cameras.heights[view])
        return stored_map(self.teacher.feature_map(last[1], view), views.orientations[view], *size)


def upright(teacher: Teacher) -> Teacher:
    """The teacher, made to see upright pictures once."""
    inner = teacher
    while isinstance(inner, WrappedTeacher):
        if isinstance(inner, UprightTeacher):
            return teacher
        inner = inner.teacher
    return UprightTeacher(teacher)


class CachedTeacher(WrappedTeacher):
    """A teacher with its maps cached as files; those of cheap teachers, and codes into a table that all its maps share,
    are made each time."""

    def __init__(
        self, teacher: Teacher, folder: Path, *, before_write: Callable[[], None] = lambda: None, advice: str = ""
    ) -> None:
        """`folder` must hold the maps of one scene by this teacher alone, which is not checked; `advice` is for the
        error about a damaged file."""
        super().__init__(teacher)
        self._folder, self._before_write, self._advice = folder, before_write, advice

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        if self.cheap:
            return self.teacher.feature_map(views, view)
        path = self._folder / f"map_{view:05d}.safetensors"
        if not path.is_file():
            feature_map = self.teacher.feature_map(views, view)
            if feature_map.codes is not None and self.table is not None:
                return feature_map
            self._before_write()
            write_map(path, feature_map, with_table=feature_map.table is not None and self.table is None)
        with advised(self._advice or f"remove {path}, and it is made again"):
            return read_map(path, self.space, self.table)


SETTINGS_FILE, SUMS_FILE = "settings.json", "sums.safetensors"
SAVE_EVERY = 20.0
"""Seconds between two checkpoints of the sums."""


@runtime_checkable
class Sums(Protocol):
    """`gsencoder.fusion.lift.FeatureSums`, which needs torch."""

    views: int

    def state(self) -> dict[str, np.ndarray]: ...

    def restore(self, views: int, state: Mapping[str, np.ndarray]) -> None: ...


class FusionCheckpoint:
    """The folder of a fusion that is not finished: the teacher's maps, and the sums over the views so far."""

    def __init__(self, folder: Path, settings: dict[str, Any]) -> None:
        """Opens the checkpoint of an earlier run. The folder is made when the first map or sum is written: a run that
        ends earlier, because its settings are wrong, must not leave a folder that refuses the next run.

        Maps and sums without settings are what a run left that was killed while it removed its checkpoint. Nobody knows
        what they were made from, and they are removed. `settings` are all that maps and sums depend on, the scene
        included, as JSON values.
        """
        self.folder, self._saved_at, self._advice = folder, time.monotonic(), f"delete {folder} to start again"
        self._settings = json.loads(json.dumps(settings))
        self._exists = (folder / SETTINGS_FILE).is_file()
        if self._exists:
            with advised(self._advice):
                earlier = _read_settings(folder / SETTINGS_FILE)
                if earlier != self._settings:
                    raise InputError(f"{folder}: holds a fusion begun with {first_difference(earlier, self._settings)}")
            return
        try:
            for path in (folder / SUMS_FILE, *folder.glob("map_*.safetensors")):
                path.unlink(missing_ok=True)
        except OSError as error:
            raise InputError(f"{folder}: cannot be used: {error.strerror or error}; delete it") from error

    def cached(self, teacher: Teacher) -> CachedTeacher:
        """The teacher with its maps cached in this folder."""
        return CachedTeacher(teacher, self.folder, before_write=self._make_folder, advice=self._advice)

    def resume(self, sums: Sums) -> int:
        """Restores the sums of an interrupted run, if there are any; the number of views that they are over."""
        if (self.folder / SUMS_FILE).is_file():
            with advised(self._advice), open_archive(self.folder / SUMS_FILE) as file:
                state = {name: file.array(name, each.dtype.name, each.shape) for name, each in sums.state().items()}
                sums.restore(file.value("done", int), state)
        return sums.views

    def save_if_due(self, sums: Sums) -> None:
        """Saves the sums from time to time; to be called after each view."""
        if time.monotonic() - self._saved_at >= SAVE_EVERY:
            self._make_folder()
            write_archive(self.folder / SUMS_FILE, sums.state(), {"done": sums.views})
            self._saved_at = time.monotonic()

    def _make_folder(self) -> None:
        """Makes the folder and writes its settings."""
        if self._exists:
            return
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{self.folder}: cannot be made: {error.strerror or error}") from error
        with atomic_file(self.folder / SETTINGS_FILE) as stream:
            stream.write(json.dumps(self._settings).encode())
        self._exists = True


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
        config: settings of the fusion, as JSON values.
        views: of the scene; photographs count by their names alone.
        rows: the views that are lifted, in this order.
        basis: one that was given to the fusion; one that it fits itself depends on nothing else.
    """
    settings: dict[str, Any] = {"fuse": dict(config), "teacher": teacher.settings(), "views": list(rows)}
    if basis is not None:
        settings["basis"] = _digest(basis.mean, basis.components)
    splat = (getattr(gaussians, name) for name in ("means", "quats", "scales", "opacities", "sh"))
    cameras = (getattr(views.cameras, name) for name in ("cam_from_world", "Ks", "widths", "heights"))
    names = np.frombuffer(repr(views.names).encode("utf-8", "backslashreplace"), np.uint8)
    settings["scene"] = {"gaussians": _digest(*splat), "views": _digest(names, *cameras)}
    settings["scene"]["depth"] = views.depths is not None
    return FusionCheckpoint(folder, settings)


def _digest(*arrays: np.ndarray) -> str:
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(f"{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]


def _read_settings(path: Path) -> dict[str, Any]:
    try:
        settings = json.loads(read_foreign_text(path))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: cannot be read ({error})") from error
    if not isinstance(settings, dict):
        raise InputError(f"{path}: expected an object")
    return settings
