"""Predicted answers in ScanQA's and SQA3D's files, and every way in which they can be wrong."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.labels.questions import Question
from gsencoder.evaluate.benchmarks.answers import read_answer_predictions

SCANQA = (
    Question(dataset="scanqa", id="q0", scene="s0", text="What?", answers=("chair",)),
    Question(dataset="scanqa", id="q1", scene="s1", text="What?", answers=("table",)),
)
SQA3D = tuple(
    Question(
        dataset="sqa3d",
        id=str(number),
        scene="s0",
        text="Which?",
        situation="I stand.",
        answers=("left",),
        position=(float(number), 0.5, 0.0),
        rotation=(0.8, 0.0, 0.0, 0.6),
    )
    for number in range(2)
)


def entry(**changes: Any) -> dict[str, Any]:
    return {"scene_id": "s0", "question_id": "q0", "answer_top10": ["chair", "stool"]} | changes


def written(folder: Path, content: Any) -> Path:
    path = folder / "pred.json"
    path.write_text(json.dumps(content))
    return path


def test_scanqas_submission_is_read_with_and_without_boxes(tmp_path: Path) -> None:
    rows = [entry(bbox=[[0, 0, 0]] * 8), {"question_id": "q1", "answer": "table"}]
    assert read_answer_predictions(written(tmp_path, rows), SCANQA) == {"q0": ("chair", "stool"), "q1": ("table",)}
    assert read_answer_predictions(written(tmp_path, []), SCANQA) == {}


def test_sqa3ds_answers_are_found_by_situation_and_place(tmp_path: Path) -> None:
    row = {"scene_id": "s0", "situation": "I stand.", "question": "Which?", "answer": "right"}
    pose = {"agent_pos": {"x": 1.0, "y": 0.5, "z": 0}, "agent_rot": {"_x": 0, "_y": 0, "_z": 0.6, "_w": 0.8}}
    assert read_answer_predictions(written(tmp_path, [row | pose]), SQA3D) == {"1": ("right",)}
    assert read_answer_predictions(written(tmp_path, [row]), SQA3D[:1]) == {"0": ("right",)}
    with pytest.raises(InputError, match="entry 0: scene, situation, question and place are those of 2 questions"):
        read_answer_predictions(written(tmp_path, [row]), SQA3D)
    with pytest.raises(InputError, match="those of no question of the truth: 'Which\\?'"):
        read_answer_predictions(written(tmp_path, [row | pose | {"situation": "I sit."}]), SQA3D)
    assert read_answer_predictions(written(tmp_path, [{"question_id": 1, "answer": ""}]), SQA3D) == {"1": ("",)}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([entry(), entry()], "entries 0 and 1 have one question_id: q0; expected each once"),
        ([entry(question_id="q9")], "entry 0: question_id q9 is not in the truth"),
        ([entry(scene_id="s9")], "entry 0: is about s9, of which the truth has no questions"),
        ([entry(scene_id="s1")], "entry 0: question q0 is about s0, got s1"),
        ([{"answer": "x"}], "entry 0: says not which question it answers"),
        ([entry(answer_top10="chair")], "entry 0: answer_top10 must be a list of texts, got 'chair'"),
        ([entry(answer_top10=[])], "entry 0: answer_top10 has 0 answers, expected 1 to 10"),
        ([{"question_id": "q0", "answer": 3}], "entry 0: answer must be a text, got 3"),
        ([{"question_id": "q0", "answers": ["x"]}], "got answers, which truth has; were predictions and truth swapped"),
        ({"questions": []}, "got SQA3D's truth; were predictions and truth swapped"),
    ],
)
def test_a_wrong_entry_is_named(tmp_path: Path, content: Any, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read_answer_predictions(written(tmp_path, content), SCANQA)
    assert "pred.json" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 600


def test_situations_at_one_place_are_told_apart_by_where_one_faces(tmp_path: Path) -> None:
    turned = replace(SQA3D[0], id="7", rotation=(0.6, 0.0, 0.0, 0.8))
    row = {"scene_id": "s0", "situation": "I stand.", "question": "Which?", "answer": "right"}
    pose = {"agent_pos": {"x": 0.0, "y": 0.5, "z": 0}}
    for question in (SQA3D[0], turned):
        w, x, y, z = question.rotation or ()
        faced = {"agent_rot": {"_x": x, "_y": y, "_z": z, "_w": w}}
        predictions = read_answer_predictions(written(tmp_path, [row | pose | faced]), (SQA3D[0], turned))
        assert predictions == {question.id: ("right",)}
    with pytest.raises(InputError, match="are those of 2 questions; give its question_id"):
        read_answer_predictions(written(tmp_path, [row | pose]), (SQA3D[0], turned))


def test_equal_questions_are_answered_in_the_order_of_the_file(tmp_path: Path) -> None:
    twin = replace(SQA3D[0], id="7")
    place = {"agent_pos": {"x": 0.0, "y": 0.5, "z": 0}, "agent_rot": {"_x": 0, "_y": 0, "_z": 0.6, "_w": 0.8}}
    rows = [
        {"scene_id": "s0", "situation": "I stand.", "question": "Which?", "answer": answer} | place
        for answer in ("left", "right", "up")
    ]
    truth = (SQA3D[0], SQA3D[1], twin)
    with pytest.warns(SceneWarning, match="2 entries without question_id could be those of several equal questions"):
        predictions = read_answer_predictions(written(tmp_path, rows[:2]), truth)
    assert predictions == {"0": ("left",), "7": ("right",)}
    with pytest.warns(SceneWarning, match="1 entry without"):
        assert read_answer_predictions(written(tmp_path, rows[2:]), truth) == {"0": ("up",)}
    with pytest.warns(SceneWarning, match="3 entries"), pytest.raises(InputError, match="have one question_id: 0"):
        read_answer_predictions(written(tmp_path, rows), truth)
