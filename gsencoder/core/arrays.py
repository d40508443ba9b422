"""Operations on arrays: evenly spaced indices, repeated values, row numbers, rounding to int8; and checks of the arrays
that frozen dataclasses hold, whose errors name the class, the field and the first bad row."""

from collections.abc import Hashable, Iterable
from typing import TypeVar

import numpy as np
from jaxtyping import Float32, Int, Int8, Int64

from gsencoder.core.errors import InputError


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


UNIT_TOLERANCE = 1e-3  # How far from 1 the norm of a quaternion, and from 0 an entry of RᵀR − I, may be


def fail(owner: str, name: str, expected: str, got: str) -> None:
    raise InputError(f"{owner}.{name}: expected {expected}, got {got}")


def check_array(owner: str, name: str, array: object, dtype: str, shape: tuple[int | str, ...]) -> None:
    expected = f"{dtype}[{', '.join(map(str, shape))}]"
    if not isinstance(array, np.ndarray):
        fail(owner, name, expected, type(array).__name__)
        return
    same = array.ndim == len(shape) and all(
        isinstance(want, str) or want == got for want, got in zip(shape, array.shape, strict=True)
    )
    if array.dtype != np.dtype(dtype) or not same:
        fail(owner, name, expected, f"{array.dtype}[{', '.join(map(str, array.shape))}]")


def check_rows(owner: str, name: str, good: np.ndarray, expected: str, values: np.ndarray) -> None:
    """Fails naming the first bad row and how many there are."""
    if not good.all():
        bad = np.flatnonzero(~good)
        fail(owner, name, expected, f"{values[bad[0]].tolist()} in row {bad[0]} ({bad.size} bad of {good.size} rows)")


def check_finite(owner: str, name: str, array: np.ndarray) -> None:
    if array.size == 0:
        return
    # The sum is finite unless an entry is not (or it overflows): one pass, no boolean array of full size.
    with np.errstate(over="ignore", invalid="ignore"):
        if np.isfinite(array.sum(dtype=np.float64)):
            return
    check_rows(owner, name, np.isfinite(array.reshape(len(array), -1)).all(axis=1), "finite values", array)
