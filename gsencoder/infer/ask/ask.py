"""From a question about a scene to the prompt of a VLM: words, targets, views, pictures."""

import base64
import io
import re
import warnings
from collections.abc import Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, get_args

import numpy as np
from PIL import Image

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.settings import CheckedConfig, option
from gsencoder.infer.ask.server import VlmConfig
from gsencoder.infer.draw import Picture
from gsencoder.infer.localize import LocalizeConfig, describe_absent, localize, spacing_of
from gsencoder.infer.views.candidates import FreeSpace
from gsencoder.infer.views.choose import choose_views
from gsencoder.infer.views.photographs import resized_picture
from gsencoder.infer.views.pictures import PictureKind, picture_kinds, view_pictures
from gsencoder.infer.views.targets import Target, ViewsConfig, ViewSet, best_boxes, target_of, targets_of
from gsencoder.text.question_words import words_in
from gsencoder.text.vocabulary import Words, closed_table
from gsencoder.types import Box, Gaussians, Scene

Task = Literal["answer", "ground", "caption"]
IMAGE_FORMAT = "jpeg"

SETTING = "The pictures show one place from several viewpoints."
SHOWN_BY = {
    "photograph": "They are photographs.",
    "render": "They are rendered from a 3D reconstruction: blurred or black parts were not seen well and mean nothing.",
    "both": "Some are photographs. The others are rendered from a 3D reconstruction: blurred or black parts of these "
    "were not seen well and mean nothing.",
}
ROLES = {
    "answer": "Answer the question about the place in a few words. Say 'unknown' if the pictures do not tell.",
    "ground": "Numbered marks stand on things. Answer with the number of the one that is meant, and nothing else; "
    "answer 0 if none is.",
    "caption": "Describe the thing in one or two sentences: what it is, how it looks, and where it stands in relation "
    "to what is near it.",
}
MARKED = "It carries the mark 1 in the pictures."
PLACED = "It stands in the middle of most of the pictures."
THOUGHT = re.compile(r"^.*</think>", re.DOTALL)
NEITHER = re.compile(r"\W*(none|neither|no (mark|number)|not any)\b", re.IGNORECASE)
ALONE = re.compile(r"(?<![\d.,/-])\d{1,6}(?!\d|[.,/-]\d)")
CALLED = re.compile(r"(?:\bmark|\bmarked|\bnumber|\bno\.?|#)[\s:#*]*(\d{1,6})(?!\d|[.,/-]\d)", re.IGNORECASE)
NUMBERS = ("zero", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")


def prompt_text(
    task: Task,
    question: str,
    names: Sequence[str],
    *,
    marks: Collection[int],
    kinds: Collection[PictureKind],
    probabilities: Sequence[float] = (),
    absent: Mapping[str, float] = {},
) -> str:
    """What is asked, in words: names are those of what was found, in the order of their marks and with the
    probabilities that they are right; absent are words that were not found, with the probability that they are there
    after all."""
    question = question.strip()
    check_question(task, question)
    if task != "answer" and not names:
        raise InputError(f"task={task}: nothing was found that could be meant; give query= or aabb=")
    if task == "ground" and not marks:
        raise InputError("task=ground: needs marks, and no picture carries one")
    shown_by = "both" if len(set(kinds)) > 1 else next(iter(kinds))
    lines = [f"{SETTING} {SHOWN_BY[shown_by]}", ROLES[task]]
    if task == "caption":
        if names[0]:
            lines.append(f"The thing is the {names[0]}.")
        lines.append(MARKED if 1 in marks else PLACED)
    elif marks:
        legend = (f"{number} = {names[number - 1] or 'a thing'}" for number in sorted(marks))
        lines.append(f"Marks: {'; '.join(legend)}.")
        if probabilities:
            sure = (f"mark {number} {probabilities[number - 1]:.2f}" for number in sorted(marks))
            lines.append(f"Probability that the name is right: {', '.join(sure)}.")
    if absent:
        missing = (f"{word} (probability {value:.2f})" for word, value in absent.items())
        lines.append(f"Looked for and probably absent: {', '.join(missing)}.")
    if question:
        lines.append(f"Question: {question}" if task == "answer" else f"Meant is: {question}")
    return "\n".join(lines)


def check_question(task: Task, question: str) -> None:
    """Complains where a task needs a question and there is none, or one that cannot be sent."""
    if not question.strip() and task != "caption":
        raise InputError("question= is missing: what to ask about the scene")
    try:
        question.encode()
    except UnicodeEncodeError as error:
        raise InputError(f"question: holds what is no character, at {error.start}") from None


def prompt_messages(text: str, pictures: Sequence[Picture], *, side: int) -> list[dict[str, Any]]:
    """A prompt as the chat protocol carries it: one message of the user with pictures, then words.

    Args:
        side: longer pictures are made smaller, pixels.
    """
    parts: list[dict[str, Any]] = []
    for picture in pictures:
        data = base64.b64encode(encoded_picture(picture, side=side)).decode()
        parts.append({"type": "image_url", "image_url": {"url": f"data:image/{IMAGE_FORMAT};base64,{data}"}})
    return [{"role": "user", "content": [*parts, {"type": "text", "text": text}]}]


def encoded_picture(picture: Picture, *, side: int) -> bytes:
    """A picture as the bytes of a file; a longer one is made smaller, pixels."""
    height, width = picture.shape[:2]
    if max(width, height) > side:
        factor = side / max(width, height)
        picture = resized_picture(picture, (max(1, round(width * factor)), max(1, round(height * factor))))
    held = io.BytesIO()
    Image.fromarray(picture).save(held, format=IMAGE_FORMAT, quality=92)
    return held.getvalue()


def number_in(text: str, count: int) -> int | None:
    """The mark that an answer names, of marks 1 to `count`; 0 for none of them; None where it names no mark or several.

    Numbers that are called marks come before others; what a model thought before it answered is left out.
    """
    answer = THOUGHT.sub("", text).strip()
    if NEITHER.match(answer):
        return 0
    for pattern in (CALLED, ALONE):
        numbers = {number for number in map(int, pattern.findall(answer)) if number <= count}
        if numbers:
            return numbers.pop() if len(numbers) == 1 else None
    word = re.sub(r"\W", "", answer).lower()
    return NUMBERS.index(word) if word in NUMBERS[: count + 1] else None


MAX_KEPT = 16
"""Sets of pictures that are kept for the next question, since many are about the same thing; each is some megabytes."""
SAME_THING_IOU = 0.5
"""What shares more of its Gaussians with what was found before, as intersection over union, is the same thing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Question:
    """What is asked: a text, which may be empty for a caption, the words to look for, if not those of the table that it
    holds, or in place of words a box in world coordinates, lower corner and upper corner."""

    text: str = ""
    task: Task = "answer"
    query: tuple[str, ...] = ()
    aabb: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.task not in get_args(Task):
            raise InputError(f"task: expected one of {', '.join(get_args(Task))}, got {str(self.task)[:40]!r}")
        if self.aabb and (len(self.aabb) != 6 or not all(np.isfinite(self.aabb))):
            raise InputError(f"aabb: expected six numbers, got {list(self.aabb)}")
        if self.aabb and not all(low < high for low, high in zip(self.aabb[:3], self.aabb[3:], strict=True)):
            raise InputError(f"aabb: the lower corner is not below the upper one: {list(self.aabb)}")
        if self.aabb and self.query:
            raise InputError("aabb and query: give one of them")


@dataclass(frozen=True, slots=True, kw_only=True)
class AskConfig(CheckedConfig):
    """How a question becomes a prompt."""

    boxes: int = option(3, "boxes of each word that are looked at, best first", ge=1)
    marks: bool | None = option(None, "numbered marks on what was found; left out: for ground and caption")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prompt:
    """What a VLM sees and reads.

    Attributes:
        targets: what the pictures are of, in the order of their marks.
        boxes: the boxes of the targets, where words found them.
        absent: those of them that are probably absent, and the probability that they are not.
        marks: the numbers that the pictures carry.
    """

    text: str
    pictures: list[Picture]
    views: ViewSet
    targets: tuple[Target, ...]
    boxes: tuple[Box, ...]
    words: tuple[str, ...]
    absent: dict[str, float]
    marks: frozenset[int]


class Asker:
    """Turns questions about one scene into prompts; what was found and chosen is kept for the next question."""

    def __init__(
        self,
        scene: Scene,
        words: Words | None,
        *,
        space: str | None = None,
        config: AskConfig = AskConfig(),
        localization: LocalizeConfig = LocalizeConfig(),
        views: ViewsConfig = ViewsConfig(),
        vlm: VlmConfig = VlmConfig(),
    ) -> None:
        """Args:
        scene: Gaussians, features and cameras; photographs where frames are to be shown as these.
        words: words in the space of the features; None where there are none.
        vlm: how requests are made; pictures are made smaller than its `image_side`."""
        self.scene, self.words, self.space = scene, words, space
        self.table = closed_table(words) if words is not None else None
        self.config, self.localization, self.views, self.vlm = config, localization, views, vlm
        self._kept: dict[Hashable, Prompt] = {}

    def prompt(self, question: Question) -> Prompt:
        """What to send for a question.

        Where no words are given and the question holds none that the table knows, evenly spread frames are shown."""
        words = question.query
        if not words and not question.aabb and self.table is not None:
            words = words_in(question.text, self.table)
        marked = question.task in ("ground", "caption") if self.config.marks is None else self.config.marks
        key = (words, question.aabb, question.task == "caption", marked)
        shown = self._kept.pop(key) if key in self._kept else self._without_text(words, question, marked)
        self._kept[key] = shown
        if len(self._kept) > MAX_KEPT:
            del self._kept[next(iter(self._kept))]
        if not shown.targets and self.views.method == "greedy":
            message = self._nothing(words, shown.absent)
            if question.task != "answer":
                raise InputError(f"task={question.task}: {message}; give query= or aabb=")
            warnings.warn(f"{message}: evenly spread views are shown", SceneWarning, stacklevel=2)
        text = prompt_text(
            question.task,
            question.text,
            # A thing in a box that was given has no name.
            [box.query for box in shown.boxes] or ["" for _ in shown.targets],
            marks=shown.marks,
            kinds=picture_kinds(self.scene, shown.views),
            probabilities=[box.probability for box in shown.boxes],
            absent=shown.absent,
        )
        return replace(shown, text=text)

    def _nothing(self, words: Sequence[str], absent: Mapping[str, float]) -> str:
        if not words:
            return "the question names nothing to look for"
        listing = (f"{word!r} is {describe_absent(absent[word])}" if word in absent else repr(word) for word in words)
        return f"none of the words has a box: {', '.join(listing)}"

    def _without_text(self, words: tuple[str, ...], question: Question, marked: bool) -> Prompt:
        """Looks for the words of a question, or in its box, and renders views of what was found."""
        targets, boxes, absent = self._targets(words, question)
        config = self.views
        if not targets:
            config = replace(config, method="uniform", source="both")
        views = choose_views(self.scene, targets, config, free=self._free)
        # Marks are drawn on pictures of the size that is sent, or their numbers would shrink.
        views = replace(views, cameras=views.cameras.resized(self.vlm.image_side, enlarge=False))
        pictures, marks = view_pictures(self.scene, views, targets if marked else ())
        return Prompt(
            text="",
            pictures=pictures,
            views=views,
            targets=targets,
            boxes=boxes,
            words=words,
            absent=absent,
            marks=marks,
        )

    @cached_property
    def _gaussians(self) -> Gaussians:
        if self.scene.gaussians is None:
            raise InputError(f"ask: scene {self.scene.name} has no Gaussians")
        return self.scene.gaussians

    @cached_property
    def _spacing(self) -> float:
        return spacing_of(self._gaussians)

    @cached_property
    def _free(self) -> FreeSpace:
        return FreeSpace(self._gaussians)

    def _targets(
        self, words: Sequence[str], question: Question
    ) -> tuple[tuple[Target, ...], tuple[Box, ...], dict[str, float]]:
        gaussians = self._gaussians
        if question.aabb:
            low, high = np.array(question.aabb).reshape(2, 3) - self.scene.origin
            rows = np.flatnonzero(((gaussians.means >= low) & (gaussians.means <= high)).all(axis=1))
            if not len(rows):
                raise InputError(f"aabb: no Gaussian of scene {self.scene.name} is in the box {list(question.aabb)}")
            return (target_of("thing in the box", gaussians, rows),), (), {}
        if not words:
            return (), (), {}
        if self.words is None:
            raise InputError(
                f"query: there is no text table for the features of {self.scene.name}; give words= or aabb="
            )
        localization = localize(
            self.scene, words, self.words, self.localization, space=self.space, spacing=self._spacing
        )
        # A caption is of one thing.
        boxes = self.config.boxes if question.task != "caption" else 1
        targets, distinct = _distinct(targets_of(gaussians, localization, boxes), best_boxes(localization, boxes))
        if question.task == "caption":
            targets, distinct = targets[:1], distinct[:1]
        return targets, distinct, localization.absent


def _distinct(targets: Sequence[Target], boxes: Sequence[Box]) -> tuple[tuple[Target, ...], tuple[Box, ...]]:
    """What several words found is one thing: that of the first word."""
    distinct: list[int] = []
    for index, box in enumerate(boxes):
        same = (np.intersect1d(box.rows, boxes[other].rows, assume_unique=True).size for other in distinct)
        sizes = (len(box.rows) + len(boxes[other].rows) for other in distinct)
        if all(shared <= SAME_THING_IOU * (size - shared) for shared, size in zip(same, sizes, strict=True)):
            distinct.append(index)
    return tuple(targets[index] for index in distinct), tuple(boxes[index] for index in distinct)


def chosen_mark(prompt: Prompt, text: str) -> int | None:
    """Which target an answer to task=ground means, from 1; 0 for none of them, None where it names no mark."""
    number = number_in(text, len(prompt.targets))
    if number is None or (number and number not in prompt.marks):
        message = " ".join(text.split())[:80]
        warnings.warn(
            f"the answer does not name one of the {len(prompt.marks)} marks: {message!r}", SceneWarning, stacklevel=2
        )
        return None
    return number
