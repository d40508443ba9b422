"""A stand-in for a vision-language model, whose answers are right exactly where the pictures show enough.

It sees a request as a model does, text and pictures, and looks up how many pixels of each true object a picture shows,
by the digest of its bytes, and the right answer of each question with the objects that it is about. It answers rightly
where some picture shows enough pixels of each of these, and else says "unknown": the ceiling of what a choice of views,
marks and scores can reach.

A dry run of `ask` (`dry_run=true`) writes the requests that a real one sends, bit by bit, so the labels of each picture
can be computed before it is sent. Photographs and close-ups are counted in the instance maps of the scene, cut and
resized as the picture was; renders by the instances of the Gaussians, blended as the picture was: each pixel belongs to
the instance with most of its weight, or to none where that is below one half.
"""

import base64
import hashlib
import json
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Int32
from PIL import Image

from gsencoder.core.errors import InputError
from gsencoder.core.files import read_foreign
from gsencoder.data.labels.expressions import Expression
from gsencoder.data.labels.made_questions import kind_of
from gsencoder.data.labels.questions import Question
from gsencoder.infer.ask.batch import ANSWERS, REQUEST
from gsencoder.infer.ask.questions import read_answers
from gsencoder.infer.views.photographs import photograph_window
from gsencoder.render import BlendConfig, blend
from gsencoder.types import Cameras, Scene, Views
from gsencoder.types.checks import move_origin

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


LEAST_WEIGHT = 0.5
"""Blending weight of one instance from which on a rendered pixel shows it."""


class PictureTruth:
    """Counts the pixels of objects in pictures of a scene.

    Attributes:
        scene: with Gaussians and cameras, as `ask` looks at it.
        gaussian_instances: the instance that most of a Gaussian's weight in the labeled views falls on; 0 = none.
    """

    def __init__(self, scene: Scene, labeled: Scene) -> None:
        """Args:
        scene: of a folder of features.
        labeled: the same scene with instance maps; its views have the names of those of `scene`, or more views.

        Raises:
            InputError: Gaussians, cameras or instance maps are missing, or a view has no instance map.
        """
        if scene.gaussians is None or scene.views is None:
            raise InputError(f"truth of pictures: scene {scene.name} has no Gaussians or no cameras")
        if labeled.views is None or labeled.views.instances is None:
            raise InputError(f"truth of pictures: scene {labeled.name} has no instance maps")
        row_of = {name: row for row, name in enumerate(labeled.views.names)}
        missing = [name for name in scene.views.names if name not in row_of]
        if missing:
            raise InputError(f"truth of pictures: scene {labeled.name} has no instance map of view {missing[0]!r}")
        self.scene = scene
        self._instances = [labeled.views.instances[row_of[name]] for name in scene.views.names]
        self._values = np.unique(np.concatenate([np.unique(each) for each in self._instances]))
        self.gaussian_instances = self._vote()
        self._counts: dict[tuple[Any, ...], dict[int, int]] = {}

    def _vote(self) -> Int32[np.ndarray, " N"]:
        gaussians, views = self.scene.gaussians, self.scene.views
        assert gaussians is not None
        assert views is not None
        votes = torch.zeros((len(gaussians), len(self._values)))
        for view, labels in enumerate(self._instances):
            size = int(views.cameras.widths[view]), int(views.cameras.heights[view])
            codes = np.searchsorted(self._values, _resized(labels, size, None)).astype(np.int32)
            blend(gaussians, views.cameras, view).lift_codes_into(torch.from_numpy(codes.ravel()), votes)
        winners = self._values[votes.argmax(dim=1).numpy()]
        return np.where(votes.sum(dim=1).numpy() > 0, winners, 0).astype(np.int32)

    def pixels(self, row: Mapping[str, Any]) -> dict[int, int]:
        """The pixels of each instance in a picture.

        Args:
            row: of a view, as `gsencoder.infer.views.pictures.views_to_json` writes it.
        """
        key = (row["kind"], row["frame"], str(row["cam_from_world"]), str(row["K"]), row["width"], row["height"])
        if key not in self._counts:
            cameras = self._camera(row)
            labels = (
                self._photographed(cameras, int(row["frame"]))
                if row["kind"] == "photograph"
                else self._rendered(cameras)
            )
            values, counts = np.unique(labels, return_counts=True)
            self._counts[key] = {int(value): int(count) for value, count in zip(values, counts, strict=True) if value}
        return self._counts[key]

    def instance_in(self, lower: Sequence[float], upper: Sequence[float]) -> int:
        """The instance of a box in world coordinates: that whose Gaussians are most nearly those in the box.

        Returns:
            The instance with the largest intersection over union of Gaussians; 0 where no labeled one is in the box.
        """
        gaussians = self.scene.gaussians
        assert gaussians is not None
        means = gaussians.means + self.scene.origin
        inside: Bool[np.ndarray, " N"] = ((means >= np.array(lower)) & (means <= np.array(upper))).all(axis=1)
        best, instance = 0.0, 0
        for value in np.unique(self.gaussian_instances[inside]):
            same = self.gaussian_instances == value
            overlap = (inside & same).sum() / (inside | same).sum()
            if value and overlap > best:
                best, instance = float(overlap), int(value)
        return instance

    def _camera(self, row: Mapping[str, Any]) -> Cameras:
        pose = move_origin(np.array(row["cam_from_world"], np.float64), self.scene.origin)
        return Cameras(
            cam_from_world=pose[None].astype(np.float32),
            Ks=np.array(row["K"], np.float32)[None],
            widths=np.array([row["width"]], np.int32),
            heights=np.array([row["height"]], np.int32),
        )

    def _photographed(self, cameras: Cameras, frame: int) -> Int32[np.ndarray, "H W"]:
        views: Views | None = self.scene.views
        assert views is not None
        labels = self._instances[frame]
        size = int(cameras.widths[0]), int(cameras.heights[0])
        window = photograph_window(views, frame, cameras, 0, (labels.shape[1], labels.shape[0]))
        return _resized(labels, size, window)

    def _rendered(self, cameras: Cameras) -> Int32[np.ndarray, "P"]:
        gaussians = self.scene.gaussians
        assert gaussians is not None
        codes = np.searchsorted(self._values, self.gaussian_instances)
        one_hot = torch.nn.functional.one_hot(torch.from_numpy(codes), len(self._values)).float()
        shares = blend(gaussians, cameras, 0, config=BlendConfig()).render(one_hot)
        weight, winner = shares.max(dim=1)
        return np.where(weight.numpy() >= LEAST_WEIGHT, self._values[winner.numpy()], 0).astype(np.int32)


