"""Files that cannot be written are refused before the work whose results they were to hold."""

import errno
import os
from pathlib import Path
from typing import Any

import pytest
from command_runs import refusal
from splats import random_gaussians
from viewed_rooms import STUB

from gsencoder.app import main as cli
from gsencoder.app.commands import export, repair, view
from gsencoder.data.splats.files import save_splat

COMMANDS = {
    "view": (["view", "features"], "page.html"),
    "repair": (["repair", "splat.ply"], "new.ply"),
    "export": (["export", "weights=encoder"], "encoder.onnx"),
}


@pytest.fixture(autouse=True)
def inputs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Inputs, of which that they are read is a fault."""
    save_splat(tmp_path / "splat.ply", random_gaussians(20))
    (tmp_path / "results").mkdir()
    monkeypatch.chdir(tmp_path)

    def work(*_: object, **__: object) -> None:
        raise AssertionError("the work was begun")

    monkeypatch.setattr(view, "load_bundle", lambda: STUB)
    for module, names in {
        view: ("load_features", "load_scene"),
        repair: ("read_raw", "load_scene"),
        export: ("load_memories",),
        export.Encoder: ("load",),
    }.items():
        for name in names:
            monkeypatch.setattr(module, name, work)


@pytest.mark.parametrize("name", COMMANDS)
def test_a_folder_that_takes_no_files(name, tmp_path, monkeypatch, capsys):
    plain, results = os.open, str(tmp_path / "results")

    def read_only(path: Any, flags: int, *options: Any, **more: Any) -> int:
        if flags & os.O_CREAT and os.path.abspath(os.fspath(path)).startswith(results):
            raise OSError(errno.EROFS, os.strerror(errno.EROFS), path)
        return plain(path, flags, *options, **more)

    monkeypatch.setattr(os, "open", read_only)
    words, file = COMMANDS[name]
    line = refusal(capsys, *words, f"out=results/{file}")
    assert line == f"error: results/{file}: cannot write: Read-only file system"
    assert not list((tmp_path / "results").iterdir())


@pytest.mark.parametrize("name", COMMANDS)
def test_a_folder_that_is_missing_and_a_name_that_is_too_long(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    words, file = COMMANDS[name]
    assert "the folder nowhere does not exist; make it first" in refusal(capsys, *words, f"out=nowhere/{file}")
    assert "File name too long" in refusal(capsys, *words, f"out=results/{'x' * 250}{file}")


@pytest.mark.parametrize("name", COMMANDS)
def test_a_file_that_can_be_written_is_left_as_it_was_until_the_results_are_there(name: str, tmp_path: Path) -> None:
    words, file = COMMANDS[name]
    (tmp_path / "results" / file).write_text("earlier")
    with pytest.raises(AssertionError, match="the work was begun"):
        cli.main([*words, f"out=results/{file}", "overwrite=true", "quiet=true"])
    assert [(each.name, each.read_text()) for each in (tmp_path / "results").iterdir()] == [(file, "earlier")]
