"""Checks of the arrays that frozen dataclasses hold; their errors name the class, the field and the first bad row."""

import sys

import numpy as np

from gsencoder.core.errors import InputError

UNIT_TOLERANCE = 1e-3
"""How far from 1 the norm of a quaternion, and from 0 an entry of RᵀR − I, may be."""


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
    flat = array.reshape(len(array), -1)
    # The sum of a row is finite unless an entry is not (or it overflows): one pass, no boolean array of full size.
    with np.errstate(over="ignore", invalid="ignore"):
        suspicious = ~np.isfinite(flat.sum(axis=1, dtype=np.float64))
    if suspicious.any():
        check_rows(owner, name, np.isfinite(flat).all(axis=1), "finite values", array)


def check_unit(metres_per_unit: float, name: str) -> None:
    """Complains about what is no unit of length.

    Raises:
        InputError: not a positive finite number; `name` begins the message.
    """
    good = isinstance(metres_per_unit, (int, float)) and not isinstance(metres_per_unit, bool)
    if not good or not 0 < metres_per_unit <= sys.float_info.max:
        raise InputError(f"{name}: expected a positive number of metres, got {str(metres_per_unit)[:40]}")
