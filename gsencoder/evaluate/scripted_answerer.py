"""A stand-in for a vision-language model, whose answers are right exactly where the pictures show enough.

It sees a request as a model does, text and pictures, and looks up two things that a model would have to know: of each
picture, by the digest of its bytes, how many pixels of each true object it shows; and the right answer of each
question, with the objects that it is about. It answers rightly where some picture shows enough pixels of each of these,
and else says "unknown". So it is the ceiling of what a choice of views, marks and scores can reach, with right and
wrong known.
"""

import base64
import hashlib
import json
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from gsencoder.core.errors import InputError

UNKNOWN, NO_MARK = "unknown", "0"
QUESTION, MEANT = "\nQuestion: ", "\nMeant is: "
MODEL = "scripted"
MIN_PIXELS = 200


@dataclass(frozen=True, slots=True, kw_only=True)
class Fact:
    """What is right.

    Attributes:
        answer: the first of the right answers; for grounding nothing is needed here.
        needed: ids of the objects that must be seen; the first is the one that is meant.
        any_of: whether one of them is enough, as for "Is there a chair?"
    """

    answer: str
    needed: tuple[int, ...]
    any_of: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class SentPicture:
    """What a picture shows.

    Attributes:
        scene: that it is of.
        pixels: of each object, by id.
    """

    scene: str
    pixels: Mapping[int, int]


@dataclass(frozen=True, slots=True, kw_only=True)
class AnswerSheet:
    """What the answerer looks up.

    Attributes:
        pictures: by `picture_digest`.
        facts: by scene and text of the question, or of the description.
        marks: the object under each mark, from mark 1 on, by `request_digest`; 0 = none that is labeled.
        captions: the right caption by scene and object.
    """

    pictures: dict[str, SentPicture] = field(default_factory=dict)
    facts: dict[tuple[str, str], Fact] = field(default_factory=dict)
    marks: dict[str, tuple[int, ...]] = field(default_factory=dict)
    captions: dict[tuple[str, int], str] = field(default_factory=dict)


def picture_digest(url: str) -> str:
    """SHA-256 of the bytes of a picture in a data URL.

    Raises:
        InputError: no base64 data URL.
    """
    start, _, data = url.partition(";base64,")
    if not start.startswith("data:image/") or not data:
        raise InputError("a picture of a request must be a data URL in base64")
    try:
        return hashlib.sha256(base64.b64decode(data, validate=True)).hexdigest()
    except ValueError as error:
        raise InputError(f"a picture of a request is no base64: {error}") from error


def request_pictures(body: Mapping[str, Any]) -> tuple[str, ...]:
    """The digests of the pictures of a request, in order."""
    parts = body["messages"][-1]["content"]
    return tuple(picture_digest(part["image_url"]["url"]) for part in parts if part["type"] == "image_url")


def request_digest(pictures: Sequence[str]) -> str:
    """The digest of all pictures of a request."""
    return hashlib.sha256("\n".join(pictures).encode()).hexdigest()


