"""Sheets of a scripted answerer from a dry run: each picture and mark has the truth of its own view and target."""

import base64
import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from splats import random_gaussians

from gsencoder.data.labels.expressions import Expression
from gsencoder.data.labels.questions import Question
from gsencoder.evaluate.stand_in_vlm import (
    AnswerSheet,
    Fact,
    PictureTruth,
    add_expressions,
    add_pictures,
    add_questions,
    request_digest,
)
from gsencoder.infer.ask.batch import ANSWERS, REQUEST
from gsencoder.types import Scene


class Truth(PictureTruth):
    """A truth in which a view's number is its only object, and a box's lower x its instance."""

    def __init__(self) -> None:
        self.scene = Scene(name="room", gaussians=random_gaussians(1))

    def pixels(self, row: Mapping[str, Any]) -> dict[int, int]:
        return {row["frame"]: 100 + row["frame"]}

    def instance_in(self, lower: Sequence[float], upper: Sequence[float]) -> int:
        assert lower[0] <= upper[0]
        return int(lower[0])


def digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def answered(folder: Path, name: str, pictures: list[bytes], targets: list[float]) -> dict[str, Any]:
    """What `ask` writes of one question: a request with pictures before its text, and a row."""
    parts: list[dict[str, Any]] = [
        {"type": "image_url", "image_url": {"url": "data:image/png;base64," + base64.b64encode(each).decode()}}
        for each in pictures
    ]
    (folder / name).mkdir()
    body = {"messages": [{"role": "user", "content": [*parts, {"type": "text", "text": "x"}]}]}
    (folder / name / REQUEST).write_text(json.dumps(body))
    return {
        "id": name,
        "folder": name,
        "views": [{"frame": each[0]} for each in pictures],
        "targets": [{"aabb_min": [x, 0, 0], "aabb_max": [x + 1, 1, 1]} for x in targets],
    }


def test_pictures_and_marks_of_a_dry_run_have_the_truth_of_their_views_and_targets(tmp_path: Path) -> None:
    first, second, third = b"\x04a", b"\x02b", b"\x03c"
    rows = [answered(tmp_path, "q0", [first, second], [5.0, 0.0, 2.0]), answered(tmp_path, "q1", [third], [])]
    (tmp_path / ANSWERS).write_text("".join(json.dumps(row) + "\n" for row in rows))
    sheet = AnswerSheet()
    add_pictures(sheet, tmp_path, Truth())
    assert {name: dict(each.pixels) for name, each in sheet.pictures.items()} == {
        digest(first): {4: 104},
        digest(second): {2: 102},
        digest(third): {3: 103},
    }
    assert {each.scene for each in sheet.pictures.values()} == {"room"}
    assert sheet.marks == {
        request_digest([digest(first), digest(second)]): (5, 0, 2),
        request_digest([digest(third)]): (),
    }


def test_a_dry_run_with_another_number_of_pictures_than_of_views_is_refused(tmp_path: Path) -> None:
    row = answered(tmp_path, "q0", [b"\x04a", b"\x02b"], [])
    (tmp_path / ANSWERS).write_text(json.dumps(row | {"views": row["views"][:1]}) + "\n")
    with pytest.raises(ValueError, match="zip"):
        add_pictures(AnswerSheet(), tmp_path, Truth())


def test_a_question_is_known_by_what_is_asked_and_needs_any_object_only_where_it_asks_for_presence() -> None:
    situated = Question(
        dataset="sqa3d", id="room-side-0", scene="room", text="Left?", answers=("yes", "y"), situation=" I sit."
    )
    presence = Question(
        dataset="scanqa",
        id="room-is_there-3",
        scene="room",
        text="Is there a mug? ",
        answers=("yes",),
        object_ids=(1, 2),
    )
    sheet = AnswerSheet()
    add_questions(sheet, [situated, presence])
    assert sheet.facts == {
        ("room", "I sit. Left?"): Fact(answer="yes", needed=(), any_of=False),
        ("room", "Is there a mug?"): Fact(answer="yes", needed=(1, 2), any_of=True),
    }


def test_the_first_description_of_an_object_is_its_caption() -> None:
    sheet = AnswerSheet()
    add_expressions(
        sheet,
        [
            Expression(scene="room", object_id=number, object_name="x", annotation=str(row), text=text, tokens=())
            for row, (number, text) in enumerate(((4, " a mug"), (4, "the cup"), (0, "a box")))
        ],
    )
    assert sheet.captions == {("room", 4): " a mug", ("room", 0): "a box"}
    assert sheet.facts["room", "the cup"] == Fact(answer="", needed=(4,))
    assert set(sheet.facts) == {("room", text) for text in ("a mug", "the cup", "a box")}
