"""A cache of teacher maps in a folder: each map is computed once, and is the same for every later use.

Fusing asks for a dense map twice (for the basis and for the sums), preparing a scene three times, a sweep of settings
as often as it has settings; making a map takes far longer than reading it. What is given is always what the file
holds, so all of them see the same values.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from gsencoder.core.archive import open_archive, write_archive
from gsencoder.core.errors import advised
from gsencoder.teachers.base import Teacher
from gsencoder.types import FeatureMap, FeatureSpace, Views
from gsencoder.types.orientation import stored_map, upright_views

SMALLEST_SCALE = 1e-30


def write_map(path: Path, feature_map: FeatureMap, *, with_table: bool = False) -> None:
    """Writes a dense or mixed map as float16, each channel divided by its largest magnitude: float16 holds values up to
    65,504 with three digits, and backbones have channels that are a hundred times larger than others. Cells that are
    not finite are no part of the map, and are marked as such. Codes are written as they are.

    Args:
        path: the file.
        feature_map: to write.
        with_table: write the table of a coded or mixed map, too, because it is that of no other map.

    Raises:
        InputError: the disk is full, or the system refuses.
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
    """The map of a file; cells of a dense map that had none are NaN.

    Args:
        path: the file.
        space: of the map.
        table: of a mixed map whose file does not hold it.

    Raises:
        InputError: the file is damaged, or of another space.
    """
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
    """A teacher that gives another one's maps in its own way; all else is as the other has it.

    Attributes:
        teacher: the other one.
        space, table, mean, needs_images, cheap: as that has them.
    """

    def __init__(self, teacher: Teacher) -> None:
        self.teacher = teacher
        self.needs_images, self.cheap = teacher.needs_images, teacher.cheap

    @property
    def space(self) -> FeatureSpace:
        return self.teacher.space

    @property
    def table(self) -> Float32[np.ndarray, "C D"] | None:
        return self.teacher.table

    @property
    def mean(self) -> Float32[np.ndarray, " D"] | None:
        return self.teacher.mean

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        return self.teacher.feature_map(views, view)

    def settings(self) -> dict[str, Any]:
        return self.teacher.settings()


class UprightTeacher(WrappedTeacher):
    """A teacher that sees upright pictures, whose maps are turned back to the stored pixels."""

    def __init__(self, teacher: Teacher) -> None:
        super().__init__(teacher)
        self._last: tuple[Views, Views] | None = None

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        """The map of a view, on its stored pixels."""
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
        """Args:
        teacher: whose maps.
        folder: must hold the maps of one scene by this teacher alone, which is not checked.
        before_write: called before a file is written.
        advice: what to do about a damaged file, for the error.
        """
        super().__init__(teacher)
        self._folder, self._before_write, self._advice = folder, before_write, advice

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        """The map of a view, from its file where there is one.

        Raises:
            InputError: whatever the teacher refuses, a damaged file, or a full disk.
        """
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