class ScriptedAnswerer:
    """Answers requests by an `AnswerSheet`.

    Attributes:
        requests: how many were answered.
        unknown_pictures: pictures that the sheet does not have: it was made for others.
        unknown_questions: requests whose question or picture set the sheet does not have.
    """

    def __init__(self, sheet: AnswerSheet, min_pixels: int = MIN_PIXELS) -> None:
        """Args:
        sheet: see there.
        min_pixels: of an object, in one picture, from which on it is seen.
        """
        self.sheet, self.min_pixels = sheet, min_pixels
        self.requests = self.unknown_pictures = self.unknown_questions = 0

    def reply(self, body: Mapping[str, Any]) -> str:
        """The answer to a request of the chat protocol.

        Raises:
            InputError: a request without text, or with a picture that is none.
        """
        self.requests += 1
        digests = request_pictures(body)
        texts = [part["text"] for part in body["messages"][-1]["content"] if part["type"] == "text"]
        if not texts:
            raise InputError("the request has no text")
        text: str = texts[-1]
        pictures = [self.sheet.pictures[each] for each in digests if each in self.sheet.pictures]
        self.unknown_pictures += len(digests) - len(pictures)
        scenes = {each.scene for each in pictures}
        if len(scenes) != 1:
            self.unknown_questions += 1
            return UNKNOWN
        scene = scenes.pop()
        pixels: dict[int, int] = {}
        for each in pictures:
            for label, count in each.pixels.items():
                pixels[label] = max(pixels.get(label, 0), count)
        visible = frozenset(label for label, count in pixels.items() if count >= self.min_pixels)
        marks = self.sheet.marks.get(request_digest(digests))
        if MEANT in text:
            return self._mark(scene, text.rpartition(MEANT)[2], marks, visible)
        if QUESTION in text:
            return self._answer(scene, text.rpartition(QUESTION)[2], visible)
        return self._caption(scene, marks, visible)

    def _answer(self, scene: str, question: str, visible: frozenset[int]) -> str:
        fact = self.sheet.facts.get((scene, question))
        if fact is None:
            self.unknown_questions += 1
            return UNKNOWN
        return fact.answer if _is_seen(fact, visible) else UNKNOWN

    def _mark(self, scene: str, description: str, marks: tuple[int, ...] | None, visible: frozenset[int]) -> str:
        fact = self.sheet.facts.get((scene, description))
        if fact is None or marks is None:
            self.unknown_questions += 1
            return NO_MARK
        meant = fact.needed[0]
        return str(marks.index(meant) + 1) if meant in marks and _is_seen(fact, visible) else NO_MARK

    def _caption(self, scene: str, marks: tuple[int, ...] | None, visible: frozenset[int]) -> str:
        if not marks:
            self.unknown_questions += 1
            return UNKNOWN
        caption = self.sheet.captions.get((scene, marks[0]))
        return caption if caption is not None and marks[0] in visible else UNKNOWN


def _is_seen(fact: Fact, visible: frozenset[int]) -> bool:
    labels = set(fact.needed)
    return bool(labels & visible) if fact.any_of and labels else labels <= visible


class _Handler(BaseHTTPRequestHandler):
    """Speaks as much of OpenAI's chat protocol as `gsencoder.infer.ask.server.VlmServer` uses."""

    def do_POST(self) -> None:
        body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        try:
            answer = self.server.answerer.reply(body)  # type: ignore[attr-defined]
        except (InputError, LookupError, TypeError, AttributeError) as error:
            self._send(400, "application/json", json.dumps({"error": {"message": str(error)}}).encode())
            return
        head = {"id": "scripted", "created": 0, "model": MODEL}
        if body.get("stream"):
            chunk = head | {"object": "chat.completion.chunk"}
            parts = [
                chunk | {"choices": [{"index": 0, "delta": {"content": answer}, "finish_reason": None}]},
                chunk | {"choices": [{"index": 0, "delta": {}, "finish_reason": "stop"}]},
            ]
            events = [f"data: {json.dumps(part)}\n\n" for part in parts]
            self._send(200, "text/event-stream", "".join([*events, "data: [DONE]\n\n"]).encode())
            return
        message = {"role": "assistant", "content": answer}
        completion = head | {
            "object": "chat.completion",
            "choices": [{"index": 0, "finish_reason": "stop", "message": message}],
        }
        self._send(200, "application/json", json.dumps(completion).encode())

    def _send(self, status: int, kind: str, data: bytes) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, *_: Any) -> None:
        """A line a request would be too much."""


@contextmanager
def serving(answerer: ScriptedAnswerer) -> Iterator[str]:
    """A server on this machine alone while the block lasts; yields its address, for `vlm.base_url=`."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), _Handler)
    server.daemon_threads = True
    server.answerer = answerer  # type: ignore[attr-defined]
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}/v1"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
