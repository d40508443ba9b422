"""Means over what has a value."""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64


def mean_of(values: Sequence[float] | Float64[np.ndarray, " n"]) -> float:
    """The mean of the values that are numbers; NaN if none is."""
    array = np.asarray(values, np.float64)
    numbers = array[~np.isnan(array)]
    return float(numbers.mean()) if len(numbers) else math.nan
