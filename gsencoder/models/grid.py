"""Space-filling orders of grid cells: Morton and Hilbert codes and their transposed forms (PTv3, Wu et al. 2024).

A code is an int64, and cells sorted by code follow a curve on which neighbors are close in space. Codes are
hierarchical: `code >> 3` is the code of the parent cell, so one set of codes serves every level of pooling.

All functions use only operators that numpy arrays and torch tensors share: the torch encoder and a runtime without
torch need the same curves.
"""

from collections.abc import Sequence
from functools import cache
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float32, Int64

from gsencoder.core.errors import InputError
from gsencoder.core.threads import parallel

MAX_LEVELS = 22
"""Largest number of bits of a coordinate that Hilbert codes handle; even, since levels are processed in pairs."""

Order = Literal["z", "z-trans", "hilbert", "hilbert-trans"]

_EVERY_THIRD_BIT = 0x1249249249249249

MAX_EXTENT = 2**20
"""Limit of the number of cells along an axis. With room for ALIGN a coordinate takes 21 bits; three fill an int64."""

ALIGN = 64
"""Grid coordinates are counted from a multiple of this many cells, so that six levels of pooling merge the same cells
in a part of a scene as in the full scene."""


INVALID_CODE = 2**63 - 1
"""A code that no cell has, used as padding."""


def check_extent(extent: float, voxel: float) -> None:
    """Checks that points do not spread over more cells on an axis than codes can number."""
    if not extent < MAX_EXTENT:
        raise InputError(
            f"grid: the points spread over {extent:.3g} cells of {voxel:.3g} units on an axis; the limit is 2²⁰; "
            "check the unit (data.metres_per_unit), and remove stray Gaussians (`gsencoder repair`)"
        )


def coordinate_bits(cells: Int64[Any, "N 3"]) -> int:
    """Number of bits that the largest coordinate needs, at least 1."""
    return max(1, int(cells.max()).bit_length()) if len(cells) else 1


def curve_from_morton(morton: Int64[Any, " N"], order: Order, bits: int) -> Int64[Any, " N"]:
    """Codes along a curve of cells that are given by Morton codes of coordinates from 0 to 2^bits − 1; the "-trans"
    orders swap x and y first."""
    morton = swap_xy(morton, order)
    return hilbert_from_morton(morton, bits) if order.startswith("hilbert") else morton


def swap_xy(morton: Int64[Any, " N"], order: Order) -> Int64[Any, " N"]:
    """Morton codes with x and y swapped for the "-trans" orders, and unchanged for the others."""
    if not order.endswith("-trans"):
        return morton
    y = (morton & (_EVERY_THIRD_BIT << 1)) << 1
    return (morton & _EVERY_THIRD_BIT) | y | ((morton >> 1) & (_EVERY_THIRD_BIT << 1))


def morton_codes(cells: Int64[Any, "N 3"]) -> Int64[Any, " N"]:
    """Morton codes (Z-order): the bits of x, y and z interleaved, x highest, for coordinates below 2²¹."""
    spread = cells & (2**21 - 1)
    # Each step moves the upper half of every group of bits away, until two zeros stand between any two bits.
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, _EVERY_THIRD_BIT),
    ):
        spread = (spread | (spread << shift)) & mask
    return (spread[:, 0] << 2) | (spread[:, 1] << 1) | spread[:, 2]


def hilbert_from_morton(morton: Int64[Any, " N"], bits: int) -> Int64[Any, " N"]:
    """Positions along Hilbert's curve, on which consecutive cells share a face.

    The curve within a cell has one of 24 orientations (Hamilton 2006, "Compact Hilbert indices"). A table gives, for an
    orientation and the octants of the next two levels, their digits on the curve and the orientation inside. `bits`
    limits the work and does not change the result.
    """
    table = hilbert_table()
    if hasattr(morton, "new_tensor"):
        table = morton.new_tensor(table)
    levels = bits + bits % 2
    code = morton & 0
    orientation = code + start_orientation(levels)
    for level in range(levels - 2, -1, -2):
        entry = table.take((orientation << 6) | ((morton >> (3 * level)) & 63))
        code = (code << 6) | (entry & 63)
        orientation = entry >> 6
    return code


