"""Predictions of question sets: each answer goes with the box, the keys and the scene of its own question."""

import json
from pathlib import Path
from typing import Any

import pytest

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.labels.expressions import wrapped_caption
from gsencoder.data.labels.files import box_corners
from gsencoder.infer.ask.ask import Question
from gsencoder.infer.ask.batch import answer_text, predictions, short_answer, target_corners
from gsencoder.infer.ask.questions import QuestionSet, caption_question, is_question_set, read_question_set


def target(low: float) -> dict[str, Any]:
    return {"aabb_min": [low, 0, -1], "aabb_max": [low + 1, 2, 3]}


def corners(low: float) -> list[list[float]]:
    return box_corners((float(low), 0.0, -1.0), (low + 1.0, 2.0, 3.0))


def described(number: int, scene: str = "a", name: str = "x", **changes: Any) -> dict[str, Any]:
    keys = {"scene_id": scene, "object_id": number, "object_name": name, "ann_id": "0", "description": f"d {number}"}
    return keys | {"token": ["d"]} | changes


def read(folder: Path, content: Any, **settings: Any) -> QuestionSet:
    path = folder / "set.json"
    path.write_text(json.dumps(content))
    return read_question_set(path, **settings)


def test_the_meant_box_comes_first_and_the_others_in_their_order(tmp_path: Path) -> None:
    (question,) = read(tmp_path, [described(4)]).questions
    assert question.question.id == "a/4/0"
    targets = [target(0), target(5), target(9)]
    for mark, order in ((1, (0, 5, 9)), (2, (5, 0, 9)), (3, (9, 0, 5))):
        (row,) = predictions("scanrefer", [(question, {"mark": mark, "targets": targets})])
        assert (row["bbox"], row["bboxes"]) == (corners(order[0]), [corners(low) for low in order])
        assert (row["scene_id"], row["object_id"], row["ann_id"]) == ("a", "4", "0")


def test_answers_have_the_box_of_the_best_target_and_unanswered_descriptions_come_last(tmp_path: Path) -> None:
    questions = read(tmp_path, [{"scene_id": "a", "question_id": "q", "question": "What?"}]).questions
    (row,) = predictions("scanqa", [(questions[0], {"answer": "A.", "targets": [target(3), target(0)]})])
    assert row == {"scene_id": "a", "question_id": "q", "answer_top10": ["a"], "bbox": corners(3)}
    first, second = read(tmp_path, [described(1), described(2)]).questions
    rows = predictions("scanrefer", [(second, {"mark": 1, "targets": [target(0)]})], [first])
    assert [(each["object_id"], len(each["bboxes"])) for each in rows] == [("2", 1), ("1", 0)]


def test_captions_of_scenes_keep_their_boxes_and_the_even_probabilities_of_eighteen_classes() -> None:
    keyed = caption_question("b", "7", ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)), {"obj_prob": [0.5, 0.5]})
    bare = caption_question("a", "0", ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)), {})
    assert (keyed.scene, keyed.question.id, keyed.question.question.task) == ("b", "b/7", "caption")
    rows = predictions(
        "scan2cap",
        [
            (keyed, {"answer": "Two", "targets": [target(2)]}),
            (bare, {"answer": "Five", "targets": [target(5)]}),
            (bare, {"answer": "Six", "targets": [target(6), target(0)]}),
        ],
    )
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
    rows = [
        described(4, bbox=corners(4)),
        described(2, bbox=corners(2)),
        described(4, ann_id="1", bbox=corners(4)),
        described(4, "b", bbox=corners(9)),
    ]
    question_set = read(tmp_path, rows, task="caption")
    assert [(each.scene, each.question.id, each.question.question.aabb) for each in question_set.questions] == [
        ("a", "a/4", (4.0, 0.0, -1.0, 5.0, 2.0, 3.0)),
        ("a", "a/2", (2.0, 0.0, -1.0, 3.0, 2.0, 3.0)),
        ("b", "b/4", (9.0, 0.0, -1.0, 10.0, 2.0, 3.0)),
    ]
    assert question_set.scenes() == {"a": 2, "b": 1}
    assert [each.question.id for each in question_set.of_scene("a")] == ["a/4", "a/2"]
    boxes = tmp_path / "boxes.json"
    boxes.write_text(json.dumps({"c": [{"box": corners(1)}], "b": [{"box": corners(3)}, {"box": corners(8)}]}))
    with pytest.warns(SceneWarning, match="no captions"):
        proposed = read(tmp_path, rows, task="caption", proposals=str(boxes))
    assert [(each.question.id, each.question.question.aabb) for each in proposed.questions] == [
        ("b/0", (3.0, 0.0, -1.0, 4.0, 2.0, 3.0)),
        ("b/1", (8.0, 0.0, -1.0, 9.0, 2.0, 3.0)),
    ]
    with pytest.raises(InputError, match="1 of 5 descriptions have no bbox"):
        read(tmp_path, [*rows, described(7)], task="caption")


def test_names_that_are_localized_are_each_once_in_every_scene(tmp_path: Path) -> None:
    rows = [described(1, name="office_chair"), described(2, name="lamp"), described(3, name="office_chair")]
    question_set = read(tmp_path, [*rows, described(1, "b", name="lamp")], task="caption", proposals="localize")
    assert question_set.names == {"a": ("office chair", "lamp"), "b": ("lamp",)}
    assert (question_set.questions, question_set.scenes()) == ((), {"a": 2, "b": 1})


def test_questions_without_a_situation_are_named_by_their_id_alone(tmp_path: Path) -> None:
    content = {"questions": [{"scene_id": "a", "situation": "I sit.", "question": "Left?", "question_id": 3}]}
    (question,) = read(tmp_path, content).questions
    assert question.keys == {"scene_id": "a", "question_id": "3", "situation": "I sit.", "question": "Left?"}
    assert (question.scene, question.question.id) == ("a", "3")
    (question,) = read(tmp_path, [{"scene_id": "b", "question_id": "q", "question": "Left?"}]).questions
    assert question.keys == {"scene_id": "b", "question_id": "q"}
    assert question.question.question == Question(text="Left?")
    assert [each.task for each in (read(tmp_path, [described(1)]).questions[0].question.question,)] == ["ground"]
    with pytest.raises(InputError, match="task=answer or ground or caption|expected task="):
        read(tmp_path, content, task="ground")


@pytest.mark.parametrize(
    ("text", "one"),
    [
        ('{"a": []}', True),
        ('\ufeff\n {"questions": []}', True),
        ("[", True),
        ('{"query": "mug"}', False),
        ('{"aabb": [0, 0, 0, 1, 1, 1]}', False),
        ('{"a": 1}\n{"b": 2}', False),
        (" " * 64 + "[]", False),
        (" " * 63 + "[]", True),
    ],
)
def test_a_set_is_one_value_that_is_no_question(tmp_path: Path, text: str, one: bool) -> None:
    (tmp_path / "s").write_text(text)
    assert is_question_set(tmp_path / "s") is one


def test_what_was_said_is_on_one_line_and_loses_thoughts_and_the_last_stops() -> None:
    assert answer_text("<think>no</think>  A\n b. ") == "A b."
    assert short_answer("It is 3.5. ..") == "it is 3.5."
    assert short_answer("...") == ""
    assert wrapped_caption("it is. it is.") == "sos it is . it is . eos"
