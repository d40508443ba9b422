"""Progress bars, and lines where there is no terminal."""

import io

import pytest
from rich.table import Table

from gsencoder.app.run import Progress, console


class Stream(io.StringIO):
    def __init__(self, terminal: bool) -> None:
        super().__init__()
        self.terminal = terminal

    def isatty(self) -> bool:
        return self.terminal


@pytest.mark.parametrize("terminal", [False, True])
@pytest.mark.parametrize("quiet", [False, True])
def test_progress_passes_every_item_on(terminal: bool, quiet: bool) -> None:
    stream = Stream(terminal)
    track = Progress(quiet=quiet, stream=stream, every=0.0)
    pairs = [(a, b) for a in track(range(3), "outer") for b in track(iter("xy"), "inner", total=2)]
    assert pairs == [(a, b) for a in range(3) for b in "xy"]
    assert bool(stream.getvalue()) != quiet
    assert not terminal or quiet or "\x1b" in stream.getvalue()


def test_progress_off_a_terminal_is_a_line_now_and_then() -> None:
    stream = Stream(terminal=False)
    assert list(Progress(stream=stream, every=0.0)(range(3), "views")) == [0, 1, 2]
    assert stream.getvalue().splitlines()[0] == "views: 1/3 after 0 s"
    assert "\x1b" not in stream.getvalue()
    silent = Stream(terminal=False)
    assert list(Progress(stream=silent)(range(1000), "views")) == list(range(1000))
    assert silent.getvalue() == ""


def test_a_loop_left_early_puts_the_bar_away() -> None:
    stream = Stream(terminal=True)
    track = Progress(stream=stream)
    for item in track(range(3), "views"):
        if item == 1:
            break
    assert track._depth == 0
    assert list(track(range(2), "again")) == [0, 1]


def test_control_characters_of_names_are_not_printed(capsys: pytest.CaptureFixture[str]) -> None:
    name = "a\x1b[2J\x07\x9b31m\u202eb"
    table = Table("method", title=name)
    table.add_row(name)
    console().print(f"{name}: written")
    console().print(table)
    printed = capsys.readouterr().out
    assert not {"\x1b", "\x07", "\x9b", "\u202e"} & set(printed)
    assert printed.count("a\N{REPLACEMENT CHARACTER}[2J") == 3
    console().print("Grün [red] 中\n\tb")
    assert "Grün [red] 中\n" in capsys.readouterr().out
