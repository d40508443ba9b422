"""Files that cannot be written are refused before the work whose results they were to hold."""

import errno
import os
from pathlib import Path
from typing import Any

import pytest
from command_runs import refusal
from named_rooms import write_words
from splats import random_gaussians
from viewed_rooms import STUB

from gsencoder.app import main as cli
from gsencoder.app.commands import evaluate, export, repair, view
from gsencoder.data.splats.files import save_splat
from gsencoder.data.synthetic import make_room, write_room

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


# Names in the settings of `evaluate` that are none are refused before features are computed


@pytest.fixture
def evaluated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A room and its words; that features are computed is a fault here."""
    made = make_room(0, objects=3, views=3, width=60, height=45)
    write_room(made, tmp_path / "room")
    write_words(tmp_path / "words.safetensors", made)

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("features are computed")

    monkeypatch.setattr(evaluate, "fusion_source", lambda *_, **__: refuse)
    return tmp_path


def refused(capsys: pytest.CaptureFixture[str], evaluated: Path, *options: str) -> str:
    words = f"teacher.words={evaluated / 'words.safetensors'}"
    return refusal(capsys, "evaluate", str(evaluated / "room"), words, f"out={evaluated / 'out'}", *options)


def test_a_class_that_the_words_do_not_know(evaluated: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (evaluated / "classes.csv").write_text("id,name\n1,wall\n2,xylophone\n")
    for protocol in ("semantics", "instances", "recognition"):
        line = refused(capsys, evaluated, f"protocol={protocol}", f"classes={evaluated / 'classes.csv'}")
        assert "xylophone" in line
        assert "give words that know all classes, or the classes that they know as classes=FILE" in line


def test_a_word_that_may_be_absent_and_that_no_table_knows(evaluated: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = refused(capsys, evaluated, "protocol=absent", "protocol.vocabulary=[wall,xylophone]")
    assert "error: protocol.vocabulary: not among the " in line
    assert "xylophone" in line


def test_sentences_about_other_scenes_alone(evaluated: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (evaluated / "ScanRefer.json").write_text(
        '[{"scene_id": "scene0000_00", "object_id": "1", "object_name": "bed", "ann_id": "0", "description": "a bed", '
        '"token": ["a", "bed"]}]'
    )
    line = refused(capsys, evaluated, "protocol=referring", f"protocol.expressions={evaluated / 'ScanRefer.json'}")
    assert "none of the 1 sentences of " in line
    assert "is about a scene that is evaluated (room); first scene0000_00" in line


def test_two_scenes_of_one_name(evaluated: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = make_room(1, objects=3, views=3, width=60, height=45)
    write_room(made, evaluated / "other" / "room")
    for protocol in ("semantics", "localization"):
        line = refused(capsys, evaluated, str(evaluated / "other" / "room"), f"protocol={protocol}")
        assert "are both called 'room'" in line
