"""Question sets of benchmarks: recognized by content, and answered in their own forms."""

import json
from pathlib import Path
from typing import Any

import pytest

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.labels.files import box_corners
from gsencoder.infer.ask.ask import Question
from gsencoder.infer.ask.batch import predictions, short_answer, target_corners
from gsencoder.infer.ask.questions import QuestionSet, caption_question, is_question_set, read_question_set

LOW, HIGH = (0.0, 1.0, 2.0), (1.0, 3.0, 2.5)
SCANQA = [
    {"scene_id": "a", "question_id": "q1", "question": "What is on the table?", "answers": ["mug"]},
    {"scene_id": "b", "question_id": "q2", "question": "Where is the mug?"},
]
SQA3D = {
    "questions": [{"scene_id": "a", "situation": "I sit.", "question": "What is left?", "question_id": 220602000002}]
}


def described(number: int | str, scene: str = "a", name: str = "x", **changes: Any) -> dict[str, Any]:
    keys = {"scene_id": scene, "object_id": number, "object_name": name, "ann_id": "0", "description": f"d {number}"}
    return keys | {"token": ["d"]} | changes


SCANREFER = [
    described("8", ann_id=number, description=f"the cabinet {number}", bbox=box_corners(LOW, HIGH)) for number in "01"
]
SCAN2CAP = {"a": [{"box": box_corners(LOW, HIGH), "caption": "old", "obj_prob": [0.25, 0.75], "sem_prob": [1.0]}]}


def read(tmp_path: Path, content: Any, **settings: Any) -> QuestionSet:
    path = tmp_path / "set.json"
    path.write_text(json.dumps(content))
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
    assert first.question == Question(text="What is on the table?")
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
    assert question_set.questions[0].question.text == "I sit. What is left?"
    assert answers(question_set, answer="Chair") == [
        {"scene_id": "a", "question_id": "220602000002", "situation": "I sit.", "question": "What is left?"}
        | {"answer": "chair"}
    ]


def test_descriptions_of_scanrefer_are_grounded(tmp_path: Path) -> None:
    question_set = read(tmp_path, SCANREFER)
    assert question_set.benchmark == "scanrefer"
    assert question_set.questions[1].question == Question(text="the cabinet 1", task="ground")
    other = {"aabb_min": (5, 5, 5), "aabb_max": (6, 6, 6)}
    targets = [other, {"aabb_min": LOW, "aabb_max": HIGH}]
    keys = {"scene_id": "a", "object_id": "8", "ann_id": "1"}
    meant, missed = box_corners(LOW, HIGH), box_corners((5.0, 5.0, 5.0), (6.0, 6.0, 6.0))
    found = keys | {"bbox": meant, "bboxes": [meant, missed]}
    assert answers(question_set, answer="2", mark=2, targets=targets)[1] == found
    nothing = keys | {"bbox": None, "bboxes": []}
    assert answers(question_set, answer="0", mark=0, targets=targets)[1] == nothing
    assert answers(question_set, answer="?", mark=None, targets=targets)[1] == nothing
    assert predictions("scanrefer", [], question_set.questions)[1] == nothing
    assert predictions("scanqa", [], question_set.questions) == []


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
    assert [each.question.aabb for each in question_set.questions] == [(5.0, 5.0, 5.0, 6.0, 6.0, 6.0)] * 2
    assert len({each.id for each in question_set.questions}) == 2
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
def test_what_is_no_question_set_is_an_error(tmp_path, content, settings, problem):
    with pytest.raises(InputError, match=problem):
        read(tmp_path, content, **settings)


def test_answers_lose_case_thoughts_and_the_last_full_stop() -> None:
    assert short_answer("<think>A? B.</think>\n The  Mug on\nthe table.") == "the mug on the table"
    assert short_answer("3.5") == "3.5"


def target(low: float) -> dict[str, Any]:
    return {"aabb_min": [low, 0, -1], "aabb_max": [low + 1, 2, 3]}


def corners(low: float) -> list[list[float]]:
    return box_corners((float(low), 0.0, -1.0), (low + 1.0, 2.0, 3.0))


def test_captions_of_scenes_keep_their_boxes_and_the_even_probabilities_of_eighteen_classes() -> None:
    keyed = caption_question("b", "7", ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)), {"obj_prob": [0.5, 0.5]})
    bare = caption_question("a", "0", ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)), {})
    assert (keyed.scene, keyed.id, keyed.question.task) == ("b", "b/7", "caption")
    answered = [(keyed, {"answer": "Two", "targets": [target(2)]}), (bare, {"answer": "Five", "targets": [target(5)]})]
    rows = predictions("scan2cap", [*answered, (bare, {"answer": "Six", "targets": [target(6), target(0)]})])
    assert {scene: [(row["caption"], row["box"]) for row in found] for scene, found in rows.items()} == {
        "b": [("sos two eos", corners(2))],
        "a": [("sos five eos", corners(5)), ("sos six eos", corners(6))],
    }
    assert rows["b"][0]["obj_prob"] == [0.5, 0.5]
    assert rows["a"][0]["obj_prob"] == [0.0, 1.0]
    # ScanNet's benchmark has eighteen classes with instances.
    assert rows["a"][0]["sem_prob"] == [1 / 18] * 18
    assert target_corners(target(2)) == corners(2)


def test_each_object_is_captioned_once_in_its_own_box_and_only_in_scenes_that_are_asked_about(tmp_path: Path) -> None:
    rows = [described(4, bbox=corners(4)), described(2, bbox=corners(2)), described(4, ann_id="1", bbox=corners(4))]
    rows.append(described(4, "b", bbox=corners(9)))
    question_set = read(tmp_path, rows, task="caption")
    assert [(each.scene, each.id, each.question.aabb) for each in question_set.questions] == [
        ("a", "a/4", (4.0, 0.0, -1.0, 5.0, 2.0, 3.0)),
        ("a", "a/2", (2.0, 0.0, -1.0, 3.0, 2.0, 3.0)),
        ("b", "b/4", (9.0, 0.0, -1.0, 10.0, 2.0, 3.0)),
    ]
    assert question_set.scenes() == {"a": 2, "b": 1}
    assert [each.id for each in question_set.of_scene("a")] == ["a/4", "a/2"]
    with pytest.raises(InputError, match="1 of 5 descriptions have no bbox"):
        read(tmp_path, [*rows, described(7)], task="caption")


def test_names_that_are_localized_are_each_once_in_every_scene(tmp_path: Path) -> None:
    rows = [described(1, name="office_chair"), described(2, name="lamp"), described(3, name="office_chair")]
    question_set = read(tmp_path, [*rows, described(1, "b", name="lamp")], task="caption", proposals="localize")
    assert question_set.names == {"a": ("office chair", "lamp"), "b": ("lamp",)}
    assert (question_set.questions, question_set.scenes()) == ((), {"a": 2, "b": 1})


def test_a_set_is_one_value_that_is_no_question(tmp_path: Path) -> None:
    sets = ('{"a": []}', '\ufeff\n {"questions": []}', "[", " " * 63 + "[]")
    others = ('{"query": "mug"}', '{"aabb": [0, 0, 0, 1, 1, 1]}', '{"a": 1}\n{"b": 2}', " " * 64 + "[]", "{", "")
    for text in (*sets, *others):
        (tmp_path / "s").write_text(text)
        assert is_question_set(tmp_path / "s") is (text in sets), text
