"""Signals that end a process: raised as exceptions, and deferred over blocks that must not be interrupted."""

import signal
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


def stop_of(error: BaseException) -> Stopped | KeyboardInterrupt | None:
    """The signal or interrupt behind an exception, or None. A signal that arrives within a compiled function leaves it
    wrapped in a `SystemError`, and in one more for each function that had called it."""
    inner: BaseException | None = error
    while isinstance(inner, SystemError):
        inner = inner.__cause__ or inner.__context__
    return inner if isinstance(inner, Stopped | KeyboardInterrupt) else None


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
