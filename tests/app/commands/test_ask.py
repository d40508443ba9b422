"""`gsencoder ask`: what is sent for a question, what is written, and what is refused."""

import base64
import io
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from asked_rooms import KEY, ORIGIN, QUICK, ask
from chat_server import answer, serving
from command_runs import refusal
from PIL import Image

from gsencoder.app import main as cli
from gsencoder.core.errors import InputError, printable
from gsencoder.infer.ask.ask import Question

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("vlm_environment")]

pytest.importorskip("openai")


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


def test_a_key_of_the_command_line_is_written_nowhere(features, tmp_path, capsys):
    with serving(answer("fine")) as server:
        words = ("question=What is the cube?", f"vlm.base_url={server.url}", "vlm.key=sk-of-the-line")
        assert ask(features, tmp_path / "answer", *words) == 0
        assert server.requests[0][0]["authorization"] == "Bearer sk-of-the-line"
        assert cli.main(["ask", str(features), *words, "--cfg"]) == 0
    assert "sk-of-the-line" not in capsys.readouterr().out
    everything = b"".join(path.read_bytes() for path in tmp_path.rglob("*") if path.is_file())
    assert b"sk-of-the-line" not in everything
    assert b"(not shown)" in everything


def test_a_dry_run_writes_prompt_and_pictures_and_asks_nobody(features: Path, tmp_path: Path) -> None:
    out = tmp_path / "dry"
    # Words for one thing give it one mark.
    words = ("question=the left one", "task=ground", "query=crate,crates,cube,crate", "dry_run=true")
    assert ask(features, out, *words) == 0
    text = (out / "prompt.txt").read_text()
    assert "Marks: 1 = crate; 2 = crate; 3 = cube." in text
    assert "Meant is: the left one" in text
    assert not (out / "answer.json").exists()
    assert {path.name for path in out.iterdir()} >= {"request.json", "sheet.png", "view_00.png", "summary.json"}


def test_things_are_numbered_where_that_is_asked_for_and_absent_words_stand_in_the_prompt(features, tmp_path):
    words = ("question=How many are there?", "query=crate,pen holder", "dry_run=true")
    assert ask(features, tmp_path / "plain", *words) == 0
    text = (tmp_path / "plain" / "prompt.txt").read_text()
    assert "mark" not in text.lower()
    assert "probably absent: pen holder (probability 0.0" in text
    (absent,) = json.loads((tmp_path / "plain" / "summary.json").read_text())["results"]["absent"]
    assert absent["query"] == "pen holder"
    assert absent["probability"] < 0.02
    assert ask(features, tmp_path / "marked", *words, "ask.marks=true") == 0
    assert "1 = crate; 2 = crate." in (tmp_path / "marked" / "prompt.txt").read_text()


def test_a_tower_is_not_ignored_where_the_file_of_words_was_lost(features, tmp_path, capsys):
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
    (target,) = json.loads((tmp_path / "words" / "answer.json").read_text())["targets"]
    assert (target["query"], target["rank"]) == ("crate", 0)
    (corner_target,) = json.loads((tmp_path / "corners" / "answer.json").read_text())["targets"]
    np.testing.assert_allclose([*corner_target["aabb_min"], *corner_target["aabb_max"]], [*low, *high])
    prompt = (tmp_path / "words" / "prompt.txt").read_text()
    assert "The thing is the crate.\nIt carries the mark 1" in prompt
    assert "The thing is" not in (tmp_path / "corners" / "prompt.txt").read_text()
    assert "It carries the mark 1" in (tmp_path / "corners" / "prompt.txt").read_text()


def test_a_question_that_names_nothing_is_shown_even_frames_and_says_so(features: Path, tmp_path: Path) -> None:
    assert ask(features, tmp_path / "dry", "question=How large is this place?", "dry_run=true") == 0
    summary = json.loads((tmp_path / "dry" / "summary.json").read_text())
    assert any("evenly spread views are shown" in line for line in summary["warnings"])
    assert [view["frame"] for view in summary["results"]["views"]] == [0, 11]


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (("question=What is the cube?",), "say where the model's server is"),
        (("question=What is the cube?", "vlm.base_url=http://127.0.0.1:9/v1"), "no server answers there"),
        (("dry_run=true",), "question= is missing"),
        (("question=x", "task=ground", "dry_run=true"), "names nothing to look for; give query= or aabb="),
        (("question=x", "query=zebra", "dry_run=true"), "not among the 4 words"),
        (("question=x", "aabb=[0,0,0,1,1,1]", "dry_run=true"), "no Gaussian of scene room is in the box"),
        (("question=x", "questions=q.jsonl", "dry_run=true"), "the file contains the questions"),
        (("question=the cube", "task=ground", "ask.marks=false", "dry_run=true"), "needs marks"),
    ],
)
def test_what_cannot_be_asked_ends_in_one_line(features, tmp_path, capsys, words, problem):
    assert problem in refusal(capsys, "ask", str(features), f"out={tmp_path / 'out'}", "vlm.retries=0", *QUICK, *words)
    assert not (tmp_path / "out").exists()


def test_boxes_that_are_none_are_refused() -> None:
    for aabb, query, problem in (
        ((0.0, 0.0, 0.0, 1.0, 1.0), (), "aabb: expected six numbers"),
        ((1.0, 0.0, 0.0, 0.0, 1.0, 1.0), (), "not below the upper one"),
        ((0.0, 0.0, 0.0, 1.0, 1.0, 1.0), ("cube",), "give one of them"),
    ):
        with pytest.raises(InputError, match=problem):
            Question(text="x", aabb=aabb, query=query)


def test_what_a_server_says_cannot_steer_a_terminal() -> None:
    assert printable("10\u202fm, 👨\u200d👩, a\tb\u00a0c") == "10\u202fm, 👨\u200d👩, a\tb\u00a0c"
    assert printable("a\u202eb") == "a\N{REPLACEMENT CHARACTER}b"
    assert printable("a\x1b[31mb\nc\x07") == "a\N{REPLACEMENT CHARACTER}[31mb\nc\N{REPLACEMENT CHARACTER}"
