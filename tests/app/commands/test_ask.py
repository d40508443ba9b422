"""`gsencoder ask`: what is sent, what is kept, and a real server."""

import base64
import errno
import io
import json
import os
import shutil
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from asked_rooms import ORIGIN, save_room
from chat_server import Handler, answer, serving
from PIL import Image
from tiny_vlm import save_tiny_vlm

from gsencoder.app import cli
from gsencoder.app.runs.printable import printable
from gsencoder.core.errors import InputError
from gsencoder.fusion.store.folder import WORDS_FILE, load_features
from gsencoder.infer.ask import ask as ask_module
from gsencoder.infer.ask.ask import MAX_CACHED_PICTURES, Asker, Question
from gsencoder.infer.ask.question_words import WordRules, words_in
from gsencoder.infer.ask.questions import read_answers, read_questions
from gsencoder.infer.views.pictures import view_pictures
from gsencoder.infer.views.selection import ViewsConfig
from gsencoder.text.table import load_text_table, make_text_table

pytestmark = pytest.mark.slow

pytest.importorskip("openai")

QUICK = ("choose.source=frames", "choose.candidates=4", "choose.count=2", "quiet=true")
KEY = "sk-never-to-be-written"


@pytest.fixture(scope="module")
def features(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("room") / "features"
    save_room(folder)
    return folder


@pytest.fixture(autouse=True)
def environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENAI_API_KEY", KEY)
    monkeypatch.setenv("GSENCODER_VLM_MODEL", "tiny")
    monkeypatch.delenv("OPENAI_BASE_URL", raising=False)


def ask(features: Path, out: Path, *words: str) -> int:
    return cli.main(["ask", str(features), f"out={out}", "vlm.retries=0", *QUICK, *words])


def test_a_question_is_answered_from_views_of_what_it_names(features: Path, tmp_path: Path) -> None:
    out = tmp_path / "answer"
    with serving(answer("On the left.")) as server:
        assert ask(features, out, "question=Where is the cube?", f"vlm.base_url={server.url}") == 0
        ((_, sent),) = server.requests
    row = json.loads((out / "answer.json").read_text())
    assert (row["answer"], row["model"], row["finish"]) == ("On the left.", "tiny", "stop")
    assert row["words"] == ["cube"]
    assert json.loads((out / "request.json").read_text()) == sent
    assert (out / "prompt.txt").read_text().strip() == sent["messages"][0]["content"][-1]["text"]
    for view, part in zip(row["views"], sent["messages"][0]["content"][:-1], strict=True):
        picture = Image.open(io.BytesIO(base64.b64decode(part["image_url"]["url"].partition(",")[2])))
        with Image.open(out / view["picture"]) as written:
            assert picture.size == written.size == (view["width"], view["height"])
    everything = b"".join(path.read_bytes() for path in out.rglob("*") if path.is_file())
    assert KEY.encode() not in everything


def test_a_key_of_the_command_line_is_written_nowhere(
    features: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with serving(answer("fine")) as server:
        words = ("question=What is the cube?", f"vlm.base_url={server.url}", "vlm.key=sk-of-the-line")
        assert ask(features, tmp_path / "answer", *words) == 0
        assert server.requests[0][0]["authorization"] == "Bearer sk-of-the-line"
        assert cli.main(["ask", str(features), *words, "--cfg"]) == 0
    assert "sk-of-the-line" not in capsys.readouterr().out
    everything = b"".join(path.read_bytes() for path in tmp_path.rglob("*") if path.is_file())
    assert b"sk-of-the-line" not in everything
    assert b"(not shown)" in everything


def test_a_file_that_cannot_be_written_ends_a_set_and_counts_for_no_question(
    features: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
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


def test_a_dry_run_writes_prompt_and_pictures_and_asks_nobody(features: Path, tmp_path: Path) -> None:
    out = tmp_path / "dry"
    assert ask(features, out, "question=the left one", "task=ground", "query=crate", "dry_run=true") == 0
    text = (out / "prompt.txt").read_text()
    assert "1 = crate; 2 = crate." in text
    assert "Meant is: the left one" in text
    assert not (out / "answer.json").exists()
    assert {path.name for path in out.iterdir()} >= {"request.json", "sheet.png", "view_00.png", "summary.json"}


def test_a_tower_is_not_ignored_where_the_file_of_words_was_lost(
    features: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = shutil.copytree(features, tmp_path / "features")
    (folder / "words.safetensors").unlink()
    words = ("question=Where is it?", "dry_run=true", "text=onnx", "text.model=nowhere")
    assert ask(folder, tmp_path / "out", *words) == 2
    assert "text.model: no folder at nowhere" in capsys.readouterr().err


def test_grounding_gives_the_box_of_the_mark_that_is_named(features: Path, tmp_path: Path) -> None:
    with serving(answer("Mark 2.")) as server:
        out = tmp_path / "ground"
        words = ("question=the far one", "query=crate", "task=ground", f"vlm.base_url={server.url}")
        assert ask(features, out, *words) == 0
        row = json.loads((out / "answer.json").read_text())
        assert row["mark"] == 2
        assert row["box"]["query"] == "crate"
        assert row["box"]["rank"] == 1
        server.behave = answer("I cannot tell")
        assert ask(features, out, *words, "overwrite=true") == 0
    row = json.loads((out / "answer.json").read_text())
    assert row["mark"] is None
    assert row["box"] is None
    (warning,) = json.loads((out / "summary.json").read_text())["warnings"]
    assert "does not name one of the 2 marks" in warning


def test_a_caption_is_of_one_box_that_words_or_corners_give(features: Path, tmp_path: Path) -> None:
    with serving(answer("A cube on nothing.")) as server:
        url = f"vlm.base_url={server.url}"
        assert ask(features, tmp_path / "words", "task=caption", "query=crate", url) == 0
        low, high = (ORIGIN + np.array(corner) for corner in ((0.1, 0.0, 0.6), (0.5, 0.4, 1.0)))
        corners = ",".join(map(str, (*low, *high)))
        assert ask(features, tmp_path / "corners", "task=caption", f"aabb=[{corners}]", url) == 0
    (found,) = json.loads((tmp_path / "words" / "answer.json").read_text())["targets"]
    assert (found["query"], found["rank"]) == ("crate", 0)
    (given,) = json.loads((tmp_path / "corners" / "answer.json").read_text())["targets"]
    np.testing.assert_allclose([*given["aabb_min"], *given["aabb_max"]], [*low, *high])
    prompt = (tmp_path / "words" / "prompt.txt").read_text()
    assert "The thing is the crate.\nIt carries the mark 1" in prompt
    assert "The thing is" not in (tmp_path / "corners" / "prompt.txt").read_text()
    assert "It carries the mark 1" in (tmp_path / "corners" / "prompt.txt").read_text()


def test_a_question_that_names_nothing_is_shown_even_frames_and_says_so(features: Path, tmp_path: Path) -> None:
    assert ask(features, tmp_path / "dry", "question=How large is this place?", "dry_run=true") == 0
    summary = json.loads((tmp_path / "dry" / "summary.json").read_text())
    assert any("evenly spread views are shown" in line for line in summary["warnings"])
    assert [view["frame"] for view in summary["results"]["views"]] == [0, 11]
    words = (
        "question=How large is this place?",
        "dry_run=true",
        "choose.source=shells",
        "choose.count=2",
        "quiet=true",
    )
    assert cli.main(["ask", str(features), f"out={tmp_path / 'shells'}", *words]) == 0


def test_words_of_a_question_are_found_with_the_longest_name_first() -> None:
    table = make_text_table(["pen", "pen holder", "mug", "box"], np.eye(4, dtype=np.float32), "t")
    assert words_in("Is the mug's pen-holder near BOXES, or a pen?", table) == ("mug", "pen holder", "box", "pen")
    assert words_in("What is the mug on?", table) == ("mug",)
    assert words_in("A mug-like pen, holder of ink", table) == ("mug", "pen")
    assert words_in("", table) == ()
    assert words_in("How far?", table) == ()


def test_words_that_only_look_like_names_are_not_looked_for() -> None:
    names = [
        "can",
        "chair",
        "orange",
        "watch",
        "table",
        "lamp",
        "table lamp",
        "caf\u00e9",
        "\u0915\u0941\u0930\u094d\u0938\u0940",
        "big red dining room table",
    ]
    table = make_text_table(names, np.eye(len(names), dtype=np.float32), "t")
    for text, words in (
        ("Can you tell me how many chairs there are?", ("chair",)),
        ("Is there a can on the chair?", ("can", "chair")),
        ("Which one can I watch from?", ()),
        ("Whose watch is it?", ("watch",)),
        ("Is there a table, lamp or chair?", ("table", "lamp", "chair")),
        ("Where is the table lamp?", ("table lamp",)),
        ("What is on the orange chair?", ("chair",)),
        ("Is there an orange on the chair?", ("orange", "chair")),
        ("Is it orange? Chair or table?", ("orange", "chair", "table")),
        ("the big red dining room table", ("big red dining room table",)),
        ("a chair\u2019s leg", ("chair",)),
        ("the cafe\u0301", ("caf\u00e9",)),
        ("\u0915\u0941\u0930\u094d\u0938\u0940 ?", ("\u0915\u0941\u0930\u094d\u0938\u0940",)),
    ):
        assert words_in(text, table) == words, text


def test_questions_in_another_language_have_its_words() -> None:
    table = make_text_table(["Stuhl", "Flieder"], np.eye(2, dtype=np.float32), "t")
    german = WordRules(pronouns=frozenset({"ich", "du"}), auxiliaries=frozenset(), colors=frozenset({"flieder"}))
    assert words_in("Wo steht der Flieder Stuhl?", table) == ("Flieder", "Stuhl")
    assert words_in("Wo steht der Flieder Stuhl?", table, german) == ("Stuhl",)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("question=What is the cube?",), "say where the model's server is"),
        (("question=What is the cube?", "vlm.base_url=http://127.0.0.1:9/v1"), "no server answers there"),
        (("dry_run=true",), "question= is missing"),
        (("question=x", "task=ground", "dry_run=true"), "names nothing to look for; give query= or aabb="),
        (("question=x", "query=zebra", "dry_run=true"), "not among the 4 words"),
        (("question=x", "aabb=[0,0,0,1,1]", "dry_run=true"), "aabb: expected six numbers"),
        (("question=x", "aabb=[1,0,0,0,1,1]", "dry_run=true"), "not below the upper one"),
        (("question=x", "aabb=[0,0,0,1,1,1]", "dry_run=true"), "no Gaussian of scene room is in the box"),
        (("question=x", "aabb=[0,0,0,1,1,1]", "query=cube", "dry_run=true"), "give one of them"),
        (("question=x", "questions=q.jsonl", "dry_run=true"), "the file contains the questions"),
        (("question=the cube", "task=ground", "ask.marks=false", "dry_run=true"), "needs marks"),
    ],
)
def test_what_cannot_be_asked_ends_in_one_line(
    features: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: tuple[str, ...], told: str
) -> None:
    assert ask(features, tmp_path / "out", *words) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1
    assert told in lines[0]
    assert not (tmp_path / "out").exists()


def batch(path: Path, *rows: Any) -> Path:
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    return path


def test_a_batch_that_a_fault_ends_keeps_its_answers_and_goes_on(
    features: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
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
        told = capsys.readouterr().err
        assert "question 7: the server" in told
        assert "fell over" in told
        assert "2 of 3 answers are kept in" in told
        assert not out.exists()
        kept = read_answers(tmp_path / "answers.answers" / "answers.jsonl")
        assert [row["answer"] for row in kept.values()] == ["1", "2"]
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


@pytest.mark.parametrize("depth", [500, 200_000])
def test_an_answer_that_is_nested_too_deep_is_an_error_in_one_line(
    features: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], depth: int
) -> None:
    file = batch(tmp_path / "q.jsonl", {"id": "a", "question": "the cube"}, {"id": "b", "question": "the crate"})
    answers = tmp_path / "out.answers" / "answers.jsonl"
    with serving(crate_refused) as server:
        words = (f"questions={file}", f"vlm.base_url={server.url}")
        assert ask(features, tmp_path / "out", *words) == 2
        row = answers.read_text().rstrip()
        answers.write_text(row[:-1] + ', "x": ' + "[" * depth + "]" * depth + "}\n")
        capsys.readouterr()
        assert ask(features, tmp_path / "out", *words) == 2
    told = capsys.readouterr().err
    assert "Traceback" not in told
    assert "give resume=false to ask anew" in told


def crate_refused(handler: Handler, body: Any) -> None:
    text = body["messages"][0]["content"][-1]["text"]
    if "crate" in text:
        handler.reply(400, {"error": {"message": "no crates"}})
    else:
        answer("about " + text.rpartition("Question: ")[2])(handler, body)


def test_a_question_that_is_refused_keeps_no_other_from_its_answer(
    features: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cube, crate, wall = ({"id": name, "question": f"Where is the {name}?"} for name in ("cube", "crate", "wall"))
    lost = {"id": "lost", "task": "ground", "question": "the far one"}
    file, out = tmp_path / "q.jsonl", tmp_path / "out"
    with serving(crate_refused) as server:
        words = (f"questions={file}", f"vlm.base_url={server.url}")
        batch(file, cube, crate, lost, wall)
        assert ask(features, out, *words) == 2
        told = capsys.readouterr().err
        assert "2 of 4 questions have no answer: question crate: the server" in told
        assert "no crates" in told
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
        kept = json.loads((out / row["folder"] / "answer.json").read_text())
        assert kept["answer"] == row["answer"]


def test_an_answer_that_was_begun_with_other_settings_leaves_nothing_behind(features: Path, tmp_path: Path) -> None:
    file, out = (
        batch(tmp_path / "q.jsonl", {"question": "Where is the cube?"}, {"question": "the crate"}),
        tmp_path / "o",
    )
    with serving(crate_refused) as server:
        words = (f"questions={file}", f"vlm.base_url={server.url}")
        assert ask(features, out, *words, "choose.count=4") == 2
    assert ask(features, out, *words, "dry_run=true") == 0
    for folder in ("00001", "00002"):
        names = {path.name for path in (out / folder).iterdir()}
        assert names == {"prompt.txt", "request.json", "sheet.png", "view_00.png", "view_01.png"}


def test_features_that_were_replaced_are_asked_anew(features: Path, tmp_path: Path) -> None:
    file = batch(tmp_path / "q.jsonl", {"question": "Where is the cube?"}, {"question": "Where is the crate?"})
    place = tmp_path / "features"
    save_room(place)
    with serving(crate_refused) as server:
        words = (f"questions={file}", f"vlm.base_url={server.url}")
        assert ask(place, tmp_path / "out", *words) == 2
        server.behave = answer("x")
        shutil.rmtree(place)
        save_room(place, shift=(0.4, 0, 0))
        assert ask(place, tmp_path / "out", *words) == 0
        assert len(server.requests) == 4
        # The same room in another place is the same scene.
        assert ask(place, tmp_path / "out", *words, "overwrite=true") == 0


def test_warnings_of_a_batch_name_the_question(
    features: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = batch(tmp_path / "q.jsonl", {"id": "a", "question": "How large?"}, {"id": "b", "question": "How high?"})
    assert ask(features, tmp_path / "out", f"questions={file}", "dry_run=true") == 0
    told = capsys.readouterr().err
    for name in ("a", "b"):
        assert f"warning: question {name}: the question names nothing to look for" in told
    rows = [json.loads(line) for line in (tmp_path / "out" / "answers.jsonl").read_text().splitlines()]
    assert all("names nothing to look for" in row["warnings"][0] for row in rows)


def test_pictures_are_rendered_once_for_questions_about_one_thing(
    features: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rendered: list[int] = []

    def counted(*given: Any, **named: Any) -> Any:
        rendered.append(1)
        return view_pictures(*given, **named)

    monkeypatch.setattr(ask_module, "view_pictures", counted)
    config = ViewsConfig(source="frames", candidates=4, count=2)
    asker = Asker(load_features(features), load_text_table(features / WORDS_FILE), views=config)
    first, second = (asker.prompt(Question(text=text)) for text in ("Where is the cube?", "Is the cube red?"))
    assert first.pictures is second.pictures
    assert len(rendered) == 1
    marked = asker.prompt(Question(text="the left cube", task="ground"))
    assert len(rendered) == 2
    assert marked.marks == {1}
    for number in range(MAX_CACHED_PICTURES):
        low = ORIGIN + np.array([0.1, 0.0, 0.6 - 0.001 * number])
        asker.prompt(Question(text="What?", aabb=(*low.tolist(), *(ORIGIN + np.array([0.5, 0.4, 1.0])).tolist())))
    assert len(asker._picture_cache) == MAX_CACHED_PICTURES
    asker.prompt(Question(text="Where is the cube?"))
    assert len(rendered) == 3 + MAX_CACHED_PICTURES


def test_lines_take_the_task_of_the_command_unless_they_name_one(tmp_path: Path) -> None:
    file = batch(tmp_path / "q.jsonl", {"question": "a"}, {"question": "b", "task": "answer"})
    assert [each.question.task for each in read_questions(file, "ground")] == ["ground", "answer"]
    (tmp_path / "q.jsonl").write_text('{"question": "a\u2028b\u0085c"}\r\n')
    assert read_questions(file)[0].question.text == "a\u2028b\u0085c"


def test_a_word_that_is_absent_stands_in_the_prompt_and_in_the_answer(features: Path, tmp_path: Path) -> None:
    assert ask(features, tmp_path / "dry", "question=Where?", "query=cube,pen holder", "dry_run=true") == 0
    assert "probably absent: pen holder (probability 0.0" in (tmp_path / "dry" / "prompt.txt").read_text()
    (absent,) = json.loads((tmp_path / "dry" / "summary.json").read_text())["results"]["absent"]
    assert absent["query"] == "pen holder"
    assert absent["probability"] < 0.02


def test_words_for_one_thing_give_it_one_mark(features: Path, tmp_path: Path) -> None:
    words = ("question=the left one", "task=ground", "query=crate,crates,cube,crate", "dry_run=true")
    assert ask(features, tmp_path / "dry", *words) == 0
    assert "Marks: 1 = crate; 2 = crate; 3 = cube." in (tmp_path / "dry" / "prompt.txt").read_text()


def test_several_things_are_numbered_only_where_that_is_asked_for(features: Path, tmp_path: Path) -> None:
    words = ("question=How many are there?", "query=crate", "dry_run=true")
    assert ask(features, tmp_path / "plain", *words) == 0
    assert "mark" not in (tmp_path / "plain" / "prompt.txt").read_text().lower()
    assert ask(features, tmp_path / "marked", *words, "ask.marks=true") == 0
    assert "1 = crate; 2 = crate." in (tmp_path / "marked" / "prompt.txt").read_text()


def test_other_settings_ask_anew(features: Path, tmp_path: Path) -> None:
    file = batch(tmp_path / "q.jsonl", {"question": "Where is the cube?"}, {"question": "Where is the crate?"})

    def fails_at_the_second(handler: Handler, body: Any) -> None:
        if len(server.requests) % 2 == 0:
            handler.reply(400, {"error": {"message": "no"}})
        else:
            answer("x")(handler, body)

    with serving(fails_at_the_second) as server:
        words = (f"questions={file}", f"vlm.base_url={server.url}")
        assert ask(features, tmp_path / "out", *words) == 2
        server.behave = answer("y")
        assert ask(features, tmp_path / "out", *words, "vlm.temperature=0.5") == 0
    rows = [json.loads(line) for line in (tmp_path / "out" / "answers.jsonl").read_text().splitlines()]
    assert [row["answer"] for row in rows] == ["y", "y"]


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"", "holds none"),
        (b"\n\n", "holds none"),
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
        (b'{"question": "a", "aabb": [1, 2]}\n', "line 1: aabb: expected six numbers"),
        (b'{"question": "a", "id": null}\n', "line 1: id: expected text"),
        (b"\xff\xfe\n", "not a text file"),
        (b"\x80\x04]", "is a pickle, which is refused since reading it can run code"),
    ],
)
def test_files_of_questions_that_are_wrong_say_where(
    tmp_path: Path, content: bytes, told: str, no_jaxtyping: None
) -> None:
    (tmp_path / "q.jsonl").write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_questions(tmp_path / "q.jsonl")
    assert told in str(caught.value)
    with pytest.raises(InputError, match="no such file"):
        read_questions(tmp_path / "other.jsonl")


def test_what_a_server_says_cannot_steer_a_terminal() -> None:
    assert printable("10\u202fm, 👨\u200d👩, a\tb\u00a0c") == "10\u202fm, 👨\u200d👩, a\tb\u00a0c"
    assert printable("a\u202eb") == "a\N{REPLACEMENT CHARACTER}b"
    assert printable("a\x1b[31mb\nc\x07") == "a\N{REPLACEMENT CHARACTER}[31mb\nc\N{REPLACEMENT CHARACTER}"


@pytest.fixture(scope="module")
def real_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, str]]:
    """`transformers serve` with a tiny random model: its address and the model's name."""
    pytest.importorskip("fastapi")
    folder = tmp_path_factory.mktemp("vlm")
    save_tiny_vlm(folder / "model")
    (folder / "home" / "hub").mkdir(parents=True)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [str(Path(sys.executable).with_name("transformers")), "serve", str(folder / "model")]
    options = ["--device", "cpu", "--no-continuous-batching", "--host", "127.0.0.1", "--port", str(port)]
    environment = os.environ | {"HF_HOME": str(folder / "home"), "HF_HUB_OFFLINE": "1"}
    with (folder / "log").open("wb") as log:
        process = subprocess.Popen([*command, *options], stdout=log, stderr=log, env=environment)
    try:
        for _ in range(240):
            try:
                urllib.request.urlopen(f"http://127.0.0.1:{port}/health", timeout=5).close()
                break
            except OSError:
                assert process.poll() is None, (folder / "log").read_text()[-2000:]
                time.sleep(0.5)
        else:
            pytest.fail((folder / "log").read_text()[-2000:])
        yield f"http://127.0.0.1:{port}/v1", str(folder / "model")
    finally:
        process.terminate()
        try:
            process.wait(20)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


@pytest.mark.parametrize("stream", [True, False])
@pytest.mark.parametrize("task", ["answer", "ground", "caption"])
def test_a_real_server_takes_what_is_sent_and_answers(
    features: Path, tmp_path: Path, real_server: tuple[str, str], task: str, stream: bool
) -> None:
    url, model = real_server
    words = (f"vlm.base_url={url}", f"vlm.model={model}", f"vlm.stream={stream}", "vlm.max_tokens=12")
    question = "" if task == "caption" else "Where is the crate?"
    assert ask(features, tmp_path / "out", *words, f"question={question}", "query=crate", f"task={task}") == 0
    row = json.loads((tmp_path / "out" / "answer.json").read_text())
    assert row["answer"]
    assert row["finish"] in ("stop", "length")
    assert row["tokens"]["prompt"] > 10


def test_a_real_server_refuses_another_model_in_its_own_words(
    features: Path, tmp_path: Path, real_server: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    url, _ = real_server
    assert ask(features, tmp_path / "out", f"vlm.base_url={url}", "vlm.model=other", "question=Is it the cube?") == 2
    told = capsys.readouterr().err
    assert "refuses the request" in told or "has no model of that name" in told
    assert "other" in told
