"""Rows in a temporary file are those that were appended."""

import errno

import numpy as np
import pytest

from gsencoder.core.archive import RowFile
from gsencoder.core.errors import InputError


@pytest.mark.parametrize("sizes", [[], [0], [3], [0, 5, 0, 1, 7]])
def test_rows_come_back_in_order_however_they_were_divided(sizes: list[int]) -> None:
    rng = np.random.default_rng(0)
    parts = [rng.normal(size=(size, 4)).astype(np.float32) for size in sizes]
    with RowFile(4) as file:
        for part in parts:
            file.append(part)
        np.testing.assert_array_equal(file.array(), np.concatenate([np.zeros((0, 4), np.float32), *parts]))


def test_rows_of_another_length_and_a_full_disk_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    class Full:
        def write(self, data: bytes) -> None:
            raise OSError(errno.ENOSPC, "No space left on device")

        def close(self) -> None:
            pass

    with RowFile(4) as file, pytest.raises(InputError, match="rows: expected 4 channels, got 3"):
        file.append(np.zeros((2, 3), np.float32))
    monkeypatch.setattr("gsencoder.core.archive.TemporaryFile", Full)
    with RowFile(4) as file, pytest.raises(InputError, match="2 rows of 4 channels do not fit .*; set TMPDIR"):
        file.append(np.zeros((2, 4), np.float32))
