"""Matrices in eight bits."""

import numpy as np
from jaxtyping import Float32, Int8


def round_columns(
    matrix: Float32[np.ndarray, "rows columns"], most: int = 127
) -> tuple[Int8[np.ndarray, "rows columns"], Float32[np.ndarray, " columns"]]:
    """Integers from −most to most, and the scale of each column: matrix ≈ integers · scale, within half a scale."""
    largest = np.abs(matrix).max(axis=0)
    scale = np.where(largest > 0, largest / most, 1).astype(np.float32)
    return np.clip(np.rint(matrix / scale), -most, most).astype(np.int8), scale
