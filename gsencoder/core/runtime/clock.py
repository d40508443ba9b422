"""Wall-clock seconds of the steps of a pipeline stage."""

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

_running: ContextVar["Clock | None"] = ContextVar("running_clock", default=None)


class Clock:
    """Adds up the seconds that each step of a stage takes.

    A step is a block, `with clock("lift"): …`, or, between `with clock.running():`, a call of a function that is
    decorated with `@timed("lift")`.

    Attributes:
        seconds: by step, in order of first start.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, step: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[step] = self.seconds.get(step, 0.0) + time.perf_counter() - start

    @contextmanager
    def running(self) -> Iterator["Clock"]:
        """Lets functions decorated with `timed` that this thread calls inside the block count towards this clock."""
        token = _running.set(self)
        try:
            yield self
        finally:
            _running.reset(token)

    def share_out(self, seconds: float, steps: Iterable[Mapping[str, float]]) -> None:
        """Adds seconds of the wall clock in which several threads were at work: each step receives its share of the
        seconds of all threads.

        Args:
            seconds: of the wall clock.
            steps: the seconds of each thread by step, or of each piece of its work.
        """
        of_threads: dict[str, float] = {}
        for each in steps:
            for step, seconds_of_step in each.items():
                of_threads[step] = of_threads.get(step, 0.0) + seconds_of_step
        total = sum(of_threads.values())
        for step, seconds_of_step in of_threads.items():
            self.seconds[step] = self.seconds.get(step, 0.0) + (seconds * seconds_of_step / total if total else 0.0)


def timed(step: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorates a function as one step of a stage: its calls are timed while a clock is running."""

    def mark(function: Callable[P, R]) -> Callable[P, R]:
        @wraps(function)
        def call(*arguments: P.args, **settings: P.kwargs) -> R:
            clock = _running.get()
            if clock is None:
                return function(*arguments, **settings)
            with clock(step):
                return function(*arguments, **settings)

        return call

    return mark
