"""Even indices, repeated values, row numbers, and rows in a temporary file."""

import errno

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsencoder.core.archive import RowFile
from gsencoder.core.arrays import even_indices, first_repeated, is_strictly_increasing
from gsencoder.core.errors import InputError


@given(st.integers(1, 5000), st.integers(1, 6000))
def test_places_are_distinct_ascending_and_as_many_as_wanted_or_as_there_are(available: int, wanted: int) -> None:
    places = even_indices(available, wanted)
    assert len(places) == min(available, wanted)
    assert places[0] == 0
    assert (np.diff(places) > 0).all()
    if wanted > 1:
        assert places[-1] == available - 1


def test_the_value_and_both_places_are_given() -> None:
    assert first_repeated(["a", "b", "c", "b", "a"]) == ("b", 1, 3)
    assert first_repeated([]) is first_repeated(["a"]) is None
    assert first_repeated(iter([None, 0, None])) == (None, 0, 2)


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
        # Their differences leave the range of the type, and look positive.
        ([0, 2**31 - 1, -(2**31), 9], 10, False),
    ],
)
def test_rows_rise_strictly_from_0_to_less_than_their_count(rows: list[int], count: int, expected: bool) -> None:
    assert is_strictly_increasing(np.array(rows, np.int32), count) is expected


@pytest.mark.parametrize("sizes", [[], [0, 5, 0, 1, 7]])
def test_rows_come_back_in_order_however_they_were_divided(sizes: list[int]) -> None:
    rng = np.random.default_rng(0)
    parts = [rng.normal(size=(size, 4)).astype(np.float32) for size in sizes]
    with RowFile(4) as file:
        for part in parts:
            file.append(part)
        np.testing.assert_array_equal(file.array(), np.concatenate([np.zeros((0, 4), np.float32), *parts]))


def test_a_full_disk_is_named_with_the_folder_that_is_full(monkeypatch: pytest.MonkeyPatch) -> None:
    class Full:
        def write(self, data: bytes) -> None:
            raise OSError(errno.ENOSPC, "No space left on device")

        def close(self) -> None:
            pass

    monkeypatch.setattr("gsencoder.core.archive.TemporaryFile", Full)
    with RowFile(4) as file, pytest.raises(InputError, match="2 rows of 4 channels do not fit .*; set TMPDIR"):
        file.append(np.zeros((2, 4), np.float32))
