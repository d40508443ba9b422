"""Row numbers of files."""

import numpy as np
import pytest

from gsencoder.core.arrays import rise_within


@pytest.mark.parametrize(
    ("rows", "count", "expected"),
    [
        ([], 0, True),
        ([0], 1, True),
        ([0, 3, 9], 10, True),
        ([0, 3, 10], 10, False),
        ([-1, 3], 10, False),
        ([3, 3], 10, False),
        ([4, 3, 9], 10, False),
    ],
)
def test_rows_rise_strictly_from_0_to_less_than_their_count(rows: list[int], count: int, expected: bool) -> None:
    assert rise_within(np.array(rows, np.int32), count) is expected


def test_numbers_whose_differences_leave_the_range_of_their_type_do_not_rise() -> None:
    rows = np.array([0, 2**31 - 1, -(2**31), 9], np.int32)
    assert (np.diff(rows) > 0)[1]
    assert not rise_within(rows, 10)