def _resized(
    labels: Int32[np.ndarray, "H W"], size: tuple[int, int], window: tuple[float, float, float, float] | None
) -> Int32[np.ndarray, "h w"]:
    """A label image of another size, or a window of it, by the nearest pixel."""
    image = Image.fromarray(labels.astype(np.int32))
    if window is None and image.size == size:
        return labels
    return np.asarray(image.resize(size, Image.Resampling.NEAREST, box=window), np.int32)


def add_questions(sheet: AnswerSheet, questions: Iterable[Question]) -> None:
    """Adds the right answers of questions, and the objects that each is about.

    Of questions that `gsencoder questions` made, "Is there …" needs any one of the objects, the others all.
    """
    for each in questions:
        text = each.situated_text
        sheet.facts[each.scene, text.strip()] = Fact(
            answer=each.answers[0], needed=each.object_ids, any_of=kind_of(each) == "is_there"
        )


def add_expressions(sheet: AnswerSheet, expressions: Sequence[Expression]) -> None:
    """Adds which object each description means, and the first description of each object as its caption."""
    for each in expressions:
        sheet.facts[each.scene, each.text.strip()] = Fact(answer="", needed=(each.object_id,))
        sheet.captions.setdefault((each.scene, each.object_id), each.text)


def add_pictures(sheet: AnswerSheet, dry: Path, truth: PictureTruth) -> None:
    """Adds the truth of all pictures and marks of a dry run.

    Args:
        sheet: that is added to.
        dry: the folder of the dry run's answers, `answers.jsonl`, about one scene.
        truth: of that scene.
    """
    for row in read_answers(dry / ANSWERS).values():
        body = json.loads(read_foreign(dry / row["folder"] / REQUEST))
        digests = request_pictures(body)
        for digest, view in zip(digests, row["views"], strict=True):
            sheet.pictures[digest] = SentPicture(scene=truth.scene.name, pixels=truth.pixels(view))
        instances = tuple(truth.instance_in(each["aabb_min"], each["aabb_max"]) for each in row["targets"])
        sheet.marks[request_digest(digests)] = instances
