"""Evenly spaced indices."""

import numpy as np
from jaxtyping import Int64


def even_indices(length: int, count: int) -> Int64[np.ndarray, " n"]:
    """`count` evenly spaced indices into a sequence, its first and last included; all indices if it is shorter."""
    return np.linspace(0, length - 1, min(count, length)).round().astype(np.int64)
