"""Files of expressions and questions: what is read, and what is refused with one line that names the entry."""

import csv
import json
import pickle
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from labeled_scans import group, write_scannet_labels
from questions import write_scanqa

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.labels.expressions import (
    Expression,
    boxes_from_labels,
    boxes_from_scans,
    read_nr3d,
    read_scanrefer,
    write_scanrefer,
)
from gsencoder.data.labels.questions import Question, read_questions
from gsencoder.data.labels.scans import read_scannet_labels

NR3D = {
    "assignmentid": "14",
    "stimulus_id": "scene0525_00-trash_can-3-8-10-14",
    "utterance": "The can, by the door.",
    "instance_type": "trash can",
    "scan_id": "scene0525_00",
    "target_id": "8",
    "tokens": "['the', 'can', 'by', \"o'clock\"]",
    "mentions_target_class": "True",
    "correct_guess": "FALSE",
}


def entry(**changes: Any) -> dict[str, Any]:
    return {
        "scene_id": "scene0011_00",
        "object_id": "34",
        "object_name": "coffee_table",
        "ann_id": "1",
        "description": "A brown table. It is low.",
        "token": ["a", "brown", "table", ".", "it", "is", "low", "."],
    } | changes


def written(folder: Path, content: Any, name: str = "ScanRefer_filtered_val.json") -> Path:
    (folder / name).write_text(json.dumps(content), encoding="utf-8")
    return folder / name


scanqa = partial(written, name="ScanQA_v1.0_val.json")


def nr3d(folder: Path, *rows: dict[str, str]) -> Path:
    path = folder / "nr3d.csv"
    with open(path, "w", newline="", encoding="utf-8") as stream:
        table = csv.DictWriter(stream, list(rows[0]))
        table.writeheader()
        table.writerows(rows)
    return path


def test_scanrefer_is_read_as_it_is_published(tmp_path: Path) -> None:
    corners = [[1, 0, 3], [1, -1, 3], [0, -1, 3], [0, 0, 3], [1, 0, 2], [1, -1, 2], [0, -1, 2], [0, 0, 2.5]]
    path = written(tmp_path, [entry(), entry(ann_id="2", object_id=7, bbox=corners)])
    first, second = read_scanrefer(path)
    assert first.key == ("scene0011_00", 34, "1")
    assert (first.object_name, first.text, first.tokens[1]) == ("coffee_table", "A brown table. It is low.", "brown")
    assert first.aabb is None
    assert second.aabb == ((0, -1, 2), (1, 0, 3))


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    one = Expression(scene="s", object_id=0, object_name="x", annotation="0", text="é x", tokens=("é", "x"))
    expressions = (one, replace(one, object_id=1, aabb=((0.25, -1.0, 2.0), (0.5, 1.0, 3.0))))
    write_scanrefer(tmp_path / "a.json", expressions)
    assert read_scanrefer(tmp_path / "a.json") == expressions
    with pytest.raises(InputError, match="entries 0 and 2 have one id: sentence 0 about object 0 of s;"):
        write_scanrefer(tmp_path / "a.json", [*expressions, expressions[0]])


def test_nr3d_is_read_as_it_is_published(tmp_path: Path) -> None:
    (row,) = read_nr3d(nr3d(tmp_path, NR3D))
    assert row.key == ("scene0525_00", 8, "14")
    assert row.tokens == ("the", "can", "by", "o'clock")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"questions": []}, "expected a list of expressions.*swapped"),
        ([entry(), {"scene_id": "s", "aabb": []}], "entry 1: expected an expression.*got aabb: these are predictions"),
        ([entry(scene_id="../x")], "entry 0: the scene must be a name"),
        ([entry(object_id="x")], "entry 0: object_id must be a whole number from 0, got 'x'"),
        ([entry(token=["a", 3])], r"entry 0: token\[1\] must be a text, got 3"),
        ([entry(bbox=[[0, 0, 0]])], "entry 0: bbox must be a list of 8 corners"),
        ([entry(), entry()], "entries 0 and 1 have one id: sentence 1 about object 34 of scene0011_00"),
        ([entry(), entry(ann_id="2", object_name="lamp")], "give object 34 of scene0011_00 different names"),
    ],
)
def test_a_wrong_entry_of_scanrefer_is_named(tmp_path: Path, content: Any, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read_scanrefer(written(tmp_path, content))
    assert "\n" not in str(caught.value)
    assert "ScanRefer_filtered_val.json" in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"tokens": "__import__('os').getcwd()"}, "line 2: tokens must be a list of words"),
        ({"tokens": "[1]"}, r"line 2: tokens\[0\] must be a text"),
        ({"target_id": "8.5"}, "line 2: target_id must be a whole number"),
        ({"utterance": "x" * 200_000}, "not a readable table"),
    ],
)
def test_a_wrong_row_of_nr3d_is_named(tmp_path: Path, changes: dict[str, str], message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_nr3d(nr3d(tmp_path, NR3D | changes))


def test_a_table_with_other_columns_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="its first line lacks tokens"):
        read_nr3d(nr3d(tmp_path, {name: value for name, value in NR3D.items() if name != "tokens"}))
    with pytest.raises(InputError, match="entries 0 and 1 have one id: sentence 14 about object 8 of scene0525_00"):
        read_nr3d(nr3d(tmp_path, NR3D, NR3D))
    path = nr3d(tmp_path, NR3D)
    path.write_text(path.read_text() + "1,2\n")
    with pytest.raises(InputError, match="line 3: "):
        read_nr3d(path)
    path.write_text("a,a\n")
    with pytest.raises(InputError, match="lacks assignmentid"):
        read_nr3d(path)


