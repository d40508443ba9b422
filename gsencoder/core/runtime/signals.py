"""Signals that end a process: raised as exceptions, remembered until these have ended the command, and deferred over
blocks that must not be interrupted."""

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

SIGNALS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP", "SIGINT") if hasattr(signal, name))
"""Signals with which a user, a shell or a cluster ends a process."""


class Stopped(BaseException):
    """The process received a signal to end; raised where it was running, so that half-written output is removed."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


class Interrupted(KeyboardInterrupt):
    """Ctrl-C. A class of its own, since `python -m` ends by SIGINT in place of its exit code if a `KeyboardInterrupt`
    proper has left an `exec`, such as dataclasses run when they are made, even though it was caught."""


def stop_of(error: BaseException) -> Stopped | KeyboardInterrupt | None:
    """The signal or interrupt behind an exception, or None. A signal that arrives within a compiled function leaves it
    wrapped in a `SystemError`, and in one more for each function that had called it."""
    inner: BaseException | None = error
    while isinstance(inner, SystemError):
        inner = inner.__cause__ or inner.__context__
    return inner if isinstance(inner, Stopped | KeyboardInterrupt) else None


_received: int | None = None
"""The last signal that a command received; None where `stopping_signals` is not entered, as in a library."""


@contextmanager
def stopping_signals() -> Iterator[None]:
    """Signals that end the process raise an exception within the block, and are remembered; for the main thread of a
    command, others are left as they are.

    An exception that a handler raises does not always get through: in a destructor, a weakref's callback (the import
    system has one) or a callback of compiled code Python prints and drops it, and libraries have `except:` clauses.
    `raise_dropped_stop` raises it again. Signals that are ignored (nohup) remain so.
    """
    global _received
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(number: int, _: FrameType | None) -> None:
        global _received
        _received = number
        raise _stop(number)

    def report(dropped: Any) -> None:
        if not isinstance(dropped.exc_value, Stopped | KeyboardInterrupt):
            report_before(dropped)

    replaced = {number: signal.getsignal(number) for number in SIGNALS}
    replaced = {
        number: handler
        for number, handler in replaced.items()
        if handler in (signal.SIG_DFL, signal.default_int_handler)
    }
    report_before, sys.unraisablehook = sys.unraisablehook, report
    try:
        for number in replaced:
            signal.signal(number, stop)
        yield
        raise_dropped_stop()
    except Exception as error:
        if _received is None:
            raise
        # What a library, or a line that names its errors, made of the exception.
        stopped = _stop(_received)
        stopped.__notes__ = getattr(error, "__notes__", [])
        raise stopped from error
    finally:
        for number, handler in replaced.items():
            signal.signal(number, handler)
        sys.unraisablehook, _received = report_before, None


def raise_dropped_stop() -> None:
    """Raises the exception of a signal that the command has received, unless it is on its way: commands call this
    between steps, and before results appear.

    Raises:
        Stopped, KeyboardInterrupt: the signal has not ended the command.
    """
    if _received is None or threading.current_thread() is not threading.main_thread():
        return
    handled = sys.exc_info()[1]
    while handled is not None:
        if stop_of(handled) is not None:
            return
        handled = handled.__context__
    raise _stop(_received)


def accept_stop() -> None:
    """Forgets the signal that was received, where it ends what a command does in the usual way."""
    global _received
    _received = None


def _stop(number: int) -> Stopped | KeyboardInterrupt:
    return Interrupted() if number == signal.SIGINT else Stopped(number)


@contextmanager
def defer_signals() -> Iterator[None]:
    """Signals that end the process are handled after the block, so that they do not interrupt it.

    Handlers run in the main thread alone; in other threads nothing is deferred.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before: dict[int, Callable[[int, FrameType | None], Any]] = {}
    deferred: list[tuple[int, FrameType | None]] = []
    block_ended = False

    def defer(number: int, frame: FrameType | None) -> None:
        if block_ended:
            before[number](number, frame)
        else:
            deferred.append((number, frame))

    try:
        for number in SIGNALS:
            handler = signal.getsignal(number)
            if callable(handler):
                before[number] = handler
                signal.signal(number, defer)
        yield
    finally:
        block_ended = True
        for number, handler in before.items():
            signal.signal(number, handler)
        for number, frame in deferred:
            before[number](number, frame)
