"""Progress bars on standard error, and the console for results on standard output.

Stages do not import this module. A function with a long loop has an argument
`track: Callable[[Iterable[T], str], Iterable[T]]` and loops over `track(items, "views")`; `Progress` is one.
"""

import sys
import time
from collections.abc import Iterable, Iterator, Sized
from typing import Any, TypeVar

from rich.console import Console, ConsoleOptions, RenderableType
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bars
from rich.segment import Segment

from gsencoder.core.errors import printable
from gsencoder.core.process import raise_dropped_stop

T = TypeVar("T")


class Screen(Console):
    """A console that prints no control characters of the text that it is given: file names and texts of users."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterator[Segment]:
        for text, style, control in super().render(renderable, options):
            yield Segment(text if control else printable(text), style, control)


def console(quiet: bool = False) -> Console:
    """The console for results and tables: standard output without markup, 200 columns wide if it is not a terminal."""
    width = None if sys.stdout.isatty() else 200
    return Screen(file=sys.stdout, quiet=quiet, markup=False, highlight=False, emoji=False, width=width)


class Progress:
    """Shows the progress of loops: a transient bar on a terminal, else a line every few seconds.

    Example:
        track = Progress(quiet=config.quiet)
        for view in track(views, "lifting views"):
            ...
    """

    def __init__(self, *, quiet: bool = False, stream: Any = None, every: float = 10.0) -> None:
        """Args:
        stream: the text stream to write to; None = standard error.
        every: seconds between lines if the stream is not a terminal; shorter loops print nothing.
        """
        self._stream = sys.stderr if stream is None else stream
        self._quiet = quiet
        self._every = every
        self._bars: Bars | None = None
        self._depth = 0

    def __call__(self, items: Iterable[T], label: str, total: int | None = None) -> Iterator[T]:
        """Yields the items and shows how many are done."""
        if total is None and isinstance(items, Sized):
            total = len(items)
        items = _interruptible(items)
        if self._quiet:
            return items
        return self._on_terminal(items, label, total) if self._stream.isatty() else self._in_lines(items, label, total)

    def _on_terminal(self, items: Iterable[T], label: str, total: int | None) -> Iterator[T]:
        if self._bars is None:
            columns = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn())
            screen = Screen(file=self._stream, markup=False, highlight=False)
            self._bars = Bars(*columns, TimeElapsedColumn(), TimeRemainingColumn(), console=screen, transient=True)
        # Nested loops share one display, since rich draws one at a time.
        if self._depth == 0:
            self._bars.start()
        self._depth += 1
        task = self._bars.add_task(label, total=total)
        try:
            for item in items:
                yield item
                self._bars.advance(task)
        finally:
            self._bars.remove_task(task)
            self._depth -= 1
            if self._depth == 0:
                self._bars.stop()

    def _in_lines(self, items: Iterable[T], label: str, total: int | None) -> Iterator[T]:
        start = last = time.monotonic()
        of, label = f"/{total}" if total is not None else "", printable(label)
        count = 0
        for item in items:
            yield item
            count += 1
            now = time.monotonic()
            if now - last >= self._every:
                last = now
                print(f"{label}: {count}{of} after {now - start:.0f} s", file=self._stream, flush=True)
        if last > start:
            print(f"{label}: {count} done in {time.monotonic() - start:.0f} s", file=self._stream, flush=True)


def _interruptible(items: Iterable[T]) -> Iterator[T]:
    """Yields the items; between them a signal that was dropped is raised again."""
    for item in items:
        yield item
        raise_dropped_stop()
