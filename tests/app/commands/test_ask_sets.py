"""`gsencoder ask` over question sets: made from labels, answered by a server, written as benchmarks do."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import questions
from chat_server import Handler, answer, serving
from command_runs import refusal, results_of
from named_rooms import write_words

from gsencoder.app import main as cli
from gsencoder.data.labels.expressions import read_scanrefer
from gsencoder.data.labels.questions import read_questions
from gsencoder.data.synthetic import make_room, write_room
from gsencoder.evaluate.benchmarks.answers import read_answer_predictions
from gsencoder.infer.ask.questions import read_answers

pytestmark = pytest.mark.slow

pytest.importorskip("openai")

ROOMS = ("room_000", "room_001")
QUICK = ("choose.candidates=4", "choose.count=2", "choose.judged_side=60", "choose.width=64", "choose.height=48")


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two rooms, features of their names, and what can be asked about them."""
    folder = tmp_path_factory.mktemp("home")
    rooms = [make_room(seed, objects=5, views=4, width=96, height=72) for seed in (0, 1)]
    words = write_words(folder / "words.safetensors", *rooms)
    for room in rooms:
        write_room(room, folder / "rooms" / room.name)
        fused = (f"teacher.words={words}", "seeds.voxel=0.04", f"out={folder / 'features' / room.name}", "quiet=true")
        assert cli.main(["fuse", str(folder / "rooms" / room.name), "teacher=labels", *fused]) == 0
    few = ("--min-pixels=60", "--per-kind=2", "--objects=2", "--per-object=1")
    questions.main([str(folder / "set"), str(folder / "rooms"), *few])
    return folder


@pytest.fixture(autouse=True)
def environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENAI_API_KEY", "none")
    monkeypatch.setenv("GSENCODER_VLM_MODEL", "scripted")
    monkeypatch.delenv("OPENAI_BASE_URL", raising=False)


def ask(home: Path, out: Path, file: str, *words: str) -> int:
    photos, sent = f"photos={home / 'rooms'}", ("quiet=true", f"out={out}")
    return cli.main(["ask", str(home / "features"), f"questions={home / 'set' / file}", photos, *sent, *QUICK, *words])


def answered(
    home: Path, out: Path, file: str, behave: Callable[[Handler, Any], None], *words: str
) -> tuple[Any, dict[str, Any]]:
    """The predictions, and the rows of answers with their scenes, of a server that behaves so."""
    with serving(behave) as server:
        assert ask(home, out, file, f"vlm.base_url={server.url}", *words) == 0
    rows = [row | {"scene": name} for name in ROOMS for row in read_answers(out / name / "answers.jsonl").values()]
    return json.loads((out / "predictions.json").read_text()), {f"{row['scene']} {row['id']}": row for row in rows}


def test_answers_of_a_set_are_those_of_its_questions_and_a_dry_run_sends_nothing(home: Path, tmp_path: Path) -> None:
    questions = {each.id: each for each in read_questions(home / "set" / "questions.json")}
    texts = {each.situated_text: each.answers[0] for each in questions.values()}

    def right(handler: Handler, body: Any) -> None:
        text = body["messages"][-1]["content"][-1]["text"].rpartition("Question: ")[2]
        answer(texts[text])(handler, body)

    assert ask(home, tmp_path / "dry", "questions.json", "dry_run=true") == 0
    assert not (tmp_path / "dry" / "predictions.json").exists()
    predicted, _ = answered(home, tmp_path / "out", "questions.json", right)
    assert {row["question_id"]: row["answer_top10"] for row in predicted} == {
        key: [texts[each.situated_text]] for key, each in questions.items()
    }
    read = read_answer_predictions(tmp_path / "out" / "predictions.json", list(questions.values()))
    assert len(read) == len(questions)
    results = results_of(tmp_path / "out")
    assert results["answered"] == results["predicted"] == len(questions)
    assert set(results["scenes"]) == set(ROOMS)
    assert (results["unanswered"], results["other_scenes"]) == ({}, {})


