"""Quantization of matrices to eight bits."""

import numpy as np
from jaxtyping import Float32, Int8


def round_columns(
    matrix: Float32[np.ndarray, "rows columns"], limit: int = 127
) -> tuple[Int8[np.ndarray, "rows columns"], Float32[np.ndarray, " columns"]]:
    """Quantizes each column: integers from −limit to limit and scales, with matrix ≈ integers · scale within scale /
    2."""
    largest = np.abs(matrix).max(axis=0)
    scale = np.where(largest > 0, largest / limit, 1).astype(np.float32)
    return np.clip(np.rint(matrix / scale), -limit, limit).astype(np.int8), scale
