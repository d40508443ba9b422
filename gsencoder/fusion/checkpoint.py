"""Teachers that are wrapped: upright pictures, and maps cached in files, from which an unfinished fusion continues.

Fusing asks for a dense map twice (for the basis and for the sums), preparing a scene three times, a sweep of settings
as often as it has settings; making a map takes far longer than reading it. What is given is always what the file
holds, so all of them see the same values.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from gsencoder.core.archive import open_archive, write_archive
from gsencoder.core.errors import InputError, error_hint
from gsencoder.core.files import atomic_file, read_foreign_text
from gsencoder.core.settings import first_difference
from gsencoder.types import FeatureBasis, FeatureMap, FeatureSpace, Gaussians, Teacher, Views
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

    def __init__(self, teacher: Teacher, folder: Path, settings: Mapping[str, Any] | None = None) -> None:
        """Opens the cache of one scene and one teacher.

        Args:
            settings: all that the maps depend on, as JSON values: with the first map they are written to the folder,
                and those of an earlier run must be the same. None = what the maps are of is not checked.
        """
        super().__init__(teacher)
        self._folder, self._settings, self._advice = folder, settings, ""
        if settings is not None:
            self._advice = f"delete {folder} to start again"
            with error_hint(self._advice):
                # As JSON gives them back.
                self._check_settings(json.loads(json.dumps(settings)))

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        if self.cheap:
            return self.teacher.feature_map(views, view)
        path = self._folder / f"map_{view:05d}.safetensors"
        if not path.is_file():
            feature_map = self.teacher.feature_map(views, view)
            if feature_map.codes is not None and self.table is not None:
                return feature_map
            # Not earlier: a run that ends before, because its settings are wrong, leaves no folder that refuses the
            # next one.
            if self._settings is not None and not (self._folder / SETTINGS_FILE).is_file():
                try:
                    self._folder.mkdir(parents=True, exist_ok=True)
                except OSError as error:
                    raise InputError(f"{self._folder}: cannot be made: {error.strerror or error}") from error
                with atomic_file(self._folder / SETTINGS_FILE) as stream:
                    stream.write(json.dumps(self._settings).encode())
            write_map(path, feature_map, with_table=feature_map.table is not None and self.table is None)
        with error_hint(self._advice or f"remove {path}, and it is made again"):
            return read_map(path, self.space, self.table)

    def _check_settings(self, settings: Mapping[str, Any]) -> None:
        """Maps without settings are what a run left that was killed while it removed its cache. Nobody knows what they
        were made from, and they are removed."""
        path = self._folder / SETTINGS_FILE
        try:
            if path.is_file():
                earlier = dict(json.loads(read_foreign_text(path)))
                if earlier != settings:
                    raise InputError(f"{self._folder}: holds a fusion begun with {first_difference(earlier, settings)}")
                return
            for each in self._folder.glob("map_*.safetensors"):
                each.unlink(missing_ok=True)
        except InputError:
            raise
        except (OSError, ValueError, TypeError, RecursionError) as error:
            raise InputError(f"{self._folder}: cannot be used: {error}") from error


SETTINGS_FILE = "settings.json"


def cached_maps(
    folder: Path,
    config: Mapping[str, Any],
    teacher: Teacher,
    gaussians: Gaussians,
    views: Views,
    rows: Sequence[int],
    basis: FeatureBasis | None,
) -> CachedTeacher:
    """The teacher with its maps cached in the folder of a fusion, which belongs to one scene, one teacher, one set of
    settings and one basis.

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
    return CachedTeacher(teacher, folder, settings)


def _digest(*arrays: np.ndarray) -> str:
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(f"{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]
