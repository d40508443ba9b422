"""A command without a purpose, for tests of the command line."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from toy_commands import ToyConfig, write_toy

from gsencoder.app.main import COMMANDS, Command
from gsencoder.app.options import CommonConfig


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[Any, Any], None]], None]:
    """Makes `gsencoder toy` run the given function."""

    def install(run: Callable[[Any, Any], None]) -> None:
        @dataclass(frozen=True, slots=True, kw_only=True)
        class Toy(Command):
            def load(self) -> tuple[type[CommonConfig], Callable[[Any, Any], None]]:
                return ToyConfig, run

        monkeypatch.setitem(COMMANDS, "toy", Toy(name="toy", config="ToyConfig", help="a toy"))

    install(write_toy)
    return install


@pytest.fixture(scope="session")
def conf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one preset, of the toy's teacher."""
    folder = tmp_path_factory.mktemp("conf")
    (folder / "teacher").mkdir()
    (folder / "teacher" / "dinov2.yaml").write_text("defaults:\n  - onnx\n  - _self_\nweights: dinov2.onnx\n")
    return folder