def test_described_objects_are_grounded_in_the_box_under_the_mark_of_the_answer(home: Path, tmp_path: Path) -> None:
    predicted, rows = answered(home, tmp_path / "out", "expressions.json", answer("1"))
    assert len(predicted) == len(read_scanrefer(home / "set" / "expressions.json")) == len(rows)
    for row, asked in zip(predicted, rows.values(), strict=True):
        corners = np.array(row["bbox"])
        assert corners.shape == (8, 3)
        assert row["bbox"] == row["bboxes"][0]
        marked = asked["targets"][0]
        np.testing.assert_allclose(corners.min(axis=0), marked["aabb_min"], atol=1e-5)
        np.testing.assert_allclose(corners.max(axis=0), marked["aabb_max"], atol=1e-5)


def test_objects_are_captioned_in_boxes_that_are_given(home: Path, tmp_path: Path) -> None:
    predicted, _ = answered(home, tmp_path / "out", "expressions.json", answer("a mug"), "task=caption")
    described = read_scanrefer(home / "set" / "expressions.json")
    assert set(predicted) == set(ROOMS)
    assert {row["caption"] for rows in predicted.values() for row in rows} == {"sos a mug eos"}
    assert sum(map(len, predicted.values())) == len({each.key[:2] for each in described})


def test_questions_of_other_scenes_are_counted_and_named(home: Path, tmp_path: Path) -> None:
    one = home / "features" / ROOMS[0]
    words = [f"questions={home / 'set' / 'questions.json'}", "dry_run=true", "quiet=true", *QUICK]
    assert cli.main(["ask", str(one), f"out={tmp_path / 'one'}", *words]) == 0
    results = results_of(tmp_path / "one")
    assert set(results["scenes"]) == {ROOMS[0]}
    assert set(results["other_scenes"]) == {ROOMS[1]}
    assert results["other_scenes"][ROOMS[1]] > 0
    assert (tmp_path / "one" / ROOMS[0] / "00001" / "request.json").is_file()


def test_refused_questions_cost_no_other_its_answer_and_a_broken_set_goes_on(home, tmp_path, capsys):
    statuses, seen = [400, 500], list[Any]()

    def stops(handler: Handler, body: Any) -> None:
        seen.append(body)
        if statuses and len(seen) == 3:
            handler.reply(statuses[-1], {"error": {"message": "no"}})
        else:
            answer("unknown")(handler, body)

    out, name = tmp_path / "out", "questions.json"
    with serving(stops) as server:
        words = (f"vlm.base_url={server.url}", "vlm.retries=0", "choose.source=frames")
        assert ask(home, out, name, *words) == 2
        assert "2 of " in capsys.readouterr().err
        assert not out.exists()
        statuses.pop()
        del seen[2:]  # The third one is asked again, and refused.
        assert ask(home, out, name, *words) == 0
    results = results_of(out)
    assert len(seen) == results["questions"]
    assert len(results["unanswered"]) == 1
    assert results["predicted"] == results["questions"] - 1
    assert "1 of " in capsys.readouterr().err


def test_a_set_and_folders_that_do_not_fit_end_in_one_line(home, tmp_path, capsys):
    features, file = str(home / "features"), f"questions={home / 'set' / 'questions.json'}"
    (tmp_path / "empty").mkdir()
    lines = tmp_path / "lines.jsonl"
    lines.write_text('{"question": "Where is it?"}\n')
    other = tmp_path / "other.json"
    other.write_text(json.dumps([{"scene_id": "hall", "question_id": "1", "question": "What?"}]))
    shutil.copytree(home / "features" / ROOMS[0], tmp_path / "again" / ROOMS[0])
    for words, problem in (
        ((str(tmp_path / "none"), file), "none: no file or folder; expected a folder of features"),
        ((str(tmp_path / "empty"), file), "empty: an empty folder; expected a folder of features"),
        ((features, f"questions={lines}", "proposals=localize"), "questions about one scene"),
        ((features, features, f"questions={lines}"), "questions about one scene"),
        ((f"{features}/{ROOMS[0]}", f"questions={other}"), "asks about 1 scene (hall)"),
        ((features, str(tmp_path / "again"), file), "so does another folder"),
        ((features, "question=What?", "proposals=localize"), "are boxes for a question set"),
        ((features, str(tmp_path / "again"), "question=What?"), "expected one folder of features"),
    ):
        out = f"out={tmp_path / 'out'}"
        assert problem in refusal(capsys, "ask", *words, "dry_run=true", out, *QUICK)
        assert not (tmp_path / "out").exists()
        shutil.rmtree(tmp_path / "out.answers", ignore_errors=True)
