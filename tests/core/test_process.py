"""Ranks, seconds and types of a process, words of messages, and work in pieces."""

import importlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import pytest
import torch

from gsencoder.core import threads
from gsencoder.core.device import autocast_dtype
from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.process import (
    SIGNALS,
    Clock,
    ProcessRank,
    Stopped,
    defer_signals,
    first_host,
    rank_from_environment,
    stop_of,
    stopping_signals,
    timed,
)
from gsencoder.core.threads import ahead, kernel, parallel

SLURM = {
    "SLURM_STEP_ID": "0",
    "SLURM_PROCID": "5",
    "SLURM_NTASKS": "8",
    "SLURM_LOCALID": "1",
    "SLURM_STEP_NODELIST": "gpu[03-04]",
    "SLURM_JOB_ID": "123456",
}


def test_torchrun_and_slurm_tell_rank_and_size_and_where_to_meet() -> None:
    process, meeting = rank_from_environment({"RANK": "3", "WORLD_SIZE": "4", "LOCAL_RANK": "1"})
    assert (process.rank, process.world_size, process.local_rank, process.is_first) == (3, 4, 1, False)
    assert meeting == "env://"
    process, meeting = rank_from_environment(SLURM)
    assert (process.rank, process.world_size, process.local_rank) == (5, 8, 1)
    assert meeting == "tcp://gpu03:23456"
    # A batch script itself is one process.
    environment = {name: value for name, value in SLURM.items() if name != "SLURM_STEP_ID"}
    assert rank_from_environment(environment) == (ProcessRank(), "")


@pytest.mark.parametrize(("nodes", "host"), [("a,b", "a"), ("a[001-200]", "a001"), ("n[2,3].x.org,m", "n2.x.org")])
def test_the_first_machine_of_a_list(nodes: str, host: str) -> None:
    assert first_host(nodes) == host


@pytest.mark.parametrize(
    ("environment", "message"),
    [
        ({"RANK": "4", "WORLD_SIZE": "4"}, "RANK=4 is not below WORLD_SIZE=4"),
        ({"RANK": "x", "WORLD_SIZE": "4"}, "RANK: expected a whole number"),
        ({**SLURM, "SLURM_STEP_NODELIST": ""}, "node list"),
    ],
)
def test_an_environment_that_contradicts_itself_is_refused(environment: dict[str, str], message: str) -> None:
    with pytest.raises(InputError, match=message):
        rank_from_environment(environment)


def test_marked_functions_count_on_the_clock_that_runs_and_on_none_elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    times = iter([0.0, 0.0, 1.0, 1.0, 10.0, 12.0, 15.0, 20.0, 24.0, 30.0, 31.0, 40.0])
    monkeypatch.setattr("gsencoder.core.process.time.perf_counter", lambda: next(times))
    double = timed("lift")(lambda number: 2 * number)
    assert double(1) == 2
    with Clock().running() as outer:
        assert double(2) == 4
        with Clock().running() as inner:
            assert double(3) == 6
        assert double(4) == 8
        with pytest.raises(TypeError, match="missing"):
            double()
    assert double(5) == 10
    assert outer.seconds == {"lift": 5.0}
    assert inner.seconds == {"lift": 2.0}


def test_steps_of_several_threads_share_the_seconds_of_the_wall_clock() -> None:
    def work(item: int) -> int:
        time.sleep(0.02)
        return item

    clock = Clock()
    clock.seconds = {"teacher": 2.0}
    start = time.perf_counter()
    with clock.running():
        assert list(ahead(timed("blend")(work), range(6), 3)) == [*range(6)]
    wall = time.perf_counter() - start
    assert clock.seconds["teacher"] == 2.0
    assert 2 * 0.02 <= clock.seconds["blend"] <= wall


@pytest.mark.parametrize("training", [False, True])
@pytest.mark.parametrize(("amx", "avx"), [(False, False), (False, True), (True, True)])
def test_automatic_precision_is_bfloat16_only_where_the_processor_multiplies_it(monkeypatch, training, amx, avx):
    monkeypatch.setattr(torch.cpu, "_is_amx_tile_supported", lambda: amx)
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: avx)
    expected = torch.bfloat16 if amx or (avx and not training) else None
    assert autocast_dtype("auto", torch.device("cpu"), training=training) == expected
    assert autocast_dtype("auto", torch.device("cuda"), training=training) is None
    for device in ("cpu", "cuda"):
        assert autocast_dtype("bfloat16", torch.device(device), training=training) == torch.bfloat16
        assert autocast_dtype("float32", torch.device(device), training=training) is None


pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals")


@pytest.fixture(params=SIGNALS)
def number(request: pytest.FixtureRequest) -> Iterator[int]:
    """A signal that raises `Stopped`, as it does on the command line."""

    def stop(number: int, _: object) -> None:
        raise Stopped(number)

    before = signal.signal(request.param, stop)
    yield request.param
    signal.signal(request.param, before)