def test_files_that_are_no_json_lists_are_named_and_pickles_are_not_loaded(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    for content, problem in (
        (b'[{"scene_id": "a", "scene_id": "b"}]', "'scene_id' is there twice"),
        (b"\xff\xfe", "not a readable JSON file"),
        (b"[" * 100_000, "not a readable JSON file"),
        (pickle.dumps({"a": 1}), "is a pickle"),
    ):
        path.write_bytes(content)
        with pytest.raises(InputError, match=problem):
            read_scanrefer(path)
    assert read_scanrefer(written(tmp_path, [])) == ()


ALIGNMENT = np.array([[0, -1, 0, 10], [1, 0, 0, 0], [0, 0, 1, -1], [0, 0, 0, 1]], np.float64)
VERTICES = np.array([[1, 2, 3], [4, 6, 8], [0, 0, 0], [7, 7, 7], [9, 9, 9]], np.float32)
STATED = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))


def meaning(number: int, scene: str = "s0", **changes: object) -> Expression:
    made = Expression(scene=scene, object_id=number, object_name="x", annotation="0", text="it", tokens=("it",))
    return replace(made, **changes)  # type: ignore[arg-type]


def write_scan(folder: Path, alignment: np.ndarray | None = ALIGNMENT) -> Path:
    """Object 2 has the first two vertices, 0 the third, 1 the fourth, which the last, 5, has as well."""
    groups = [group(2, "a", [10]), group(0, "b", [20]), group(1, "c", [30]), group(5, "d", [30, 40])]
    segments = np.array([10, 10, 20, 30, 40])
    return write_scannet_labels(folder, folder.name, VERTICES, segments, groups, alignment=alignment)


def test_the_box_is_that_of_the_meant_objects_vertices_in_the_aligned_axes(tmp_path: Path) -> None:
    labels = read_scannet_labels(write_scan(tmp_path / "s0"))
    boxes = boxes_from_labels([meaning(2), meaning(0), meaning(1), meaning(5), meaning(2, aabb=STATED)], labels)
    # All vertices of object 1 belong to object 5.
    expected = [((4, 1, 2), (8, 4, 7)), ((10, 0, -1), (10, 0, -1)), None, ((1, 7, 6), (3, 9, 8)), STATED]
    assert [each.aabb for each in boxes] == expected
    assert [each.object_id for each in boxes] == [2, 0, 1, 5, 2]
    with pytest.raises(InputError, match="s0: its labels have no object with the objectId 3"):
        boxes_from_labels([meaning(3)], labels)


def test_expressions_of_several_scans_stay_in_order_and_scans_that_nothing_needs_are_not_read(tmp_path: Path) -> None:
    write_scan(tmp_path / "s0")
    write_scan(tmp_path / "s1", alignment=None)
    nowhere = meaning(0, "nowhere", aabb=STATED)
    expressions = [meaning(0, "s1"), meaning(2, "s0"), nowhere, meaning(2, "s1"), meaning(0, "s0")]
    with pytest.warns(SceneWarning, match="axisAlignment"):
        boxes = boxes_from_scans(expressions, tmp_path)
    assert [(each.scene, each.object_id) for each in boxes] == [(each.scene, each.object_id) for each in expressions]
    lower = [(0, 0, 0), (4, 1, 2), (0, 0, 0), (1, 2, 3), (10, 0, -1)]
    assert [each.aabb and each.aabb[0] for each in boxes] == lower
    assert boxes_from_scans([], tmp_path) == ()
    with pytest.raises(InputError, match="nowhere: no annotation of ScanNet"):
        boxes_from_scans([meaning(0, "nowhere")], tmp_path)


def asked(**changes: Any) -> dict[str, Any]:
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


def test_scanqa_is_read_as_it_is_published(tmp_path: Path) -> None:
    (read,) = read_questions(scanqa(tmp_path, [asked()]))
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
    bare = {name: value for name, value in asked().items() if name in ("scene_id", "question_id", "question")}
    path = scanqa(tmp_path, [bare])
    assert read_questions(path, answered=False)[0].answers == ()
    with pytest.raises(InputError, match="1 of 1 questions have no answers, such as val-scene0300-18"):
        read_questions(path)


def test_written_questions_are_read_again(tmp_path: Path) -> None:
    questions = read_questions(scanqa(tmp_path, [asked(), asked(question_id="b", answers=["é"])]))
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
        ([asked(question_id="a"), asked(question_id="a")], "entries 0 and 1 have one question_id: a"),
        ([asked(answers=[4])], r"entry 0: answers\[0\] must be a text, got 4"),
        ([asked(), asked(question_id="b", answers=[])], "1 of 2 questions have no answers, such as b"),
        ([asked(object_ids=["seven"])], r"entry 0: object_ids\[0\] must be a whole number"),
        ([asked(object_ids=7)], "entry 0: object_ids must be a list"),
        ([asked(answer_top10=["4"])], "entry 0: expected a question, got answer_top10: these are predictions"),
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
        ([question(1)], None, "no answers next to it; expected a file called like it"),
        ([question(1, situation="")], [annotation(1)], r"questions\[0\]: situation is empty"),
    ],
)
def test_files_of_sqa3d_must_belong_together(tmp_path, questions, annotations, message):
    with pytest.raises(InputError, match=message):
        read_questions(sqa3d(tmp_path, questions, annotations))
