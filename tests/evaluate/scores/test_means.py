"""Means over what has a value."""

import math

import numpy as np

from gsencoder.evaluate.tables import mean_of


def test_values_that_are_no_numbers_are_left_out() -> None:
    assert mean_of([1.0, math.nan, 4.0]) == 2.5
    assert mean_of(np.array([0.25])) == 0.25
    assert math.isnan(mean_of([]))
    assert math.isnan(mean_of(np.full(3, math.nan)))
