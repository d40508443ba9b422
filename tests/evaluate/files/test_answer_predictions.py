"""Predicted answers in ScanQA's and SQA3D's files, and every way in which they can be wrong."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.labels.files import box_corners
from gsencoder.data.labels.questions import Question
from gsencoder.evaluate.benchmarks.answers import read_answer_predictions
from gsencoder.evaluate.benchmarks.captions import CaptionedObject, read_caption_predictions

SCANQA = (
    Question(dataset="scanqa", id="q0", scene="s0", text="What?", answers=("chair",)),
    Question(dataset="scanqa", id="q1", scene="s1", text="What?", answers=("table",)),
)
SQA3D = tuple(
    Question(
        dataset="sqa3d", id=str(number), scene="s0", text="Which?", situation="I stand.", answers=("left",),
        position=(float(number), 0.5, 0.0), rotation=(0.8, 0.0, 0.0, 0.6),
    )
    for number in range(2)
)  # fmt: skip


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


OBJECTS = tuple(
    CaptionedObject(scene=scene, object_id=number, object_name="office_chair", captions=("sos a chair eos",))
    for scene, number in (("s0", 3), ("s0", 4), ("s1", 3))
)
CORNERS = box_corners((0.0, 0.0, 0.0), (1.0, 2.0, 3.0))


def row(**changes: Any) -> dict[str, Any]:
    return {"caption": "sos a chair eos", "box": CORNERS, "sem_prob": [0.5, 0.5], "obj_prob": [0.25, 0.75]} | changes


def test_captions_of_boxes_are_read_as_the_benchmark_takes_them(tmp_path: Path) -> None:
    content = {"s0": [row(), {"caption": "", "box": CORNERS[::-1]}], "s1": []}
    aabb = ((0.0, 0.0, 0.0), (1.0, 2.0, 3.0))
    expected = {"s0": [("sos a chair eos", aabb), ("", aabb)]}
    assert read_caption_predictions(written(tmp_path, content), OBJECTS) == (expected, {})


def test_captions_of_given_objects_are_read_as_scan2cap_writes_them(tmp_path: Path) -> None:
    path = written(tmp_path, {"s0|3|office_chair": ["sos a chair eos"], "s1|3": ["b"]})
    assert read_caption_predictions(path, OBJECTS) == ({}, {("s0", 3): "sos a chair eos", ("s1", 3): "b"})
    assert read_caption_predictions(written(tmp_path, {}), OBJECTS) == ({}, {})


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"s9": [row()]}, "'s9': is no scene of the truth"),
        ({"s0": row()}, "pred.json: s0 must be a list of objects with caption and box, got an object"),
        ({"s0": [row(), row(box=None)]}, r"s0\[1\]: box must be a list of 8 corners"),
        ({"s0|3|lamp": ["a"]}, "the truth calls this object 'office_chair'"),
        ({"s0|3": ["a"], "s0|3|office_chair": ["b"]}, r"is the same object as 's0\|3'"),
        ([{"ann_id": "1"}], "this is truth: were predictions and truth swapped"),
        ([], "expected an object from scenes"),
    ],
)
def test_a_wrong_entry_of_captions_is_named(tmp_path: Path, content: Any, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read_caption_predictions(written(tmp_path, content), OBJECTS)
    assert "pred.json" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_scene_that_is_there_twice_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "pred.json").write_text('{"s0": [], "s0": []}')
    with pytest.raises(InputError, match="'s0' is there twice"):
        read_caption_predictions(tmp_path / "pred.json", OBJECTS)
