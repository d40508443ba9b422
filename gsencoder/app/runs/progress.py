"""What a running command shows: bars and lines on standard error, results on standard output.

Functions below the command line know nothing of this. One that loops for long takes an argument
`track: Callable[[Iterable[T], str], Iterable[T]]` and loops over `track(items, "views")`; `Progress` is such a thing.
"""

import sys
import time
from collections.abc import Iterable, Iterator, Sized
from typing import Any, TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bars

T = TypeVar("T")


def console(quiet: bool = False) -> Console:
    """Where commands print results and tables: standard output, no markup, wide where it is not a terminal."""
    width = None if sys.stdout.isatty() else 200
    return Console(file=sys.stdout, quiet=quiet, markup=False, highlight=False, emoji=False, width=width)


class Progress:
    """Shows how far a loop is. On a terminal a bar that vanishes at the end; else a line now and then; or nothing.

    Example:
        track = Progress(quiet=config.quiet)
        for view in track(views, "lifting views"):
            ...
    """

    def __init__(self, *, quiet: bool = False, stream: Any = None, every: float = 10.0) -> None:
        """Args:
        quiet: show nothing.
        stream: the text stream to write to; standard error unless given.
        every: seconds between two lines where the stream is not a terminal; loops shorter than that print nothing.
        """
        self._stream = sys.stderr if stream is None else stream
        self._quiet = quiet
        self._every = every
        self._bars: Bars | None = None
        self._depth = 0

    def __call__(self, items: Iterable[T], label: str, total: int | None = None) -> Iterator[T]:
        """The items, one by one, shown as they are done."""
        if total is None and isinstance(items, Sized):
            total = len(items)
        if self._quiet:
            return iter(items)
        return self._on_terminal(items, label, total) if self._stream.isatty() else self._in_lines(items, label, total)

    def _on_terminal(self, items: Iterable[T], label: str, total: int | None) -> Iterator[T]:
        if self._bars is None:
            columns = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn())
            screen = Console(file=self._stream, markup=False, highlight=False)
            self._bars = Bars(*columns, TimeElapsedColumn(), TimeRemainingColumn(), console=screen, transient=True)
        # Loops inside loops share one display: rich draws one at a time.
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
        of = f"/{total}" if total is not None else ""
        done = 0
        for item in items:
            yield item
            done += 1
            now = time.monotonic()
            if now - last >= self._every:
                last = now
                print(f"{label}: {done}{of} after {now - start:.0f} s", file=self._stream, flush=True)
        if last > start:
            print(f"{label}: {done} done in {time.monotonic() - start:.0f} s", file=self._stream, flush=True)
