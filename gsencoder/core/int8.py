"""Quantization of matrices to eight bits."""

import numpy as np
from jaxtyping import Float32, Int8

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
