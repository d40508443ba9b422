"""Work in pieces: in order, and within work in pieces."""

import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch

from gsencoder.core import threads
from gsencoder.core.errors import SceneWarning
from gsencoder.core.threads import ahead, kernel, parallel


@pytest.mark.parametrize("threads", [1, 3])
def test_results_come_in_order_also_from_work_within_work(threads: int) -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        table = parallel(lambda row: parallel(lambda column: (row, column), range(5)), range(7))
    finally:
        torch.set_num_threads(before)
    assert table == [[(row, column) for column in range(5)] for row in range(7)]


@pytest.fixture
def two_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def meet(barrier: threading.Barrier) -> int:
    """The thread, once another one is there at the same time."""
    barrier.wait(timeout=60)
    return threading.get_ident()


def test_work_within_work_stays_on_its_thread(two_threads: None) -> None:
    barrier = threading.Barrier(2)
    for _ in range(2):
        inner = parallel(lambda _: {meet(barrier), *parallel(lambda _: threading.get_ident(), range(4))}, range(6))
        assert all(len(each) == 1 for each in inner)
        # The caller is one of the two, and has all of its threads again the next time.
        assert len(set().union(*inner) - {threading.get_ident()}) == 1


def test_of_several_errors_the_one_of_the_first_piece_is_raised_and_no_more_pieces_begin(two_threads: None) -> None:
    barrier, begun = threading.Barrier(2), []

    def work(piece: int) -> int:
        begun.append(piece)
        if piece in (2, 3):
            barrier.wait(timeout=60)
            raise ValueError(f"piece {piece}")
        return piece

    with pytest.raises(ValueError, match="piece 2"):
        parallel(work, range(9))
    assert sorted(begun) == [0, 1, 2, 3]
    assert parallel(lambda piece: piece, range(3)) == [0, 1, 2]


def test_where_the_caller_is_interrupted_no_more_pieces_begin_and_none_runs_on(two_threads, monkeypatch):
    working, waited_for = threading.Event(), threading.Event()
    begun, ended = list[int](), list[int]()
    one_thread, join = threads._one_thread, threads._join

    @contextmanager
    def interrupted() -> Iterator[None]:
        if threading.current_thread() is threading.main_thread():
            working.wait(10)
            raise KeyboardInterrupt
        with one_thread():
            yield

    def joined(others: Iterable[threading.Thread]) -> None:
        waited_for.set()
        join(others)

    def work(piece: int) -> None:
        begun.append(piece)
        working.set()
        waited_for.wait(10)
        ended.append(piece)

    monkeypatch.setattr(threads, "_one_thread", interrupted)
    monkeypatch.setattr(threads, "_join", joined)
    with pytest.raises(KeyboardInterrupt):
        parallel(work, range(9))
    assert begun == ended == [0]


def test_work_ahead_comes_in_order_and_one_item_before_it_is_asked_for() -> None:
    started = [threading.Event() for _ in range(4)]

    def work(item: int) -> tuple[int, int]:
        started[item].set()
        return item, threading.get_ident()

    for number, (item, thread) in enumerate(ahead(work, range(4))):
        assert item == number
        assert thread != threading.get_ident()
        assert number == 3 or started[number + 1].wait(10)
    assert list(ahead(work, range(0))) == []
    results = ahead(lambda item: 1 // (2 - item), range(4))
    assert [next(results), next(results)] == [0, 1]
    with pytest.raises(ZeroDivisionError):
        next(results)


@pytest.mark.parametrize(("threads", "workers", "share"), [(4, 2, 2), (2, 2, 1), (1, 3, 1)])
def test_workers_ahead_share_the_threads_and_give_results_in_order(threads, workers, share, monkeypatch):
    monkeypatch.setattr("gsencoder.core.threads.thread_count", lambda: threads)
    together = threading.Barrier(min(workers, threads))

    def work(item: int) -> tuple[int, set[int]]:
        # Nobody passes before all workers are here.
        together.wait(10)
        gather = threading.Barrier(share)
        return item, set(parallel(lambda _: (gather.wait(10), threading.get_ident())[1], range(share)))

    results = list(ahead(work, range(6), workers))
    assert [item for item, _ in results] == list(range(6))
    assert all(len(of_item) == share for _, of_item in results)


@pytest.mark.parametrize(("stated", "expected"), [("1", "1"), ("4,2", "cores")])
def test_without_torch_there_are_as_many_threads_as_the_environment_says(stated: str, expected: str) -> None:
    code = (
        "import os, sys\n"
        f"os.environ['OMP_NUM_THREADS'] = {stated!r}\n"
        "from gsencoder.core.threads import thread_count\n"
        "cores = os.cpu_count()\n"
        f"sys.exit('torch' in sys.modules or thread_count() != {expected if expected != 'cores' else 'cores'})"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_where_nothing_can_be_stored_kernels_are_compiled_anew_with_one_warning(monkeypatch):
    import numba

    def njit(*, cache: bool = False, **_: object) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
        if cache:
            raise RuntimeError("cannot cache function 'f': no locator available for file 'f.py'")
        return lambda function: function

    monkeypatch.setattr(numba, "njit", njit)
    threads._warn_uncached.cache_clear()
    with pytest.warns(SceneWarning, match="cannot be stored .* NUMBA_CACHE_DIR=FOLDER names a folder") as said:
        assert [kernel(abs)(-1), kernel(abs)(-2)] == [1, 2]
    assert len(said) == 1
