"""Question sets of benchmarks: recognized by content, and answered in their own forms."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.labels.files import box_corners
from gsencoder.infer.ask.ask import Question
from gsencoder.infer.ask.batch import predictions, short_answer
from gsencoder.infer.ask.questions import QuestionSet, is_question_set, read_question_set

LOW, HIGH = (0.0, 1.0, 2.0), (1.0, 3.0, 2.5)
SCANQA = [
    {"scene_id": "a", "question_id": "q1", "question": "What is on the table?", "answers": ["mug"]},
    {"scene_id": "b", "question_id": "q2", "question": "Where is the mug?"},
]
SQA3D = {
    "questions": [{"scene_id": "a", "situation": "I sit.", "question": "What is left?", "question_id": 220602000002}]
}
SCANREFER = [
    {
        "scene_id": "a",
        "object_id": "8",
        "object_name": "file_cabinet",
        "ann_id": number,
        "description": f"the cabinet {number}",
        "token": ["the"],
        "bbox": box_corners(LOW, HIGH),
    }
    for number in ("0", "1")
]
SCAN2CAP = {"a": [{"box": box_corners(LOW, HIGH), "caption": "old", "obj_prob": [0.25, 0.75], "sem_prob": [1.0]}]}


def written(tmp_path: Path, content: Any) -> Path:
    path = tmp_path / "set.json"
    path.write_text(json.dumps(content))
    return path


def read(tmp_path: Path, content: Any, **settings: Any) -> QuestionSet:
    path = written(tmp_path, content)
    assert is_question_set(path)
    return read_question_set(path, **settings)


def answers(question_set: QuestionSet, **row: Any) -> Any:
    targets = [{"aabb_min": [0, 1, 2], "aabb_max": [1, 3, 2.5]}]
    return predictions(question_set.benchmark, [(each, {"targets": targets} | row) for each in question_set.questions])


def test_questions_of_scanqa_are_answered(tmp_path: Path) -> None:
    question_set = read(tmp_path, SCANQA)
    assert question_set.benchmark == "scanqa"
    assert question_set.scenes() == {"a": 1, "b": 1}
    (first,) = question_set.of_scene("a")
    assert first.question.question == Question(text="What is on the table?")
    assert answers(question_set, answer="<think>Hm.</think> A red Mug. ")[0] == {
        "scene_id": "a",
        "question_id": "q1",
        "answer_top10": ["a red mug"],
        "bbox": box_corners(LOW, HIGH),
    }
    assert "bbox" not in answers(question_set, answer="x", targets=[])[0]


def test_situations_of_sqa3d_are_said_before_the_question(tmp_path: Path) -> None:
    question_set = read(tmp_path, SQA3D)
    assert question_set.benchmark == "sqa3d"
    assert question_set.questions[0].question.question.text == "I sit. What is left?"
    assert answers(question_set, answer="Chair") == [
        {"scene_id": "a", "question_id": "220602000002", "situation": "I sit.", "question": "What is left?"}
        | {"answer": "chair"}
    ]


def test_descriptions_of_scanrefer_are_grounded(tmp_path: Path) -> None:
    question_set = read(tmp_path, SCANREFER)
    assert question_set.benchmark == "scanrefer"
    assert question_set.questions[1].question.question == Question(text="the cabinet 1", task="ground")
    other = {"aabb_min": (5, 5, 5), "aabb_max": (6, 6, 6)}
    targets = [other, {"aabb_min": LOW, "aabb_max": HIGH}]
    keys = {"scene_id": "a", "object_id": "8", "ann_id": "1"}
    meant, missed = box_corners(LOW, HIGH), box_corners((5.0, 5.0, 5.0), (6.0, 6.0, 6.0))
    assert answers(question_set, answer="2", mark=2, targets=targets)[1] == keys | {
        "bbox": meant,
        "bboxes": [meant, missed],
    }
    nothing = keys | {"bbox": None, "bboxes": []}
    assert answers(question_set, answer="0", mark=0, targets=targets)[1] == nothing
    assert answers(question_set, answer="?", mark=None, targets=targets)[1] == nothing
    assert predictions("scanrefer", [], question_set.questions)[1] == nothing
    assert predictions("scanqa", [], question_set.questions) == []


def test_objects_of_scanrefer_are_captioned_once_each_in_the_boxes_of_the_file(tmp_path: Path) -> None:
    question_set = read(tmp_path, SCANREFER, task="caption")
    assert question_set.benchmark == "scan2cap"
    (question,) = question_set.questions
    assert question.question.question == Question(task="caption", aabb=(*LOW, *HIGH))
    (caption,) = answers(question_set, answer="A cabinet. It is gray.")["a"]
    assert caption["caption"] == "sos a cabinet . it is gray . eos"
    np.testing.assert_allclose(caption["box"], box_corners(LOW, HIGH))
    assert caption["obj_prob"] == [0.0, 1.0]
    assert sum(caption["sem_prob"]) == pytest.approx(1)


def test_boxes_of_scan2cap_are_captioned_and_keep_their_probabilities(tmp_path: Path) -> None:
    question_set = read(tmp_path, SCAN2CAP)
    (caption,) = answers(question_set, answer="New")["a"]
    assert caption == SCAN2CAP["a"][0] | {"caption": "sos new eos", "box": caption["box"]}


def test_boxes_of_another_file_stand_in_for_those_of_the_set(tmp_path: Path) -> None:
    boxes = tmp_path / "boxes.json"
    other = {"box": box_corners((5.0, 5.0, 5.0), (6.0, 6.0, 6.0))}
    boxes.write_text(json.dumps({"a": [other, other], "c": [other]}))
    bare = [{key: value for key, value in row.items() if key != "bbox"} for row in SCANREFER]
    with pytest.warns(SceneWarning) as said:
        question_set = read(tmp_path, [*bare, {**bare[0], "scene_id": "b"}], task="caption", proposals=str(boxes))
    assert [str(each.message).partition("proposals: ")[2] for each in said] == [
        f"{boxes} has no boxes in 1 scene, of which there are no captions: b",
        f"{tmp_path / 'set.json'} describes no object of 1 scene, of which there are no captions: c",
    ]
    with pytest.raises(InputError, match="has boxes in a, c, and .* describes objects of d; expected the same scenes"):
        read(tmp_path, [{**bare[0], "scene_id": "d"}], task="caption", proposals=str(boxes))
    assert [each.question.question.aabb for each in question_set.questions] == [(5.0, 5.0, 5.0, 6.0, 6.0, 6.0)] * 2
    assert len({each.question.id for each in question_set.questions}) == 2
    localized = read(tmp_path, bare, task="caption", proposals="localize")
    assert localized.names == {"a": ("file cabinet",)}
    assert localized.scenes() == {"a": 1}
    with pytest.raises(InputError, match="2 of 2 descriptions have no bbox"):
        read(tmp_path, bare, task="caption")


@pytest.mark.parametrize(
    ("content", "settings", "problem"),
    [
        (SCANQA, {"task": "ground"}, "holds ScanQA's questions; expected task=answer"),
        (SQA3D, {"task": "caption"}, "holds SQA3D's questions"),
        (SCAN2CAP, {"task": "ground"}, "Scan2Cap's boxes"),
        (SCANQA, {"proposals": "localize"}, "are for captions"),
        ([], {}, "holds none"),
        ([1], {}, "entry 0: expected an object"),
        ({"a": 3}, {}, "got an object with a, and no list of boxes as a"),
        ({"results": {"em": 1}, "seconds": 2}, {}, "expected a list of ScanQA's.*got an object with results, seconds"),
        ({"a|3|chair": ["sos a chair eos"]}, {}, "no list of boxes as a|3|chair"),
        ({"a": [{"box": [1, 2, 3]}]}, {}, "8 corners"),
        ({"a": [{"box": [1, 2]}]}, {}, r"box\[0\] must be a corner"),
        ({"annotations": []}, {}, "these are SQA3D's annotations"),
        ([{"scene_id": "a", "question_id": "1", "answer_top10": ["x"]}], {}, "these are predictions"),
        ([*SCANQA, SCANQA[0]], {}, "one question_id"),
    ],
)
def test_what_is_no_question_set_is_an_error(
    tmp_path: Path, content: Any, settings: dict[str, Any], problem: str
) -> None:
    with pytest.raises(InputError, match=problem):
        read(tmp_path, content, **settings)


def test_lines_of_questions_are_no_set(tmp_path: Path) -> None:
    path = tmp_path / "lines.jsonl"
    for text in ('{"question": "a"}', '{"question": "a"}\n{"question": "b"}\n', "", "{", '{"query": "mug"}', "x"):
        path.write_text(text)
        assert not is_question_set(path)
    assert not is_question_set(tmp_path / "none")
    path.write_text("\n\ufeff[1")
    assert is_question_set(path)


def test_answers_lose_case_thoughts_and_the_last_full_stop() -> None:
    assert short_answer("<think>A? B.</think>\n The  Mug on\nthe table.") == "the mug on the table"
    assert short_answer("3.5") == "3.5"
