"""`gsencoder ask` over question sets: made from labels, answered by a scripted answerer, written as benchmarks do."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_runs import refusal, results_of
from named_rooms import write_words
from scripted_answerer import (
    AnswerSheet,
    PictureTruth,
    ScriptedAnswerer,
    add_expressions,
    add_pictures,
    add_questions,
    serving,
)

from gsencoder.app import main as cli
from gsencoder.data.labels.expressions import read_scanrefer
from gsencoder.data.labels.questions import read_questions
from gsencoder.data.scenes import load_scene
from gsencoder.data.synthetic import make_room, write_room
from gsencoder.evaluate.benchmarks.answers import read_answer_predictions
from gsencoder.evaluate.benchmarks.localization import aabb_iou
from gsencoder.fusion.folder import load_features
from gsencoder.infer.ask.questions import read_answers
from gsencoder.infer.views.photographs import with_photographs

pytestmark = pytest.mark.slow

pytest.importorskip("openai")

ROOMS = ("room_000", "room_001")
QUICK = ("choose.candidates=4", "choose.count=2", "choose.judged_side=60", "choose.width=96", "choose.height=72")


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
    made = ("min_pixels=60", "per_kind=2", "objects=3", "per_object=1", f"out={folder / 'set'}", "quiet=true")
    assert cli.main(["questions", str(folder / "rooms"), *made]) == 0
    return folder


@pytest.fixture(autouse=True)
def environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENAI_API_KEY", "none")
    monkeypatch.setenv("GSENCODER_VLM_MODEL", "scripted")
    monkeypatch.delenv("OPENAI_BASE_URL", raising=False)


def ask(home: Path, out: Path, file: str, *words: str) -> int:
    photos, sent = f"photos={home / 'rooms'}", ("vlm.image_format=png", "quiet=true", f"out={out}")
    return cli.main(["ask", str(home / "features"), f"questions={home / 'set' / file}", photos, *sent, *QUICK, *words])


def sheet_of(home: Path, dry: Path) -> AnswerSheet:
    sheet = AnswerSheet()
    for file in ("questions.json", "situated_questions.json"):
        add_questions(sheet, read_questions(home / "set" / file))
    add_expressions(sheet, read_scanrefer(home / "set" / "expressions.json"))
    for name in ROOMS:
        labeled = load_scene(home / "rooms" / name)
        scene = with_photographs(load_features(home / "features" / name), labeled)
        add_pictures(sheet, dry / name, PictureTruth(scene, labeled))
    return sheet


def answered(home: Path, tmp_path: Path, file: str, *words: str) -> tuple[Any, ScriptedAnswerer]:
    """The predictions of a dry run and a real one, whose pictures are the same."""
    assert ask(home, tmp_path / "dry", file, "dry_run=true", *words) == 0
    assert not (tmp_path / "dry" / "predictions.json").exists()
    answerer = ScriptedAnswerer(sheet_of(home, tmp_path / "dry"), min_pixels=30)
    with serving(answerer) as url:
        assert ask(home, tmp_path / "out", file, f"vlm.base_url={url}", *words) == 0
    assert answerer.unknown_pictures == 0
    return json.loads((tmp_path / "out" / "predictions.json").read_text()), answerer


def test_what_pictures_show_well_is_answered_rightly(home: Path, tmp_path: Path) -> None:
    predicted, answerer = answered(home, tmp_path, "questions.json")
    questions = {each.id: each for each in read_questions(home / "set" / "questions.json")}
    assert answerer.unknown_questions == 0
    assert {row["question_id"] for row in predicted} == set(questions)
    right = [row["answer_top10"][0] in questions[row["question_id"]].answers for row in predicted]
    assert all(row["answer_top10"] == ["unknown"] for row, good in zip(predicted, right, strict=True) if not good)
    assert np.mean(right) > 0.5
    read = read_answer_predictions(tmp_path / "out" / "predictions.json", list(questions.values()))
    assert len(read) == len(questions)
    results = results_of(tmp_path / "out")
    assert results["answered"] == results["predicted"] == len(questions)
    assert set(results["scenes"]) == set(ROOMS)
    assert (results["unanswered"], results["other_scenes"]) == ({}, {})
    # Whoever needs more pixels than any picture has knows nothing but what is absent.
    blind = ScriptedAnswerer(answerer.sheet, min_pixels=10**9)
    for name in ROOMS:
        for row in read_answers(tmp_path / "out" / name / "answers.jsonl").values():
            body = json.loads((tmp_path / "out" / name / row["folder"] / "request.json").read_text())
            assert blind.reply(body) == ("unknown" if questions[row["id"]].object_ids else "no")


def test_described_objects_are_grounded_in_boxes(home: Path, tmp_path: Path) -> None:
    predicted, _ = answered(home, tmp_path, "expressions.json")
    truth = {each.key: each for each in read_scanrefer(home / "set" / "expressions.json")}
    assert predicted
    ious = []
    for row in predicted:
        aabb = truth[row["scene_id"], int(row["object_id"]), row["ann_id"]].aabb
        assert aabb is not None
        assert row["bbox"] == (row["bboxes"][0] if row["bboxes"] else None)
        corners = np.array(row["bbox"] or np.zeros((8, 3)))
        assert corners.shape == (8, 3)
        ious.append(aabb_iou(corners.min(axis=0), corners.max(axis=0), *(np.array(corner) for corner in aabb)))
    assert np.mean(np.array(ious) > 0.25) > 0.5


def test_objects_are_captioned_in_boxes_that_are_given(home: Path, tmp_path: Path) -> None:
    predicted, _ = answered(home, tmp_path, "expressions.json", "task=caption")
    described = read_scanrefer(home / "set" / "expressions.json")
    assert set(predicted) == set(ROOMS)
    captions = {row["caption"] for rows in predicted.values() for row in rows}
    assert sum(map(len, predicted.values())) == len({each.key[:2] for each in described})
    right = {f"sos {each.text} eos" for each in described}
    assert captions <= right | {"sos unknown eos"}
    assert captions & right


def test_situations_are_said_before_their_questions(home: Path, tmp_path: Path) -> None:
    answerer = ScriptedAnswerer(AnswerSheet())
    with serving(answerer) as url:
        server = (f"vlm.base_url={url}", "choose.source=frames")
        assert ask(home, tmp_path / "out", "situated_questions.json", *server) == 0
    questions = read_questions(home / "set" / "situated_questions.json")
    read = read_answer_predictions(tmp_path / "out" / "predictions.json", questions)
    assert read == {each.id: ("unknown",) for each in questions}
    prompt = (tmp_path / "out" / ROOMS[0] / "00001" / "prompt.txt").read_text()
    assert f"Question: {questions[0].situation} {questions[0].text}" in prompt


def test_questions_of_other_scenes_are_counted_and_named(home: Path, tmp_path: Path) -> None:
    one = home / "features" / ROOMS[0]
    words = [f"questions={home / 'set' / 'questions.json'}", "dry_run=true", "quiet=true", *QUICK]
    assert cli.main(["ask", str(one), f"out={tmp_path / 'one'}", *words]) == 0
    results = results_of(tmp_path / "one")
    assert set(results["scenes"]) == {ROOMS[0]}
    assert set(results["other_scenes"]) == {ROOMS[1]}
    assert results["other_scenes"][ROOMS[1]] > 0
    assert (tmp_path / "one" / ROOMS[0] / "00001" / "request.json").is_file()


def test_refused_questions_cost_no_other_its_answer_and_a_broken_set_goes_on(
    home: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    answerer = ScriptedAnswerer(AnswerSheet())
    reply, fault = answerer.reply, [LookupError("no"), RuntimeError("broken")]

    def stops(body: Any) -> str:
        text = reply(body)
        if fault and answerer.requests == 3:
            raise fault[-1]
        return text

    answerer.reply = stops  # type: ignore[method-assign]
    out, name = tmp_path / "out", "questions.json"
    with serving(answerer) as url:
        server = (f"vlm.base_url={url}", "vlm.retries=0", "choose.source=frames")
        assert ask(home, out, name, *server) == 2
        assert "2 of " in capsys.readouterr().err
        assert not out.exists()
        fault.pop()
        answerer.requests = 2  # The third one is asked again, and refused.
        assert ask(home, out, name, *server) == 0
    results = results_of(out)
    assert answerer.requests == results["questions"]
    assert len(results["unanswered"]) == 1
    assert results["predicted"] == results["questions"] - 1
    assert "1 of " in capsys.readouterr().err


def test_a_set_and_folders_that_do_not_fit_end_in_one_line(
    home: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
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
