"""Space-filling orders of grid cells: Morton and Hilbert codes and their transposed forms (PTv3, Wu et al. 2024).

A code is an int64 whose sorted order visits cells so that neighbors in the order are neighbors in space. Codes are
hierarchical: `code >> 3` is the code of the cell twice as large, so one set of codes serves every level of pooling.

Everything here is written in operators that numpy's arrays and torch's tensors share: plans are made of tensors, and a
runtime without torch needs the same curves.
"""

from functools import cache
from typing import Any, Literal

import numpy as np
from jaxtyping import Int64

from gsencoder.core.errors import InputError

MOST_LEVELS = 22
"""Bits of a coordinate, at most and with one to spare: levels go in pairs."""

Order = Literal["z", "z-trans", "hilbert", "hilbert-trans"]

_EVERY_THIRD = 0x1249249249249249

LARGEST_EXTENT = 2**20
"""Cells along an axis, at most; with room for ALIGN, coordinates take 21 bits, and three of them fill an int64."""

ALIGN = 64
"""Cells are counted from a multiple of this, so that pooling pairs the same cells in a part of a scene as in all of it,
through six levels."""


NEVER = 2**63 - 1
"""A code that no cell has."""


def check_extent(extent: float, voxel: float) -> None:
    """Refuses points that spread over more cells than a code can number.

    Args:
        extent: cells along the longest axis.
        voxel: edge of a cell, world units.

    Raises:
        InputError: 2²⁰ cells or more.
    """
    if not extent < LARGEST_EXTENT:
        raise InputError(
            f"grid: the points spread over {extent:.3g} cells of {voxel:.3g} units on an axis; the limit is 2²⁰; "
            "check the unit (data.metres_per_unit), and remove stray Gaussians (`gsencoder repair`)"
        )


def bits_of(cells: Int64[Any, "N 3"]) -> int:
    """Bits that the largest coordinate needs, at least 1."""
    return max(1, int(cells.max()).bit_length()) if len(cells) else 1


def encode_cells(cells: Int64[Any, "N 3"], order: Order, bits: int) -> Int64[Any, " N"]:
    """Codes of cells (each coordinate from 0 to 2^bits − 1) along a curve; the "-trans" ones swap x and y first."""
    return encode_morton(morton_codes(cells), order, bits)


def encode_morton(morton: Int64[Any, " N"], order: Order, bits: int) -> Int64[Any, " N"]:
    """`encode_cells` for cells that are given by their Morton codes."""
    morton = swapped(morton, order)
    return hilbert_from_morton(morton, bits) if order.startswith("hilbert") else morton


def swapped(morton: Int64[Any, " N"], order: Order) -> Int64[Any, " N"]:
    """Morton codes with x and y swapped, for the "-trans" orders; for others as they are."""
    if not order.endswith("-trans"):
        return morton
    y = (morton & (_EVERY_THIRD << 1)) << 1
    return (morton & _EVERY_THIRD) | y | ((morton >> 1) & (_EVERY_THIRD << 1))


def morton_codes(cells: Int64[Any, "N 3"]) -> Int64[Any, " N"]:
    """Z-order: the bits of x, y and z interleaved, x highest, for coordinates below 2²¹."""
    spread = cells & (2**21 - 1)
    # Each step moves the upper half of every group of bits away, until two zeros stand between any two bits.
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, _EVERY_THIRD),
    ):
        spread = (spread | (spread << shift)) & mask
    return (spread[:, 0] << 2) | (spread[:, 1] << 1) | spread[:, 2]


def hilbert_from_morton(morton: Int64[Any, " N"], bits: int) -> Int64[Any, " N"]:
    """Positions along Hilbert's curve, which only ever steps to a face neighbor.

    Hamilton 2006, "Compact Hilbert indices": the curve within a cell is one of 24 orientations, and a table gives,
    for an orientation and the octants of the next two levels, their places on the curve and the orientation inside.
    `bits` says how far to look and changes nothing else: cells that are counted from one corner are always ordered
    alike.
    """
    table = hilbert_table()
    if hasattr(morton, "new_tensor"):
        table = morton.new_tensor(table)
    levels = bits + bits % 2
    code = morton & 0
    state = code + start_of(levels)
    for level in range(levels - 2, -1, -2):
        found = table.take((state << 6) | ((morton >> (3 * level)) & 63))
        code = (code << 6) | (found & 63)
        state = found >> 6
    return code


@cache
def start_of(levels: int) -> int:
    """The orientation of the lowest corner of so many levels, within a curve of MOST_LEVELS."""
    state = 0
    for _ in range(MOST_LEVELS - levels):
        _, state = _hilbert_step(state, 0)
    return state


@cache
def hilbert_table() -> Int64[np.ndarray, " 1536"]:
    """For orientation·64 + two octants: the inner orientation·64 + two digits of the code."""
    rows = []
    for state in range(24):
        for first in range(8):
            digit, inside = _hilbert_step(state, first)
            for second in range(8):
                below, innermost = _hilbert_step(inside, second)
                rows.append((innermost << 6) | (digit << 3) | below)
    return np.array(rows, np.int64)


def _hilbert_step(state: int, octant: int) -> tuple[int, int]:
    """An octant's place on the curve of orientation 3·entry + direction, and the orientation of the curve in it."""
    entry, direction = divmod(state, 3)
    turned = _rotate_left(octant ^ entry, 3 - (direction + 1) % 3)
    digit = turned ^ (turned >> 1) ^ (turned >> 2)
    start = 0 if digit == 0 else _gray(2 * ((digit - 1) // 2))
    step = 0 if digit == 0 else _trailing_ones(digit - 1 if digit % 2 == 0 else digit) % 3
    inner = entry ^ _rotate_left(start, (direction + 1) % 3)
    return digit, 3 * inner + (direction + step + 1) % 3


def _gray(number: int) -> int:
    return number ^ (number >> 1)


def _rotate_left(octant: int, by: int) -> int:
    by %= 3
    return ((octant << by) | (octant >> (3 - by))) & 7


def _trailing_ones(number: int) -> int:
    return ((number ^ (number + 1)).bit_length()) - 1
