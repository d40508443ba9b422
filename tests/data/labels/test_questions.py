"""ScanQA's and SQA3D's files: what is read, and what is refused with one line that names the entry."""

import json
from pathlib import Path
from typing import Any

import pytest

from gsencoder.core.errors import InputError
from gsencoder.data.labels.questions import Question, read_questions, write_scanqa


def entry(**changes: Any) -> dict[str, Any]:
    return {
        "scene_id": "scene0300_00",
        "question_id": "val-scene0300-18",
        "question": "How many legs does the chair have?",
        "answers": ["4", "4"],
        "object_ids": [7, 8],
        "object_names": ["chair", "chair"],
    } | changes


def question(number: int = 220602000002, **changes: Any) -> dict[str, Any]:
    return {
        "scene_id": "scene0050_00",
        "situation": "I am standing by the ottoman.",
        "alternative_situation": [],
        "question": "What is black?",
        "question_id": number,
    } | changes


def annotation(number: int = 220602000002, **changes: Any) -> dict[str, Any]:
    return {
        "scene_id": "scene0050_00",
        "question_type": "N/A",
        "answer_type": "other",
        "question_id": number,
        "answers": [{"answer": "piano", "answer_confidence": "yes", "answer_id": 1}],
        "rotation": {"_x": 0, "_y": 0, "_z": -0.6, "_w": 0.8},
        "position": {"x": 0.7, "y": -0.03, "z": 0},
    } | changes


def sqa3d(folder: Path, questions: list[Any], annotations: list[Any] | None) -> Path:
    path = folder / "v1_balanced_questions_test_scannetv2.json"
    path.write_text(json.dumps({"info": {}, "questions": questions}))
    if annotations is not None:
        other = folder / "v1_balanced_sqa_annotations_test_scannetv2.json"
        other.write_text(json.dumps({"info": {}, "annotations": annotations}))
    return path


def scanqa(folder: Path, content: Any) -> Path:
    path = folder / "ScanQA_v1.0_val.json"
    path.write_text(json.dumps(content))
    return path


def test_scanqa_is_read_as_it_is_published(tmp_path: Path) -> None:
    (read,) = read_questions(scanqa(tmp_path, [entry()]))
    assert read == Question(
        dataset="scanqa",
        id="val-scene0300-18",
        scene="scene0300_00",
        text="How many legs does the chair have?",
        answers=("4", "4"),
        object_ids=(7, 8),
        object_names=("chair", "chair"),
    )


def test_a_test_set_has_no_answers_and_is_read_where_none_are_needed(tmp_path: Path) -> None:
    bare = {name: value for name, value in entry().items() if name in ("scene_id", "question_id", "question")}
    path = scanqa(tmp_path, [bare])
    assert read_questions(path, answered=False)[0].answers == ()
    with pytest.raises(InputError, match="1 of 1 questions have no answers, such as val-scene0300-18"):
        read_questions(path)


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    questions = read_questions(scanqa(tmp_path, [entry(), entry(question_id="b", answers=["é"])]))
    write_scanqa(tmp_path / "again.json", questions)
    assert read_questions(tmp_path / "again.json") == questions
    with pytest.raises(InputError, match="one question_id: b"):
        write_scanqa(tmp_path / "again.json", [questions[1], questions[1]])


def test_sqa3d_finds_the_answers_beside_the_questions(tmp_path: Path) -> None:
    path = sqa3d(tmp_path, [question(1), question(2)], [annotation(2), annotation(1, answers=[{"answer": "tv"}])])
    first, second = read_questions(path)
    assert (first.id, first.answers, second.answers) == ("1", ("tv",), ("piano",))
    assert (first.situation, first.position) == ("I am standing by the ottoman.", (0.7, -0.03, 0.0))
    # Quaternions are wxyz inside, and the file writes the parts by name.
    assert first.rotation == (0.8, 0, 0, -0.6)
    assert read_questions(path, answered=False)[0].answers == ()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([entry(question_id="a"), entry(question_id="a")], "entries 0 and 1 have one question_id: a"),
        ([entry(answers=[4])], r"entry 0: answers\[0\] must be a text, got 4"),
        ([entry(), entry(question_id="b", answers=[])], "1 of 2 questions have no answers, such as b"),
        ([entry(object_ids=["seven"])], r"entry 0: object_ids\[0\] must be a whole number"),
        ([entry(object_ids=7)], "entry 0: object_ids must be a list"),
        ([entry(answer_top10=["4"])], "entry 0: expected a question, got answer_top10: these are predictions"),
        ({"annotations": []}, "these are SQA3D's annotations: give the file of questions"),
        ({}, "expected ScanQA's list of questions or SQA3D's object"),
    ],
)
def test_a_wrong_entry_of_scanqa_is_named(tmp_path: Path, content: Any, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read_questions(scanqa(tmp_path, content))
    assert len(str(caught.value)) < 600
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("questions", "annotations", "message"),
    [
        ([question(1)], [annotation(1), annotation(1)], "annotations_test_scannetv2.json: entries 0 and 1 have one"),
        ([question(1)], [], "1 of these have no annotation and 0 annotations no question, such as 1"),
        ([question(1)], [annotation(1), annotation(5)], "0 of these have no annotation and 1 annotations"),
        ([question(1)], [annotation(1, scene_id="scene1")], "about scene0050_00, and its annotation about scene1"),
        ([question(1)], [annotation(1, answers=[])], r"annotations\[0\]: answers must be a list of objects"),
        ([question(1)], [annotation(1, position={"x": 1})], r"position.y must be a number, got nothing"),
        ([question(1)], None, "no answers beside it; expected a file called like it"),
        ([question(1, situation="")], [annotation(1)], r"questions\[0\]: situation is empty"),
    ],
)
def test_files_of_sqa3d_must_belong_together(tmp_path, questions, annotations, message):
    with pytest.raises(InputError, match=message):
        read_questions(sqa3d(tmp_path, questions, annotations))
