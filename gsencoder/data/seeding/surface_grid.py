"""Grid subsampling of oriented surface samples that separates different surfaces inside one voxel.

The mean of all samples in a voxel lies between the surfaces where two of them share it: a spoon's rim sinks towards
the table, the edge of a box is rounded off. Samples are therefore summed by voxel, by the axis direction that they
face, and by their layer along the normal; sums of one voxel that turn out to be the same surface are joined again at
the end. Sums add up in any order, so frames stream through in constant memory.
"""

from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float32, Int64, UInt8

from gsencoder.core.errors import InputError
from gsencoder.core.process import kernel

AXIS_BITS = 19
"""Bits of a voxel index along one axis: 524,288 voxels, or 10 km at 2 cm."""
OUT_OF_REACH = 2.0**62
"""Voxels that no integer counts."""
MIN_SLOTS = 1 << 12
"""Size of the hash table at first, a power of two like every later one."""
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
        self._slots = np.full(MIN_SLOTS, -1, np.int32)
        self._keys = np.empty(0, np.int64)
        self._sums = np.empty((0, _COLUMNS))
        self._rows = 0

    def add(
        self, points: Float32[np.ndarray, "n 3"], normals: Float32[np.ndarray, "n 3"], colors: UInt8[np.ndarray, "n 3"]
    ) -> None:
        """Adds samples. Raises InputError where one lies outside the grid's reach."""
        if not len(points):
            return
        self._make_room(self._rows + len(points))
        arrays = (points, normals, colors, np.float32(self.voxel), self._base)
        rows = _add_samples(*arrays, self._slots, self._keys, self._sums, self._rows)
        if rows < 0:
            reach = self.voxel * (1 << (AXIS_BITS - 1))
            raise InputError(
                f"seeds: a sample lies further than {reach:.6g} units ({1 << (AXIS_BITS - 1)} voxels) from the "
                "cameras' middle; look at the pose, remove far samples (max_depth) or take a larger voxel"
            )
        self._rows = rows

    def samples(self) -> SurfaceSamples:
        """One sample for each surface in each voxel, ordered by voxel: mean position, normal and color."""
        if not self._rows:
            empty = np.zeros((0, 3), np.float32)
            return SurfaceSamples(empty, empty, empty, np.zeros(0, np.int64))
        order = np.argsort(self._keys[: self._rows])
        keys, sums = self._keys[order], self._sums[order]
        surface = _surfaces(keys // (_DIRECTIONS * _LAYERS), sums, self.voxel)
        sums = _sum_rows(surface, sums, int(surface.max()) + 1)
        counts = sums[:, 9:]
        normals = sums[:, 3:6] / np.linalg.norm(sums[:, 3:6], axis=1, keepdims=True)
        return SurfaceSamples(
            (sums[:, :3] / counts).astype(np.float32),
            normals.astype(np.float32),
            (sums[:, 6:9] / (255 * counts)).astype(np.float32),
            counts[:, 0].astype(np.int64),
        )

    def _make_room(self, rows: int) -> None:
        """Makes the arrays large enough for so many rows, and the hash table twice as large."""
        if rows > len(self._keys):
            size = max(rows, 2 * len(self._keys))
            self._keys = np.concatenate([self._keys[: self._rows], np.empty(size - self._rows, np.int64)])
            self._sums = np.concatenate([self._sums[: self._rows], np.empty((size - self._rows, _COLUMNS))])
        if 2 * rows > len(self._slots):
            self._slots = np.full(1 << (2 * rows - 1).bit_length(), -1, np.int32)
            _fill_slots(self._keys[: self._rows], self._slots)


@kernel
@no_type_check
def _slot_of(key, keys, slots):
    """The slot of a key in a hash table with linear probing, or the empty one where it belongs."""
    mask = len(slots) - 1
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    slot = np.int64(mixed >> np.uint64(20)) & mask
    while slots[slot] >= 0 and keys[slots[slot]] != key:
        slot = (slot + 1) & mask
    return slot


@kernel
@no_type_check
def _fill_slots(keys, slots):
    for row in range(len(keys)):
        slots[_slot_of(keys[row], keys, slots)] = row


@kernel
@no_type_check
def _add_samples(points, normals, colors, voxel, base, slots, keys, sums, rows):
    """Adds samples to the sums of their keys, in their order; returns the number of rows, or −1 where one lies outside.

    A key is the voxel, the axis direction that the normal is closest to, and the layer: the offset of the sample's
    plane from the voxel's center, at most √3/2 voxels, in steps of LAYER.
    """
    half, layer_height = np.float32(0.5), np.float32(LAYER)
    last_key, line = np.int64(-1), sums[0]
    for n in range(len(points)):
        key, offset, facing, largest = np.int64(0), np.float32(0), 0, np.float32(-1)
        for axis in range(3):
            position, normal = points[n, axis] / voxel, normals[n, axis]
            cell = np.floor(position)
            # Numbers that no integer holds are out of reach too, and must not be cast.
            if not abs(cell) < OUT_OF_REACH:
                return -1
            local = np.int64(cell) - base[axis]
            if local < 0 or local >= 1 << AXIS_BITS:
                return -1
            key = key << AXIS_BITS | local
            offset += (position - cell - half) * normal
            if abs(normal) > largest:
                largest, facing = abs(normal), 2 * axis + (normal > 0)
        layer = min(max(int(np.rint(offset / layer_height)) + _LAYERS // 2, 0), _LAYERS - 1)
        key = (key * _DIRECTIONS + facing) * _LAYERS + layer
        # Neighboring pixels mostly fall into one voxel.
        if key != last_key:
            slot = _slot_of(key, keys, slots)
            if slots[slot] < 0:
                slots[slot], keys[rows] = rows, key
                sums[rows] = 0.0
                rows += 1
            last_key, line = key, sums[slots[slot]]
        for axis in range(3):
            line[axis] += points[n, axis]
            line[3 + axis] += normals[n, axis]
            line[6 + axis] += colors[n, axis]
        line[9] += 1
    return rows


@kernel
@no_type_check
def _sum_rows(group_of, values, groups):
    """Sums of the rows of each group, in their order."""
    sums = np.zeros((groups, values.shape[1]))
    for row in range(len(values)):
        line = sums[group_of[row]]
        for column in range(len(line)):
            line[column] += values[row, column]
    return sums


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
