"""Some of many, evenly spread."""

import numpy as np
from jaxtyping import Int64


def evenly(available: int, wanted: int) -> Int64[np.ndarray, " n"]:
    """Places from the first to the last of `available`, ascending and distinct: `wanted` of them, or all there are."""
    return np.linspace(0, available - 1, min(wanted, available)).round().astype(np.int64)
