"""Signals whose exception Python or a library drops: they end the command all the same, and no output appears."""

import os
import signal
import weakref
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from gsencoder.app import main as cli
from gsencoder.app.commands import inspect
from gsencoder.app.output import output_folder
from gsencoder.app.progress import Progress
from gsencoder.app.summary import Summary
from gsencoder.core.errors import InputError

pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals")
CODES = {signal.SIGINT: (130, "interrupted\n"), signal.SIGTERM: (143, "stopped: SIGTERM\n")}


@pytest.fixture(params=CODES, ids=lambda number: number.name, autouse=True)
def number(request: pytest.FixtureRequest) -> Iterator[signal.Signals]:
    """A signal, with the handlers that a process begins with."""
    before = {
        signal.SIGINT: signal.signal(signal.SIGINT, signal.default_int_handler),
        signal.SIGTERM: signal.signal(signal.SIGTERM, signal.SIG_DFL),
    }
    yield request.param
    for each, handler in before.items():
        signal.signal(each, handler)


def in_destructor(interrupt: Callable[[], None]) -> None:
    class Subject:
        def __del__(self) -> None:
            interrupt()

    Subject()


def in_callback(interrupt: Callable[[], None]) -> None:
    class Subject:
        pass

    subject = Subject()
    watch = weakref.ref(subject, lambda _: interrupt())
    del subject
    assert watch() is None


def in_clause(interrupt: Callable[[], None]) -> None:
    with suppress(BaseException):
        interrupt()


def in_named_error(interrupt: Callable[[], None]) -> None:
    try:
        interrupt()
    except BaseException as stop:
        error = SystemError("<function> returned a result with an exception set")
        error.__cause__ = stop
        raise InputError("the model cannot be run") from error


@pytest.mark.parametrize("drop", [in_destructor, in_callback, in_clause, in_named_error])
@pytest.mark.parametrize("moment", ["loop", "step", "end"])
def test_a_dropped_stop_ends_the_command_and_no_output_appears(
    tmp_path: Path,
    number: signal.Signals,
    drop: Callable[[Callable[[], None]], None],
    moment: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    sent = []

    def interrupt() -> None:
        sent.append(number)
        os.kill(os.getpid(), number)

    def run(config: Any, summary: Summary) -> None:
        with output_folder(config.out, summary=summary) as folder:
            (folder / "half").write_text("x")
            if moment == "loop":
                for _ in Progress(quiet=config.quiet)(range(3), "numbers"):
                    drop(interrupt)
            elif moment == "step":
                with summary.step("work"):
                    drop(interrupt)
                raise AssertionError("the command went on")
            else:
                drop(interrupt)

    monkeypatch.setattr(inspect, "run", run)
    code, line = CODES[number]
    assert cli.main(["inspect", "a", f"out={tmp_path / 'out'}"]) == code
    assert capsys.readouterr().err == line
    assert sent == [number]
    assert list(tmp_path.iterdir()) == []
    # Nothing of it is left in the process.
    assert cli.main(["--version"]) == 0
