"""Names in the settings of `evaluate` that are none are refused before features are computed."""

from pathlib import Path

import pytest
from command_runs import refusal
from named_rooms import write_words

from gsencoder.app.commands import evaluate as evaluate_sources
from gsencoder.data.synthetic import make_room, write_room


@pytest.fixture
def room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A room and its words; that features are computed is a fault here."""
    made = make_room(0, objects=3, views=3, width=60, height=45)
    write_room(made, tmp_path / "room")
    write_words(tmp_path / "words.safetensors", made)

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("features are computed")

    monkeypatch.setattr(evaluate_sources, "fusion_source", lambda *_, **__: refuse)
    return tmp_path


def refused(capsys: pytest.CaptureFixture[str], room: Path, *options: str) -> str:
    words = f"teacher.words={room / 'words.safetensors'}"
    return refusal(capsys, "evaluate", str(room / "room"), words, f"out={room / 'out'}", *options)


def test_a_class_that_the_words_do_not_know(room: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (room / "classes.csv").write_text("id,name\n1,wall\n2,xylophone\n")
    for protocol in ("semantics", "instances", "recognition"):
        line = refused(capsys, room, f"protocol={protocol}", f"classes={room / 'classes.csv'}")
        assert "xylophone" in line
        assert "give words that know all classes, or the classes that they know as classes=FILE" in line


def test_a_word_that_may_be_absent_and_that_no_table_knows(room: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = refused(capsys, room, "protocol=absent", "protocol.vocabulary=[wall,xylophone]")
    assert "error: protocol.vocabulary: not among the " in line
    assert "xylophone" in line


def test_sentences_about_other_scenes_alone(room: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (room / "ScanRefer.json").write_text(
        '[{"scene_id": "scene0000_00", "object_id": "1", "object_name": "bed", "ann_id": "0", "description": "a bed", '
        '"token": ["a", "bed"]}]'
    )
    line = refused(capsys, room, "protocol=referring", f"protocol.expressions={room / 'ScanRefer.json'}")
    assert "none of the 1 sentences of " in line
    assert "is about a scene that is evaluated (room); first scene0000_00" in line


def test_two_scenes_of_one_name(room: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = make_room(1, objects=3, views=3, width=60, height=45)
    write_room(made, room / "other" / "room")
    for protocol in ("semantics", "localization"):
        line = refused(capsys, room, str(room / "other" / "room"), f"protocol={protocol}")
        assert "are both called 'room'" in line
