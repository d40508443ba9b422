"""Prepared scenes, read from their files as samples need them.

The file is memory-mapped: a sample reads only its Gaussians and views, and data workers on one machine share the page
cache. Data is verified against checksums when it is first read.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float16, Float32, Float64, Int8

from gsencoder.core.archive import MappedArrays, open_archive
from gsencoder.core.errors import InputError, about, advised
from gsencoder.data.scene_arrays import read_cameras
from gsencoder.fusion.errors import BINS, ProjectionSums
from gsencoder.train.prepared_file import SCALES, Precision, ViewRows, array_types, check_arrays, stored_precision
from gsencoder.types import Cameras, Gaussians

BLOCK_ROWS = 512
"""Rows of eight bits that are converted at a time."""


class PreparedScene:
    """A prepared scene, opened on first access, so that it can be sent to data workers."""

    def __init__(self, path: Path) -> None:
        self.path, self.name = path, path.stem
        self._closed: MappedArrays | None = None

    def __reduce__(self) -> tuple[type["PreparedScene"], tuple[Path]]:
        return PreparedScene, (self.path,)

    @cached_property
    def _arrays(self) -> MappedArrays:
        with self._error_context():
            arrays = MappedArrays(self.path, array_types(self.precision), self._closed)
            check_arrays(arrays, len(self._header[0]))
        return arrays

    @cached_property
    def _header(self) -> tuple[Cameras, float | None, list[float] | None, tuple[str, ...]]:
        with self._error_context(), open_archive(self.path) as file:
            names = tuple(str(name) for name in file.value("views", list))
            cameras, unit, up = (
                read_cameras(file),
                file.value("metres_per_unit", float, int, None),
                file.value("up", list, None),
            )
            if len(names) != len(cameras):
                raise InputError(f"expected as many names of views as cameras, got {len(names)} and {len(cameras)}")
            if unit is not None and not 0 < unit < math.inf:
                raise InputError(f"metres_per_unit: expected a positive number, got {unit}")
            if up is not None and (len(up) != 3 or not all(isinstance(value, (int, float)) for value in up)):
                raise InputError(f"up: expected three numbers, got {str(up)[:60]}")
        return cameras, unit, up, names

    @cached_property
    def _scales(self) -> dict[str, Float32[np.ndarray, " channels"]]:
        """The scales of the columns of quantized arrays; none of float16."""
        with self._error_context(), open_archive(self.path) as file:
            if stored_precision(file) == "float16":
                return {}
            scales = {name: file.array(stored, "float32", ("channels",)) for name, stored in SCALES.items()}
            if not all((of_columns > 0).all() for of_columns in scales.values()):
                raise InputError("expected positive scales of the columns of its targets")
            return scales

    @contextmanager
    def _error_context(self) -> Iterator[None]:
        """Adds the path and the remedy to errors of reading."""
        with about(self.path), advised("remove the file to prepare the scene again"):
            yield

    def projections(self) -> ProjectionSums | None:
        """How well the basis represents the teacher's vectors in this scene; None without a basis, or if the scene was
        prepared before this was computed."""
        with self._error_context(), open_archive(self.path) as file:
            if "sums_of_projections" not in file:
                return None
            histogram = file.array("cosines_of_projections", "float64", (BINS,))
            return ProjectionSums(histogram, file.array("sums_of_projections", "float64", (3,)))

    def close(self) -> None:
        """Closes the file; the next access opens it again."""
        arrays: MappedArrays | None = self.__dict__.pop("_arrays", None)
        if arrays is not None:
            arrays.close()
            self._closed = arrays

    def __len__(self) -> int:
        return self._arrays.shape("means")[0]

    @property
    def cameras(self) -> Cameras:
        return self._header[0]

    @property
    def metres_per_unit(self) -> float | None:
        return self._header[1]

    @property
    def up(self) -> Float64[np.ndarray, "3"] | None:
        return None if self._header[2] is None else np.array(self._header[2], np.float64)

    @property
    def view_names(self) -> tuple[str, ...]:
        return self._header[3]

    @property
    def precision(self) -> Precision:
        """The type in which targets, and the teacher's vectors in the rows, are stored."""
        return "int8" if self._scales else "float16"

    @property
    def channels(self) -> int:
        """Columns of the targets."""
        return self._arrays.shape("targets")[1]

    @property
    def means(self) -> Float32[np.ndarray, "N 3"]:
        return self._arrays.array("means")

    @property
    def weights(self) -> Float32[np.ndarray, " N"]:
        """The fusion weight of each Gaussian; 0 = not seen in any view, and without a target."""
        return self._arrays.array("weights")

    def gaussians(self, rows: np.ndarray) -> Gaussians:
        """Reads Gaussians by row, with degree-0 colors."""
        with self._error_context():
            columns = {
                name: self._arrays.rows(name, rows) for name in ("means", "quats", "scales", "opacities", "sh_dc")
            }
        sh = columns.pop("sh_dc")[:, None]
        return Gaussians(**columns, sh=sh)

    def targets(self, rows: np.ndarray) -> Float32[np.ndarray, "n channels"]:
        """Reads targets of the encoder by row, standard units; zero for Gaussians without a target."""
        with self._error_context():
            return self._scaled("targets", self._arrays.rows("targets", rows)).astype(np.float32, copy=False)

    def float16_targets(self, rows: np.ndarray) -> Float16[np.ndarray, "n channels"]:
        """The same in float16, as samples hold them."""
        with self._error_context():
            stored = self._arrays.rows("targets", rows)
        return _as_float16(stored, self._scales["targets"]) if self._scales else stored

    def _scaled(self, name: str, stored: np.ndarray) -> Float[np.ndarray, "n channels"]:
        """Rows of an array in standard units: float16 as they are stored, or float32 of integers."""
        return np.multiply(stored, self._scales[name], dtype=np.float32) if name in self._scales else stored

    def view(self, view: int) -> ViewRows:
        """Reads the blending matrix and the teacher's vectors of one view."""
        first, last = (int(row) for row in self._arrays.array("rows")[view : view + 2])
        crow = np.array(self._arrays.array("crow")[first : last + 1])
        start, end = int(crow[0]), int(crow[-1])
        with self._error_context():
            targets = self._scaled("row_targets", self._arrays.row_range("row_targets", first, last))
            view_rows = ViewRows(
                crow=crow - start,
                col=np.array(self._arrays.row_range("col", start, end)),
                weight=self._arrays.row_range("weight", start, end).astype(np.float32),
                targets=targets.astype(np.float32, copy=False),
                valid=self._arrays.row_range("row_valid", first, last).astype(bool),
            )
            in_range = (view_rows.col >= 0) & (view_rows.col < len(self))
            if not in_range.all() or not (view_rows.weight >= 0).all() or not np.isfinite(view_rows.targets).all():
                raise InputError(f"view {self.view_names[view]!r}: its columns, weights or targets are out of range")
        return view_rows


def _as_float16(
    integers: Int8[np.ndarray, "n channels"], scales: Float32[np.ndarray, " channels"]
) -> Float16[np.ndarray, "n channels"]:
    """Integers times the scales of their columns. In torch, which converts to float16 several times faster than numpy,
    and in blocks that stay in the cache."""
    result, values, factors = np.empty(integers.shape, np.float16), torch.from_numpy(integers), torch.from_numpy(scales)
    rows = torch.from_numpy(result)
    for start in range(0, len(integers), BLOCK_ROWS):
        rows[start : start + BLOCK_ROWS] = values[start : start + BLOCK_ROWS].float().mul_(factors)
    return result
