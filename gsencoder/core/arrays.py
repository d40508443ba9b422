"""Operations on arrays: evenly spaced indices, repeated values, row numbers, and rounding to int8."""

from collections.abc import Hashable, Iterable
from typing import TypeVar

import numpy as np
from jaxtyping import Float32, Int, Int8, Int64


def even_indices(length: int, count: int) -> Int64[np.ndarray, " n"]:
    """`count` evenly spaced indices into a sequence, its first and last included; all indices if it is shorter."""
    return np.linspace(0, length - 1, min(count, length)).round().astype(np.int64)


Value = TypeVar("Value", bound=Hashable)


def first_repeated(values: Iterable[Value]) -> tuple[Value, int, int] | None:
    """The first value that is there again, with both indices; None if each value is there once."""
    first: dict[Value, int] = {}
    for index, value in enumerate(values):
        if value in first:
            return value, first[value], index
        first[value] = index
    return None


def is_strictly_increasing(rows: Int[np.ndarray, " n"], count: int) -> bool:
    """Whether numbers rise strictly from 0 or more to less than `count`.

    They are compared and not subtracted: differences of damaged numbers leave the range of int32, and look positive.
    """
    return not len(rows) or bool(rows[0] >= 0 and rows[-1] < count and (rows[1:] > rows[:-1]).all())


ROWS = 1 << 14
"""Rows that are quantized at a time: targets of a scene may be a gigabyte."""


def round_columns(
    matrix: Float32[np.ndarray, "rows columns"], limit: int = 127
) -> tuple[Int8[np.ndarray, "rows columns"], Float32[np.ndarray, " columns"]]:
    """Quantizes each column: integers from −limit to limit and scales, with matrix ≈ integers · scale within scale /
    2."""
    largest = np.maximum(matrix.max(axis=0, initial=0), -matrix.min(axis=0, initial=0))
    scale = np.where(largest > 0, largest / limit, 1).astype(np.float32)
    integers = np.empty(matrix.shape, np.int8)
    for start in range(0, len(matrix), ROWS):
        rows = matrix[start : start + ROWS]
        integers[start : start + ROWS] = np.clip(np.rint(rows / scale), -limit, limit)
    return integers, scale
