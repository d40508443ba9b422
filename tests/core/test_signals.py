"""Signals: raised where the process is, or after what must not be cut in two."""

import os
import signal
import threading
from collections.abc import Iterator

import pytest

from gsencoder.core.process import (
    SIGNALS,
    Stopped,
    defer_signals,
    stop_of,
    stopping_signals,
)

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


def test_blocks_within_blocks_end_with_the_outer_one(number: int) -> None:
    done = []

    def work() -> None:
        with defer_signals():
            with defer_signals():
                os.kill(os.getpid(), number)
            done.append("outer")

    with pytest.raises(Stopped):
        work()
    assert done == ["outer"]


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


def test_a_handler_that_was_taken_out_of_a_block_leads_to_the_one_before_it(number: int) -> None:
    with defer_signals():
        taken = signal.getsignal(number)
    assert callable(taken)
    with pytest.raises(Stopped):
        taken(number, None)


def test_other_threads_need_nothing() -> None:
    done = []

    def work() -> None:
        with defer_signals():
            done.append(1)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert done == [1]


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