def test_what_is_held_back_happens_as_a_whole_and_is_stopped_then(number: int) -> None:
    handler, done = signal.getsignal(number), []

    def work() -> None:
        with defer_signals():
            os.kill(os.getpid(), number)
            done.append("all of it")

    with pytest.raises(Stopped) as stop:
        work()
    assert stop.value.number == number
    assert done == ["all of it"]
    assert signal.getsignal(number) is handler
    with pytest.raises(Stopped):
        os.kill(os.getpid(), number)


def test_a_signal_is_heard_beside_an_error_too(number: int) -> None:
    def work() -> None:
        with defer_signals():
            os.kill(os.getpid(), number)
            raise ValueError("wrong")

    with pytest.raises(Stopped) as stop:
        work()
    assert isinstance(stop.value.__context__, ValueError)


def test_signals_that_python_does_not_handle_are_left_alone() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with defer_signals():
            assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
            os.kill(os.getpid(), signal.SIGHUP)
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_stop_is_known_by_itself_and_within_what_compiled_code_raises() -> None:
    stop, interrupt = Stopped(15), KeyboardInterrupt()
    assert stop_of(stop) is stop
    assert stop_of(interrupt) is interrupt
    for inner in (stop, interrupt):
        caused, met = SystemError("a"), SystemError("b")
        caused.__cause__, met.__context__ = inner, inner
        assert stop_of(caused) is stop_of(met) is inner
        outermost = SystemError("<function g> returned a result with an exception set")
        outermost.__cause__ = caused
        assert stop_of(outermost) is inner
    assert stop_of(SystemError("alone")) is None
    other = ValueError("wrong")
    other.__cause__ = stop
    assert stop_of(other) is None


def test_signals_raise_within_the_block_of_a_command_and_handlers_are_given_back() -> None:
    before = {number: signal.signal(number, signal.SIG_DFL) for number in SIGNALS if number != signal.SIGINT}
    try:
        for number in before:
            with pytest.raises(Stopped) as stop, stopping_signals():
                os.kill(os.getpid(), number)
            assert stop.value.number == number
            assert signal.getsignal(number) == signal.SIG_DFL
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def test_a_library_has_the_handlers_of_its_program() -> None:
    received = []
    before = signal.signal(signal.SIGINT, lambda number, _: received.append(number))
    try:
        with stopping_signals():
            os.kill(os.getpid(), signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, before)
    assert received == [signal.SIGINT]


def test_in_another_thread_nothing_is_installed() -> None:
    def work() -> object:
        with stopping_signals():
            return signal.getsignal(signal.SIGTERM)

    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(work).result() == signal.getsignal(signal.SIGTERM)


def test_a_signal_that_comes_while_a_library_is_imported_is_raised_after_it(tmp_path, monkeypatch):
    library = (
        "import os, signal\ntry:\n    os.kill(os.getpid(), signal.SIGINT)\nexcept BaseException:\n    pass\nready = 1\n"
    )
    (tmp_path / "library_that_drops.py").write_text(library)
    monkeypatch.syspath_prepend(tmp_path)
    ready = []

    def run() -> None:
        with stopping_signals():
            ready.append(importlib.import_module("library_that_drops").ready)
            time.sleep(5)

    with pytest.raises(KeyboardInterrupt):
        run()
    assert ready == [1]


def test_a_signal_whose_exception_a_destructor_drops_is_sent_again() -> None:
    class Dying:
        def __del__(self) -> None:
            signal.raise_signal(signal.SIGTERM)

    def run() -> None:
        with stopping_signals():
            dying = Dying()
            del dying
            time.sleep(5)

    with pytest.raises(Stopped):
        run()


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
    one_thread, join = threads._one_thread, threading.Thread.join

    @contextmanager
    def interrupted() -> Iterator[None]:
        if threading.current_thread() is threading.main_thread():
            working.wait(10)
            raise KeyboardInterrupt
        with one_thread():
            yield

    def joined(thread: threading.Thread) -> None:
        waited_for.set()
        join(thread)

    def work(piece: int) -> None:
        begun.append(piece)
        working.set()
        waited_for.wait(10)
        ended.append(piece)

    monkeypatch.setattr(threads, "_one_thread", interrupted)
    monkeypatch.setattr(threading.Thread, "join", joined)
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


@pytest.mark.parametrize(("stated", "expected"), [("1", "1"), ("4,2", str(os.cpu_count()))])
def test_without_torch_there_are_as_many_threads_as_the_environment_says(stated: str, expected: str) -> None:
    code = "import sys; from gsencoder.core.threads import thread_count; print('torch' in sys.modules, thread_count())"
    environment = {**os.environ, "OMP_NUM_THREADS": stated}
    said = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert said.stdout.split() == ["False", expected]


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