@cache
def start_orientation(levels: int) -> int:
    """The orientation of the lowest cube of 2^levels cells an edge, within a curve of MAX_LEVELS levels."""
    orientation = 0
    for _ in range(MAX_LEVELS - levels):
        _, orientation = _hilbert_step(orientation, 0)
    return orientation


@cache
def hilbert_table() -> Int64[np.ndarray, " 1536"]:
    """At row orientation·64 + two octal digits of octants: the inner orientation·64 + two octal digits of the code."""
    rows = []
    for orientation in range(24):
        for first_octant in range(8):
            first_digit, inner = _hilbert_step(orientation, first_octant)
            for second_octant in range(8):
                second_digit, innermost = _hilbert_step(inner, second_octant)
                rows.append((innermost << 6) | (first_digit << 3) | second_digit)
    return np.array(rows, np.int64)


def _hilbert_step(orientation: int, octant: int) -> tuple[int, int]:
    """The digit of an octant on the curve, and the orientation of the curve inside the octant.

    An orientation is 3·entry + direction, with the octant of the entry and the axis from entry to exit.
    """
    entry, direction = divmod(orientation, 3)
    rotated = _rotate_left(octant ^ entry, 3 - (direction + 1) % 3)
    digit = rotated ^ (rotated >> 1) ^ (rotated >> 2)
    start = 0 if digit == 0 else _gray_code(2 * ((digit - 1) // 2))
    step = 0 if digit == 0 else _trailing_ones(digit - 1 if digit % 2 == 0 else digit) % 3
    inner_entry = entry ^ _rotate_left(start, (direction + 1) % 3)
    return digit, 3 * inner_entry + (direction + step + 1) % 3


def _gray_code(number: int) -> int:
    return number ^ (number >> 1)


def _rotate_left(octant: int, by: int) -> int:
    by %= 3
    return ((octant << by) | (octant >> (3 - by))) & 7


def _trailing_ones(number: int) -> int:
    return ((number ^ (number + 1)).bit_length()) - 1


class SceneCurves(NamedTuple):
    """The patch boundaries of a full scene, for the plans of its parts: its lowest corner, the origin of its grid
    coordinates, in world units, and for each level the first code of each of P patches along each of O orders."""

    corner: Float32[np.ndarray, "3"]
    starts: tuple[Int64[np.ndarray, "O _P"], ...]


def cut_scene_curves(
    means: Float32[np.ndarray, "N 3"], voxel: float, *, levels: int, orders: Sequence[Order], patch: int
) -> SceneCurves | None:
    """Cuts the curves of a scene into patches of at most `patch` tokens: T of them make ⌈T / patch⌉ patches, and the
    k-th begins at token ⌊k·T / patches⌋. None if the scene has too many cells for one set of codes, so that each part
    needs its own."""
    scaled = np.floor(means.astype(np.float64) / voxel)
    low, high = scaled.min(axis=0), scaled.max(axis=0)
    # Two cells fewer than would fit, since the origin of a part may be rounded to a cell next to the lowest one.
    if not (high - low).max() < MAX_EXTENT - 2:
        return None
    cells = (scaled - np.floor(low / ALIGN) * ALIGN).astype(np.int64)
    # Sorting is faster than the hash table of np.unique, and the codes must be in order anyway.
    morton, bits = _unique_sorted(np.sort(morton_codes(cells))), coordinate_bits(cells)

    def codes_along(order: int) -> Int64[np.ndarray, " T"]:
        return np.sort(curve_from_morton(morton, orders[order], bits))

    curve_codes = parallel(codes_along, range(len(orders)))
    starts = []
    for level in range(levels):
        if level:
            curve_codes = [_unique_sorted(codes >> 3) for codes in curve_codes]
        count = len(curve_codes[0])
        patches = -(-count // patch)
        first_tokens = np.arange(patches) * count // patches
        starts.append(np.stack([codes[first_tokens] for codes in curve_codes]))
    return SceneCurves(means.min(axis=0), tuple(starts))


def _unique_sorted(sorted_codes: Int64[np.ndarray, " T"]) -> Int64[np.ndarray, " t"]:
    return sorted_codes[np.concatenate(([True], sorted_codes[1:] != sorted_codes[:-1]))]
