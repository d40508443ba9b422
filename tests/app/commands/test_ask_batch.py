"""`gsencoder ask questions=`: answers are written as they come, and a run that ended early goes on."""

import errno
import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from asked_rooms import ORIGIN, ask, save_room
from chat_server import Handler, answer, serving

from gsencoder.core.errors import InputError
from gsencoder.fusion.folder import load_features
from gsencoder.infer.ask import ask as ask_module
from gsencoder.infer.ask.ask import Asker, Question
from gsencoder.infer.ask.questions import read_answers, read_questions
from gsencoder.infer.views.pictures import view_pictures
from gsencoder.infer.views.targets import ViewsConfig
from gsencoder.text.table import WORDS_FILE, load_text_table

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("vlm_environment")]

pytest.importorskip("openai")


def batch(path: Path, *rows: Any) -> Path:
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    return path


def test_a_batch_that_a_fault_ends_keeps_its_answers_and_goes_on(features, tmp_path, capsys):
    file = batch(
        tmp_path / "q.jsonl",
        {"id": "a", "question": "Where is the cube?"},
        {"question": "Which one?", "task": "ground", "query": "crate"},
        {"id": 7, "question": "Is it the cube?", "query": ["cube"]},
    )
    count: list[str] = []

    def fails_at_the_third(handler: Handler, body: Any) -> None:
        count.append(body["messages"][0]["content"][-1]["text"])
        if len(count) == 3:
            handler.reply(500, {"error": {"message": "fell over"}})
        else:
            answer(str(len(count)))(handler, body)

    out = tmp_path / "answers"
    with serving(fails_at_the_third) as server:
        words = (f"questions={file}", f"vlm.base_url={server.url}")
        assert ask(features, out, *words) == 2
        output = capsys.readouterr().err
        assert "question 7: the server" in output
        assert "fell over" in output
        assert "2 of 3 answers are kept in" in output
        assert not out.exists()
        answers = read_answers(tmp_path / "answers.answers" / "answers.jsonl")
        assert [row["answer"] for row in answers.values()] == ["1", "2"]
        # A line that was cut off is asked again.
        with (tmp_path / "answers.answers" / "answers.jsonl").open("ab") as stream:
            stream.write(b'{"id": "7", "answ')
        assert ask(features, out, *words) == 0
    assert len(count) == 4
    rows = [json.loads(line) for line in (out / "answers.jsonl").read_text().splitlines()]
    assert [(row["id"], row["answer"]) for row in rows] == [("a", "1"), ("2", "2"), ("7", "4")]
    assert rows[1]["mark"] == 2
    for row in rows:
        sent = json.loads((out / row["folder"] / "request.json").read_text())
        assert sent["messages"][0]["content"][-1]["text"].endswith(row["question"])
    assert not (tmp_path / "answers.answers").exists()


def crate_refused(handler: Handler, body: Any) -> None:
    text = body["messages"][0]["content"][-1]["text"]
    if "crate" in text:
        handler.reply(400, {"error": {"message": "no crates"}})
    else:
        answer("about " + text.rpartition("Question: ")[2])(handler, body)


def test_a_question_that_is_refused_keeps_no_other_from_its_answer(features, tmp_path, capsys):
    cube, crate, wall = ({"id": name, "question": f"Where is the {name}?"} for name in ("cube", "crate", "wall"))
    lost = {"id": "lost", "task": "ground", "question": "the far one"}
    file, out = tmp_path / "q.jsonl", tmp_path / "out"
    with serving(crate_refused) as server:
        words = (f"questions={file}", f"vlm.base_url={server.url}")
        batch(file, cube, crate, lost, wall)
        assert ask(features, out, *words) == 2
        output = capsys.readouterr().err
        assert "2 of 4 questions have no answer: question crate: the server" in output
        assert "no crates" in output
        assert len(server.requests) == 3
        # The file is mended and its lines change places: nothing is asked twice, nothing takes another's folder.
        server.behave = answer("now it is fine")
        batch(file, wall, crate, cube)
        assert ask(features, out, *words) == 0
        assert len(server.requests) == 4
    rows = [json.loads(line) for line in (out / "answers.jsonl").read_text().splitlines()]
    assert [row["id"] for row in rows] == ["wall", "crate", "cube"]
    assert [row["answer"] for row in rows] == ["about Where is the wall?", "now it is fine", "about Where is the cube?"]
    assert [row["folder"] for row in rows] == ["00001", "00002", "00003"]
    for row in rows:
        assert f"the {row['id']}?" in (out / row["folder"] / "prompt.txt").read_text()
        stored = json.loads((out / row["folder"] / "answer.json").read_text())
        assert stored["answer"] == row["answer"]


def test_an_answer_that_was_begun_with_other_settings_leaves_nothing_behind(features: Path, tmp_path: Path) -> None:
    out = tmp_path / "o"
    file = batch(tmp_path / "q.jsonl", {"question": "Where is the cube?"}, {"question": "the crate"})
    with serving(crate_refused) as server:
        words = (f"questions={file}", f"vlm.base_url={server.url}")
        assert ask(features, out, *words, "choose.width=320") == 2
    assert len(server.requests) == 2
    assert ask(features, out, *words, "dry_run=true") == 0
    for folder in ("00001", "00002"):
        names = {path.name for path in (out / folder).iterdir()}
        assert names == {"prompt.txt", "request.json", "sheet.png", "view_00.png", "view_01.png"}


