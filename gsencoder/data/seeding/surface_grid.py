"""Grid subsampling of oriented surface samples that separates different surfaces inside one voxel.

The mean of all samples in a voxel lies between the surfaces where two of them share it: a spoon's rim sinks towards
the table, the edge of a box is rounded off. Samples are therefore summed by voxel, by the axis direction that they
face, and by their layer along the normal; sums of one voxel that turn out to be the same surface are joined again at
the end. Sums add up in any order, so frames stream through in constant memory.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int64, UInt8

from gsencoder.core.errors import InputError

AXIS_BITS = 19
"""Bits of a voxel index along one axis: 524,288 voxels, or 10 km at 2 cm."""
MAX_PARTIAL_ROWS = 2_000_000
"""Partial sums are joined when there are more rows than this (about 180 MB)."""
LAYER = 0.25
"""Height of a layer along the normal, in voxels."""
SAME_SURFACE_COS = 0.95
"""Two sums of a voxel are one surface if their normals are closer than this (18°) …"""
SAME_SURFACE_OFFSET = 0.1
"""… and their planes closer than this, in voxels."""

_LAYERS = 8
_DIRECTIONS = 6
_COLUMNS = 10  # position, normal, color, count


class SurfaceSamples(NamedTuple):
    """Points on surfaces.

    Attributes:
        points: world positions.
        normals: unit, away from the surface.
        colors: RGB in [0, 1].
        counts: how many samples each stands for.
    """

    points: Float32[np.ndarray, "n 3"]
    normals: Float32[np.ndarray, "n 3"]
    colors: Float32[np.ndarray, "n 3"]
    counts: Int64[np.ndarray, " n"]


class SurfaceGrid:
    """Sums of surface samples in the cells of a world-aligned grid; the cells' corners are multiples of `voxel`.

    Args:
        voxel: edge of a cell, world units.
        around: a point near the middle of the data; the grid reaches 262,144 cells to each side of it.
    """

    def __init__(self, voxel: float, around: np.ndarray) -> None:
        self.voxel = voxel
        self._base = np.floor(np.asarray(around, np.float64) / voxel).astype(np.int64) - (1 << (AXIS_BITS - 1))
        self._keys: list[np.ndarray] = []
        self._sums: list[np.ndarray] = []
        self._rows = 0

    def add(
        self, points: Float32[np.ndarray, "n 3"], normals: Float32[np.ndarray, "n 3"], colors: UInt8[np.ndarray, "n 3"]
    ) -> None:
        """Adds samples. Raises InputError where one lies outside the grid's reach."""
        if not len(points):
            return
        # Numbers that no integer holds are out of reach too, and must not be cast.
        countable = float(np.abs(points).max()) < 2.0**62 * self.voxel
        cells = np.floor(points / np.float32(self.voxel)) if countable else np.zeros_like(points)
        local = (cells.astype(np.int64) - self._base).T
        if not countable or ((local < 0) | (local >= 1 << AXIS_BITS)).any():
            reach = self.voxel * (1 << (AXIS_BITS - 1))
            raise InputError(
                f"seeds: a sample lies further than {reach:.6g} units ({1 << (AXIS_BITS - 1)} voxels) from the "
                "cameras' middle; look at the pose, remove far samples (max_depth) or take a larger voxel"
            )
        # The offset of the sample's own plane from the voxel's center is at most √3/2 voxels: layers −3 … 3.
        offset = np.einsum("ij,ij->i", points / np.float32(self.voxel) - cells - np.float32(0.5), normals)
        layer = np.clip(np.rint(offset / np.float32(LAYER)).astype(np.int64) + _LAYERS // 2, 0, _LAYERS - 1)
        axis = np.abs(normals).argmax(1)
        facing = 2 * axis + (np.take_along_axis(normals, axis[:, None], 1)[:, 0] > 0)
        keys = (local[0] << AXIS_BITS | local[1]) << AXIS_BITS | local[2]
        values = np.empty((len(points), _COLUMNS))
        values[:, 0:3], values[:, 3:6], values[:, 6:9], values[:, 9] = points, normals, colors, 1
        self._append(*_sum_by_key((keys * _DIRECTIONS + facing) * _LAYERS + layer, values))
        if self._rows > MAX_PARTIAL_ROWS:
            self._join()

    def samples(self) -> SurfaceSamples:
        """One sample for each surface in each voxel, ordered by voxel: mean position, normal and color."""
        self._join()
        if not self._rows:
            empty = np.zeros((0, 3), np.float32)
            return SurfaceSamples(empty, empty, empty, np.zeros(0, np.int64))
        voxel_of = self._keys[0] // (_DIRECTIONS * _LAYERS)
        _, sums = _sum_by_key(_surfaces(voxel_of, self._sums[0], self.voxel), self._sums[0])
        counts = sums[:, 9:]
        normals = sums[:, 3:6] / np.linalg.norm(sums[:, 3:6], axis=1, keepdims=True)
        return SurfaceSamples(
            (sums[:, :3] / counts).astype(np.float32),
            normals.astype(np.float32),
            (sums[:, 6:9] / (255 * counts)).astype(np.float32),
            counts[:, 0].astype(np.int64),
        )

    def _append(self, keys: np.ndarray, sums: np.ndarray) -> None:
        self._keys.append(keys)
        self._sums.append(sums)
        self._rows += len(keys)

    def _join(self) -> None:
        if len(self._keys) > 1:
            keys, sums = _sum_by_key(np.concatenate(self._keys), np.concatenate(self._sums))
            self._keys, self._sums, self._rows = [], [], 0
            self._append(keys, sums)


def _sum_by_key(keys: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sums of the rows that share a key, keys ascending. The stable order makes the rounding repeatable."""
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    starts = np.flatnonzero(np.concatenate(([True], keys[1:] != keys[:-1])))
    return keys[starts], np.add.reduceat(values[order], starts, axis=0)


def _surfaces(voxel_of: np.ndarray, sums: np.ndarray, voxel: float) -> np.ndarray:
    """Numbers the surfaces: rows of one voxel get one number if their normals and planes agree, directly or in a chain.

    A plane at 45° to the axes, or on the border of two layers, is split by noise alone; here it grows together.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    points = sums[:, :3] / sums[:, 9:]
    normals = sums[:, 3:6] / np.linalg.norm(sums[:, 3:6], axis=1, keepdims=True)
    pairs = []
    step = 1
    while True:
        first = np.flatnonzero(voxel_of[step:] == voxel_of[:-step])
        if not first.size:
            break
        second = first + step
        both = normals[first] + normals[second]
        cos = np.einsum("ij,ij->i", normals[first], normals[second])
        gap = np.abs(np.einsum("ij,ij->i", points[first] - points[second], both))
        length = np.sqrt(np.maximum(2 + 2 * cos, 1e-12))
        same = (cos > SAME_SURFACE_COS) & (gap < SAME_SURFACE_OFFSET * voxel * length)
        pairs.append(np.stack([first[same], second[same]]))
        step += 1
    rows, columns = np.concatenate(pairs, axis=1) if pairs else np.zeros((2, 0), np.int64)
    graph = coo_matrix((np.ones(len(rows), np.int8), (rows, columns)), shape=(len(sums), len(sums)))
    _, label = connected_components(graph, directed=False)
    # scipy does not promise an order of its labels: number the surfaces by their first row.
    _, first_row, inverse = np.unique(label, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first_row))[inverse]
