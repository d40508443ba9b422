"""What a process knows of itself: its rank and its seconds; types of networks by device, and words of messages."""

import os
import signal
import threading
import time
from collections.abc import Iterator

import pytest
import torch

from gsencoder.core.device import autocast_dtype
from gsencoder.core.errors import InputError
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
from gsencoder.core.threads import ahead

SLURM = {
    "SLURM_STEP_ID": "0",
    "SLURM_PROCID": "5",
    "SLURM_NTASKS": "8",
    "SLURM_LOCALID": "1",
    "SLURM_STEP_NODELIST": "gpu[03-04]",
    "SLURM_JOB_ID": "123456",
}


def test_torchrun_tells_rank_and_size() -> None:
    process, meeting = rank_from_environment({"RANK": "3", "WORLD_SIZE": "4", "LOCAL_RANK": "1"})
    assert (process.rank, process.world_size, process.local_rank, process.is_first) == (3, 4, 1, False)
    assert meeting == "env://"


def test_slurm_tells_rank_and_size_and_where_to_meet() -> None:
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
    assert 0.8 * wall < clock.seconds["blend"] <= wall


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
    before, seen = signal.getsignal(signal.SIGTERM), []

    def work() -> None:
        with stopping_signals():
            seen.append(signal.getsignal(signal.SIGTERM))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [before]


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
