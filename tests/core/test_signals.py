"""Signals: raised where the process is, or after what must not be cut in two."""

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress

import pytest

from gsencoder.core.process import (
    SIGNALS,
    Stopped,
    accept_stop,
    defer_signals,
    raise_dropped_stop,
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


def interrupt(number: int = signal.SIGTERM) -> None:
    """Sends a signal and drops what its handler raises, as a library may."""
    with suppress(Stopped, KeyboardInterrupt):
        os.kill(os.getpid(), number)


def test_a_dropped_stop_is_raised_again_each_time_it_is_asked_for_and_at_the_end() -> None:
    before, hook = {number: signal.getsignal(number) for number in SIGNALS}, sys.unraisablehook
    raised = []

    def work() -> None:
        raise_dropped_stop()
        interrupt()
        for _ in range(2):
            try:
                raise_dropped_stop()
            except Stopped as stop:
                raised.append(stop.number)

    with pytest.raises(Stopped), stopping_signals():
        work()
    assert raised == [signal.SIGTERM] * 2
    assert {number: signal.getsignal(number) for number in SIGNALS} == before
    assert sys.unraisablehook is hook
    raise_dropped_stop()


def test_other_errors_that_python_drops_are_still_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    class Subject:
        def __del__(self) -> None:
            raise ValueError("of something else")

    reported = []
    monkeypatch.setattr(sys, "unraisablehook", lambda dropped: reported.append(str(dropped.exc_value)))
    with stopping_signals():
        Subject()
    assert reported == ["of something else"]


@pytest.mark.parametrize("wrapped", [False, True])
def test_a_stop_that_is_being_handled_is_not_raised_again(wrapped: bool) -> None:
    stop, cleaned = Stopped(signal.SIGTERM), []
    error = SystemError("<function> returned a result with an exception set")
    error.__cause__ = stop

    def work() -> None:
        interrupt()
        try:
            raise error if wrapped else stop
        finally:
            raise_dropped_stop()
            cleaned.append("all of it")

    with pytest.raises(Stopped) as raised, stopping_signals():
        work()
    assert cleaned == ["all of it"]
    assert (raised.value is stop) != wrapped


def test_a_dropped_stop_is_raised_while_another_error_is_handled() -> None:
    after = []

    def work() -> None:
        interrupt()
        try:
            raise OSError("of something else")
        except OSError:
            raise_dropped_stop()
            after.append("went on")

    with pytest.raises(Stopped), stopping_signals():
        work()
    assert after == []


def test_an_error_that_was_made_of_a_stop_is_its_cause_and_gives_it_its_notes() -> None:
    error = ValueError("the model cannot be run")
    error.add_note("a folder is left behind")

    def work() -> None:
        interrupt()
        raise error

    with pytest.raises(Stopped) as stop, stopping_signals():
        work()
    assert stop.value.__cause__ is error
    assert stop.value.__notes__ == ["a folder is left behind"]


def test_a_dropped_stop_is_raised_in_the_main_thread_alone() -> None:
    raised = []

    def elsewhere() -> None:
        try:
            raise_dropped_stop()
        except Stopped as stop:
            raised.append(stop)

    def work() -> None:
        interrupt()
        thread = threading.Thread(target=elsewhere)
        thread.start()
        thread.join()

    with pytest.raises(Stopped), stopping_signals():
        work()
    assert raised == []


@pytest.mark.usefixtures("interrupts")
def test_a_second_signal_is_raised_where_the_first_is_being_handled_and_the_first_is_not_raised_twice() -> None:
    cleaned = []

    def work() -> None:
        try:
            os.kill(os.getpid(), signal.SIGTERM)
        finally:
            try:
                raise OSError("in the cleanup")
            except OSError:
                raise_dropped_stop()
            cleaned.append("first")
            try:
                os.kill(os.getpid(), signal.SIGINT)
            except KeyboardInterrupt:
                cleaned.append("second")

    with pytest.raises(Stopped), stopping_signals():
        work()
    assert cleaned == ["first", "second"]


def test_a_stop_that_was_accepted_is_over() -> None:
    with stopping_signals():
        interrupt(signal.SIGINT)
        accept_stop()
        raise_dropped_stop()


def test_a_library_has_the_handlers_of_its_program_and_nothing_is_remembered() -> None:
    received = []
    before = signal.signal(signal.SIGINT, lambda number, _: received.append(number))
    try:
        os.kill(os.getpid(), signal.SIGINT)
        raise_dropped_stop()
        with stopping_signals():
            os.kill(os.getpid(), signal.SIGINT)
            raise_dropped_stop()
    finally:
        signal.signal(signal.SIGINT, before)
    assert received == [signal.SIGINT] * 2


def test_in_another_thread_nothing_is_installed() -> None:
    before, seen = signal.getsignal(signal.SIGTERM), []

    def work() -> None:
        with stopping_signals():
            seen.append(signal.getsignal(signal.SIGTERM))
            raise_dropped_stop()

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [before]
