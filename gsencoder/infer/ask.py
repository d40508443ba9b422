"""A question about a scene, from words to what a VLM is sent: what to look for, which views, which prompt."""

import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, get_args

import numpy as np
from jaxtyping import Float64

from gsencoder.data.text_table import TextTable
from gsencoder.errors import InputError, SceneWarning
from gsencoder.infer.localize import LocalizeConfig, localize
from gsencoder.infer.pictures import Picture
from gsencoder.infer.prompts import Task, messages, number_in, prompt_text
from gsencoder.infer.view_pictures import picture_kinds, view_pictures
from gsencoder.infer.view_set import ViewsConfig, ViewSet
from gsencoder.infer.view_targets import Target, best_boxes, target_of, targets_of
from gsencoder.infer.views import choose_views
from gsencoder.infer.vlm import VlmConfig
from gsencoder.types import Box, Scene

LONGEST_NAME = 3
"""Names of so many words are looked for in a question."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Question:
    """What is asked.

    Attributes:
        text: the question; may be empty for a caption.
        task: see `prompts`.
        query: words to look for; empty = the words of the table that the text holds.
        aabb: a box in world coordinates to look at in place of words: lower corner, upper corner.
    """

    text: str = ""
    task: Task = "answer"
    query: tuple[str, ...] = ()
    aabb: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.task not in get_args(Task):
            raise InputError(f"task: expected one of {', '.join(get_args(Task))}, got {str(self.task)[:40]!r}")
        if self.aabb and (len(self.aabb) != 6 or not all(np.isfinite(self.aabb))):
            raise InputError(f"aabb: expected six numbers, lower corner and upper corner, got {list(self.aabb)}")
        if self.aabb and not all(low < high for low, high in zip(self.aabb[:3], self.aabb[3:], strict=True)):
            raise InputError(f"aabb: the lower corner is not below the upper one: {list(self.aabb)}")
        if self.aabb and self.query:
            raise InputError("aabb and query: give one of them")


@dataclass(frozen=True, slots=True, kw_only=True)
class AskConfig:
    """How a question becomes a prompt."""

    boxes: int = field(default=3, metadata={"help": "boxes of each word that are looked at, best first"})
    marks: bool | None = field(
        default=None,
        metadata={"help": "numbered marks on what was found; left out: if the task is ground, or several were found"},
    )

    def __post_init__(self) -> None:
        if self.boxes < 1:
            raise InputError(f"boxes: expected 1 or more, got {self.boxes}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prompt:
    """What a VLM is shown and told.

    Attributes:
        text: the words.
        pictures: as they are sent, but for their size.
        views: where they were taken, and why.
        targets: what they are of, in the order of their marks.
        boxes: the boxes of the targets, where words found them.
        words: that were looked for.
    """

    text: str
    pictures: list[Picture]
    views: ViewSet
    targets: tuple[Target, ...]
    boxes: tuple[Box, ...]
    words: tuple[str, ...]


def words_in(text: str, table: TextTable) -> tuple[str, ...]:
    """The names of a table that a text holds, in its order; of names within names the longest."""
    tokens = re.findall(r"[^\W_]+(?:['’-][^\W_]+)*", text)
    found: list[str] = []
    start = 0
    while start < len(tokens):
        for length in range(min(LONGEST_NAME, len(tokens) - start), 0, -1):
            row = table.find(" ".join(tokens[start : start + length]))
            if row is not None:
                found.append(table.names[row])
                start += length - 1
                break
        start += 1
    return tuple(dict.fromkeys(found))


class Asker:
    """Turns questions about one scene into prompts; what was found and chosen is kept for the next question."""

    def __init__(
        self,
        scene: Scene,
        table: TextTable | None,
        *,
        space: str | None = None,
        config: AskConfig = AskConfig(),
        localization: LocalizeConfig = LocalizeConfig(),
        views: ViewsConfig = ViewsConfig(),
    ) -> None:
        """Args:
        scene: Gaussians, features and cameras; photographs where frames are to be shown as these.
        table: words that lead into the features; None where there are none.
        space: which features are asked.
        config: see there.
        localization: how words become boxes.
        views: how views are chosen.
        """
        self._scene, self._table, self._space = scene, table, space
        self._config, self._localization, self._views = config, localization, views
        self._kept: dict[Any, tuple[tuple[Target, ...], tuple[Box, ...], ViewSet]] = {}

    def prompt(self, question: Question) -> Prompt:
        """What to send for a question.

        Where no words are given and the question holds none that the table knows, evenly spread frames are shown.

        Warns:
            SceneWarning: nothing was looked for, or nothing of it was found.

        Raises:
            InputError: words that the table does not know, a box without Gaussians, a task that needs what is missing.
        """
        words = question.query
        if not words and not question.aabb and self._table is not None:
            words = words_in(question.text, self._table)
        key = (words, question.aabb, question.task == "caption")
        if key not in self._kept:
            self._kept[key] = self._look(words, question)
        targets, boxes, views = self._kept[key]
        marked = self._config.marks
        if marked is None:
            marked = question.task == "ground" or len(targets) > 1
        marked = marked and bool(targets)
        kinds = picture_kinds(self._scene, views)
        text = prompt_text(
            question.task, question.text, [target.name for target in targets], marked=marked, kinds=kinds
        )
        pictures = view_pictures(self._scene, views, targets if marked else ())
        return Prompt(text=text, pictures=pictures, views=views, targets=targets, boxes=boxes, words=words)

    def _look(self, words: Sequence[str], question: Question) -> tuple[tuple[Target, ...], tuple[Box, ...], ViewSet]:
        targets, boxes = self._targets(words, question)
        config = self._views
        if not targets and config.method == "greedy":
            told = f"nothing was found of {', '.join(words)}" if words else "the question names nothing to look for"
            if question.task != "answer":
                raise InputError(f"task={question.task}: {told}; give query= or aabb=")
            warnings.warn(f"{told}: evenly spread frames are shown", SceneWarning, stacklevel=4)
            config = replace(config, method="uniform")
        return targets, boxes, choose_views(self._scene, targets, config)

    def _targets(self, words: Sequence[str], question: Question) -> tuple[tuple[Target, ...], tuple[Box, ...]]:
        gaussians = self._scene.gaussians
        if gaussians is None:
            raise InputError(f"ask: scene {self._scene.name} has no Gaussians")
        if question.aabb:
            low, high = _corners(question.aabb, self._scene.origin)
            rows = np.flatnonzero(((gaussians.means >= low) & (gaussians.means <= high)).all(axis=1))
            if not len(rows):
                raise InputError(f"aabb: no Gaussian of scene {self._scene.name} is in the box {list(question.aabb)}")
            return (target_of("thing in the box", gaussians, rows),), ()
        if not words:
            return (), ()
        if self._table is None:
            raise InputError(f"query: no words lead into the features of {self._scene.name}; give words= or aabb=")
        found = localize(self._scene, words, self._table, self._localization, space=self._space)
        # A caption is of one thing.
        boxes = self._config.boxes if question.task != "caption" else 1
        targets = targets_of(gaussians, found, boxes)
        if question.task == "caption":
            targets = targets[:1]
        return targets, best_boxes(found, boxes)[: len(targets)]


def _corners(
    aabb: Sequence[float], origin: Float64[np.ndarray, "3"]
) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]:
    return np.array(aabb[:3]) - origin, np.array(aabb[3:]) - origin


def prompt_messages(prompt: Prompt, config: VlmConfig) -> list[dict[str, Any]]:
    """The prompt as the chat protocol carries it."""
    return messages(prompt.text, prompt.pictures, side=config.image_side, kind=config.image_format)


def meant(prompt: Prompt, text: str) -> int | None:
    """Which target an answer to task=ground means, from 1; 0 for none.

    Warns:
        SceneWarning: the answer names no mark.
    """
    number = number_in(text, len(prompt.targets))
    if number is None:
        told = " ".join(text.split())[:80]
        warnings.warn(f"the answer names none of the {len(prompt.targets)} marks: {told!r}", SceneWarning, stacklevel=2)
    return number
