"""Numbers of rows that a file stores for the part of an array that it holds."""

import numpy as np
from jaxtyping import Int


def rise_within(rows: Int[np.ndarray, " n"], count: int) -> bool:
    """Whether numbers rise strictly from 0 or more to less than `count`.

    They are compared and not subtracted: differences of damaged numbers leave the range of int32, and look positive.
    """
    return not len(rows) or bool(rows[0] >= 0 and rows[-1] < count and (rows[1:] > rows[:-1]).all())
