"""The code in docs/commands.md does what the page says: an option is one field, a command a module and one line."""

import json
import re
import shlex
import sys
from collections.abc import Iterator
from dataclasses import fields, make_dataclass
from pathlib import Path
from types import ModuleType

import pytest
from splats import random_gaussians

from gsencoder.app import main as cli
from gsencoder.app.compose import compose
from gsencoder.app.main import COMMANDS, Command
from gsencoder.app.options import CommonConfig
from gsencoder.data.splats.files import save_splat

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "commands.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)


OPTION, MODULE, LINE = blocks("python")
(SHELL,) = blocks("sh")


@pytest.fixture
def opaque(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Path]:
    """A folder with a splat; the page's command is registered."""
    name = "gsencoder.app.commands.opaque"
    module = ModuleType(name)
    monkeypatch.setitem(sys.modules, name, module)
    exec(compile(MODULE, name, "exec"), module.__dict__)
    monkeypatch.setitem(COMMANDS, "opaque", eval(LINE, {"Command": Command}))
    monkeypatch.chdir(tmp_path)
    save_splat(tmp_path / "room.ply", random_gaussians(50))
    return tmp_path


def test_the_option_of_the_page_is_one_field_of_a_settings_class() -> None:
    scope: dict[str, object] = {}
    exec(f"from gsencoder.core.settings import option\n{OPTION}", scope)
    cls = make_dataclass("Toy", [("views", int, scope["views"])], bases=(CommonConfig,), frozen=True, kw_only=True)
    assert [item.name for item in fields(cls)] == ["out", "overwrite", "preset", "quiet", "views"]
    assert compose("toy", cls, ["views=3"]) == cls(views=3)


@pytest.mark.slow
def test_the_command_of_the_page_runs_as_it_says(opaque: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for line in SHELL.splitlines():
        program, *words = shlex.split(line)
        assert program == "gsencoder"
        assert cli.main(words) == 0, line
    out = capsys.readouterr().out
    assert "smallest opacity that counts as opaque [0.5]" in out
    opacities = random_gaussians(50).opacities
    assert json.loads((opaque / "counts" / "opaque.json").read_text()) == {"room.ply": int((opacities >= 0.9).sum())}
    records = [json.loads((opaque / "many" / str(k) / "summary.json").read_text()) for k in range(3)]
    assert [record["results"]["opaque"] for record in records] == [(opacities >= low).sum() for low in (0.1, 0.5, 0.9)]


def test_the_command_of_the_page_refuses_what_it_says(opaque: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["opaque", "room.ply", "min_opacity=2"]) == 2
    assert capsys.readouterr().err == "error: min_opacity: expected 0 to 1, got 2.0\n"
    assert cli.main(["opaque"]) == 2
    assert capsys.readouterr().err == "error: SPLAT is missing: splat files\n"
