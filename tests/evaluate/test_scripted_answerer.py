"""A scripted answerer says what is right exactly where the pictures show enough of what was asked about."""

import base64
import hashlib
import json
import urllib.error
import urllib.request
from typing import Any

import pytest
from scripted_answerer import (
    AnswerSheet,
    Fact,
    ScriptedAnswerer,
    SentPicture,
    add_expressions,
    add_questions,
    picture_digest,
    request_digest,
    request_pictures,
    serving,
)

from gsencoder.core.errors import InputError
from gsencoder.data.labels.expressions import Expression
from gsencoder.data.labels.questions import Question


def url(data: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(data).decode()


def request(text: str, *pictures: bytes, stream: bool = False) -> dict[str, Any]:
    parts: list[dict[str, Any]] = [{"type": "image_url", "image_url": {"url": url(each)}} for each in pictures]
    return {"messages": [{"role": "user", "content": [*parts, {"type": "text", "text": text}]}], "stream": stream}


def digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


NEAR, FAR, OTHER = b"near", b"far", b"other"


@pytest.fixture
def answerer() -> ScriptedAnswerer:
    """The mug, 1, is shown well in one picture, and the book, 2, in another; the lamp, 3, by 199 pixels."""
    sheet = AnswerSheet()
    sheet.pictures[digest(NEAR)] = SentPicture(scene="room", pixels={1: 200, 2: 10, 3: 199})
    sheet.pictures[digest(FAR)] = SentPicture(scene="room", pixels={1: 20, 2: 900})
    sheet.pictures[digest(OTHER)] = SentPicture(scene="hall", pixels={1: 900})
    made = (
        ("room-next_to-0", "What is next to the mug?", "book", (1, 2)),
        ("room-next_to-1", "What is next to the lamp?", "book", (3, 2)),
        ("room-is_there-0", "Is there a mug?", "yes", (1, 9)),
        ("room-is_there-1", "Is there a hat?", "no", ()),
    )
    add_questions(
        sheet,
        [
            Question(dataset="scanqa", id=name, scene="room", text=text, answers=(answer, "x"), object_ids=ids)
            for name, text, answer, ids in made
        ],
    )
    add_expressions(
        sheet,
        [
            Expression(
                scene="room", object_id=label, object_name="x", annotation=number, text=f"{text} {number}", tokens=()
            )
            for label, text in ((1, "the mug"), (3, "the lamp"))
            for number in ("0", "1")
        ],
    )
    for pictures in ((NEAR,), (NEAR, FAR)):
        sheet.marks[request_digest([digest(each) for each in pictures])] = (2, 1, 3, 1)
    return ScriptedAnswerer(sheet)


def asked(answerer: ScriptedAnswerer, line: str, *pictures: bytes) -> str:
    return answerer.reply(request(f"The pictures show one place.{line}", *pictures))


def test_an_answer_needs_each_of_its_objects_in_some_picture(answerer: ScriptedAnswerer) -> None:
    line = "\nQuestion: What is next to the mug?"
    assert asked(answerer, line, NEAR, FAR) == "book"
    assert asked(answerer, line, NEAR) == "unknown"
    assert asked(answerer, line, FAR) == "unknown"
    assert asked(answerer, "\nQuestion: What is next to the lamp?", NEAR, FAR) == "unknown"
    assert (answerer.requests, answerer.unknown_pictures, answerer.unknown_questions) == (4, 0, 0)


def test_pixels_of_several_pictures_do_not_add_up(answerer: ScriptedAnswerer) -> None:
    answerer.sheet.pictures[digest(b"lamp")] = SentPicture(scene="room", pixels={3: 199, 2: 900})
    line = "\nQuestion: What is next to the lamp?"
    assert asked(answerer, line, NEAR, b"lamp", FAR) == "unknown"
    answerer.sheet.pictures[digest(b"lamp")] = SentPicture(scene="room", pixels={3: 200, 2: 900})
    assert asked(answerer, line, NEAR, b"lamp", FAR) == "book"


def test_presence_needs_one_object_and_absence_none(answerer: ScriptedAnswerer) -> None:
    assert asked(answerer, "\nQuestion: Is there a mug?", NEAR) == "yes"
    assert asked(answerer, "\nQuestion: Is there a mug?", FAR) == "unknown"
    assert asked(answerer, "\nQuestion: Is there a hat?", FAR) == "no"


def test_a_description_is_answered_with_the_first_right_mark(answerer: ScriptedAnswerer) -> None:
    assert asked(answerer, "\nMeant is: the mug 1", NEAR) == "2"
    assert asked(answerer, "\nMeant is: the lamp 0", NEAR, FAR) == "0"
    answerer.sheet.facts["room", "the hat"] = Fact(answer="", needed=(7,))
    assert asked(answerer, "\nMeant is: the hat", NEAR) == "0"


def test_a_caption_is_the_first_description_of_what_carries_mark_1(answerer: ScriptedAnswerer) -> None:
    marks = answerer.sheet.marks
    marks[request_digest([digest(FAR)])] = (1,)
    assert asked(answerer, "\nDescribe the thing.", FAR) == "unknown"
    marks[request_digest([digest(NEAR)])] = (1,)
    assert asked(answerer, "\nDescribe the thing.", NEAR) == "the mug 0"
    marks[request_digest([digest(NEAR)])] = (0,)
    assert asked(answerer, "\nDescribe the thing.", NEAR) == "unknown"


def test_what_the_sheet_does_not_have_is_counted(answerer: ScriptedAnswerer) -> None:
    assert asked(answerer, "\nQuestion: Is there a hat?", b"strange", NEAR) == "no"
    assert answerer.unknown_pictures == 1
    assert asked(answerer, "\nQuestion: Is there a cat?", NEAR) == "unknown"
    assert asked(answerer, "\nQuestion: Is there a hat?", NEAR, OTHER) == "unknown"
    assert asked(answerer, "\nQuestion: Is there a hat?") == "unknown"
    assert asked(answerer, "\nMeant is: the mug 0", FAR) == "0"
    assert answerer.unknown_questions == 4


def test_digests_are_those_of_the_bytes() -> None:
    assert picture_digest(url(NEAR)) == digest(NEAR)
    assert request_pictures(request("x", NEAR, FAR)) == (digest(NEAR), digest(FAR))
    assert request_digest([digest(NEAR), digest(FAR)]) != request_digest([digest(FAR), digest(NEAR)])
    for wrong in ("http://x/y.png", "data:image/png;base64,a", "data:text/plain;base64,eA=="):
        with pytest.raises(InputError):
            picture_digest(wrong)


def test_the_server_streams_or_not_and_refuses_what_is_no_request(answerer: ScriptedAnswerer) -> None:
    def post(address: str, body: Any) -> str:
        data = json.dumps(body).encode()
        with urllib.request.urlopen(urllib.request.Request(f"{address}/chat/completions", data), timeout=10) as reply:
            return str(reply.read().decode())

    text = "x\nQuestion: Is there a hat?"
    with serving(answerer) as address:
        whole = json.loads(post(address, request(text, NEAR)))
        assert whole["choices"][0]["message"]["content"] == "no"
        lines = post(address, request(text, NEAR, stream=True)).split("\n\n")
        chunks = [json.loads(line.removeprefix("data: ")) for line in lines if line and "[DONE]" not in line]
        assert "".join(each["choices"][0]["delta"].get("content", "") for each in chunks) == "no"
        assert chunks[-1]["choices"][0]["finish_reason"] == "stop"
        for wrong in ({"messages": []}, {"messages": [{"content": []}]}, {}):
            with pytest.raises(urllib.error.HTTPError, match="400"):
                post(address, wrong)