def test_features_that_were_replaced_are_asked_anew(features: Path, tmp_path: Path) -> None:
    file = batch(tmp_path / "q.jsonl", {"question": "Where is the cube?"}, {"question": "Where is the crate?"})
    folder = tmp_path / "features"
    save_room(folder, step=0.12)
    with serving(crate_refused) as server:
        words = (f"questions={file}", f"vlm.base_url={server.url}")
        assert ask(folder, tmp_path / "out", *words) == 2
        server.behave = answer("x")
        shutil.rmtree(folder)
        save_room(folder, shift=(0.4, 0, 0), step=0.12)
        assert ask(folder, tmp_path / "out", *words) == 0
        assert len(server.requests) == 4
        # The same room in another place is the same scene.
        assert ask(folder, tmp_path / "out", *words, "overwrite=true") == 0


def test_warnings_of_a_batch_name_the_question(features, tmp_path, capsys):
    file = batch(tmp_path / "q.jsonl", {"id": "a", "question": "How large?"}, {"id": "b", "question": "How high?"})
    assert ask(features, tmp_path / "out", f"questions={file}", "dry_run=true") == 0
    output = capsys.readouterr().err
    for name in ("a", "b"):
        assert f"warning: question {name}: the question names nothing to look for" in output
    rows = [json.loads(line) for line in (tmp_path / "out" / "answers.jsonl").read_text().splitlines()]
    assert all("names nothing to look for" in row["warnings"][0] for row in rows)


def test_pictures_are_rendered_once_for_questions_about_one_thing(features, monkeypatch):
    rendered: list[int] = []

    def counted(*arguments: Any, **named: Any) -> Any:
        rendered.append(1)
        return view_pictures(*arguments, **named)

    monkeypatch.setattr(ask_module, "view_pictures", counted)
    monkeypatch.setattr(ask_module, "MAX_KEPT", kept := 3)
    config = ViewsConfig(source="frames", candidates=4, count=2)
    asker = Asker(load_features(features), load_text_table(features / WORDS_FILE), views=config)
    first, second = (asker.prompt(Question(text=text)) for text in ("Where is the cube?", "Is the cube red?"))
    assert first.pictures is second.pictures
    assert len(rendered) == 1
    marked = asker.prompt(Question(text="the left cube", task="ground"))
    assert len(rendered) == 2
    assert marked.marks == {1}
    for number in range(kept):
        low = ORIGIN + np.array([0.1, 0.0, 0.6 - 0.001 * number])
        asker.prompt(Question(text="What?", aabb=(*low.tolist(), *(ORIGIN + np.array([0.5, 0.4, 1.0])).tolist())))
    assert len(asker._kept) == kept
    asker.prompt(Question(text="Where is the cube?"))
    assert len(rendered) == 3 + kept


def test_lines_take_the_task_of_the_command_unless_they_name_one(tmp_path: Path) -> None:
    file = batch(tmp_path / "q.jsonl", {"question": "a"}, {"question": "b", "task": "answer"})
    assert [each.question.task for each in read_questions(file, "ground")] == ["ground", "answer"]
    (tmp_path / "q.jsonl").write_text('{"question": "a\u2028b\u0085c"}\r\n')
    assert read_questions(file)[0].question.text == "a\u2028b\u0085c"


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"", "holds none"),
        (b"hello\n", "line 1: is no JSON"),
        (b"[1]\n", "line 1: expected an object"),
        (b'{"question": "a"}\n{"quetsion": "b"}\n', "line 2: quetsion: no such field"),
        (b'{"id": "1", "question": "a"}\n{"id": 1, "question": "b"}\n', "line 2: id '1' comes twice"),
        (b'{"question": 5}\n', "line 1: question: expected text"),
        (b'{"question": "a", "query": [""]}\n', "line 1: query: expected a word"),
        (b'{"question": "a", "task": "sing"}\n', "line 1: task: expected one of answer, ground, caption"),
        (b'{"question": "a", "aabb": [true]}\n', "line 1: aabb: expected six numbers"),
        (b'{"question": "a", "aabb": [0, 0, 0, 1, 1, 1' + b"0" * 400 + b"]}\n", "line 1: aabb: expected six numbers"),
        (b'{"id": "z"}\n', "line 1: question= is missing"),
        (b'{"question": "a \\ud800"}\n', "line 1: question: holds what is no character"),
        (b'{"question": "a", "id": null}\n', "line 1: id: expected text"),
        (b"\xff\xfe\n", "not a text file"),
        (b"\x80\x04]", "is a pickle, which is refused since reading it can run code"),
    ],
)
def test_files_of_questions_that_are_wrong_say_where(tmp_path, content, problem, no_jaxtyping):
    (tmp_path / "q.jsonl").write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_questions(tmp_path / "q.jsonl")
    assert problem in str(caught.value)
    with pytest.raises(InputError, match="no such file"):
        read_questions(tmp_path / "other.jsonl")


def test_a_file_that_cannot_be_written_ends_a_set_and_counts_for_no_question(features, tmp_path, monkeypatch, capsys):
    row = {"scene_id": "room", "question_id": "1", "question": "Where is the cube?", "answers": ["here"]}
    (tmp_path / "ScanQA_v1.0_val.json").write_text(json.dumps([row]))
    rename, fault = os.replace, [OSError(errno.EIO, os.strerror(errno.EIO))]

    def fails_once(source: str | Path, target: str | Path) -> None:
        if str(target).endswith("view_00.png") and fault:
            raise fault.pop()
        rename(source, target)

    monkeypatch.setattr(os, "replace", fails_once)
    words = (features, tmp_path / "out", f"questions={tmp_path / 'ScanQA_v1.0_val.json'}", "dry_run=true")
    assert ask(*words) == 2
    assert "view_00.png: cannot write" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert ask(*words) == 0
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["results"]["unanswered"] == {}
