"""Work in pieces: in order, and within work in pieces."""

import threading

import pytest
import torch

from gsencoder.core.runtime.threads import parallel


@pytest.mark.parametrize("threads", [1, 3])
def test_results_come_in_order_also_from_work_within_work(threads: int) -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        found = parallel(lambda row: parallel(lambda column: (row, column), range(5)), range(7))
    finally:
        torch.set_num_threads(before)
    assert found == [[(row, column) for column in range(5)] for row in range(7)]


def test_work_within_work_stays_on_its_thread() -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        inner = parallel(lambda _: set(parallel(lambda _: threading.get_ident(), range(4))), range(6))
        assert all(len(each) == 1 for each in inner)
        assert threading.get_ident() not in set().union(*inner)
        # The next call has its threads again.
        assert threading.get_ident() not in parallel(lambda _: threading.get_ident(), range(4))
    finally:
        torch.set_num_threads(before)


def test_errors_of_a_piece_are_raised() -> None:
    def work(piece: int) -> int:
        if piece == 3:
            raise ValueError("piece 3")
        return piece

    with pytest.raises(ValueError, match="piece 3"):
        parallel(work, range(6))
