"""How a process is asked to end: signals are raised as exceptions where it is, or after what must not be cut in two."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

SIGNALS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP", "SIGINT") if hasattr(signal, name))
"""All by which a user, a shell or a cluster asks."""


class Stopped(BaseException):
    """The process was asked to end; raised where it was, so that half-written output is removed."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


def stop_of(error: BaseException) -> Stopped | KeyboardInterrupt | None:
    """What asked the process to end, if that is what an exception is about. A signal that arrives within a compiled
    function comes out of it wrapped in a `SystemError`."""
    inner = error.__cause__ or error.__context__ if isinstance(error, SystemError) else error
    return inner if isinstance(inner, Stopped | KeyboardInterrupt) else None


@contextmanager
def held_back() -> Iterator[None]:
    """Signals that ask the process to end are handled after the block, so that what is in it happens as a whole.

    Handlers run in the main thread alone: in another one nothing needs to be held back.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before: dict[int, Callable[[int, FrameType | None], Any]] = {}
    heard: list[tuple[int, FrameType | None]] = []
    over = False

    def hear(number: int, frame: FrameType | None) -> None:
        if over:
            before[number](number, frame)
        else:
            heard.append((number, frame))

    try:
        for number in SIGNALS:
            handler = signal.getsignal(number)
            if callable(handler):
                before[number] = handler
                signal.signal(number, hear)
        yield
    finally:
        over = True
        for number, handler in before.items():
            signal.signal(number, handler)
        for number, frame in heard:
            before[number](number, frame)
