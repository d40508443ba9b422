"""Prompts of a VLM: SplatDistill's three tasks on pictures of a scene (question answering, visual grounding, dense
captioning), as messages of OpenAI's chat protocol."""

import base64
import io
import re
from collections.abc import Collection, Mapping, Sequence
from typing import Any, Literal

from PIL import Image

from gsencoder.core.errors import InputError
from gsencoder.infer.draw.pictures import Picture
from gsencoder.infer.views.photographs import resized_picture
from gsencoder.infer.views.pictures import PictureKind

Task = Literal["answer", "ground", "caption"]
ImageFormat = Literal["jpeg", "png"]

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
    """What is asked, in words.

    Args:
        task: see the module.
        question: the user's; a caption needs none.
        names: of what was looked for and found, in the order of their marks; empty where a thing has no name.
        marks: the numbers, from 1, that the pictures carry.
        kinds: of the pictures.
        probabilities: that each of the names is right, in their order; empty where nothing says.
        absent: words that were looked for and not found, and the probability that they are there after all.

    Raises:
        InputError: no question for a task that needs one; nothing to ground or caption.
    """
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
    """Complains where a task needs a question and there is none, or one that cannot be sent.

    Raises:
        InputError: see above.
    """
    if not question.strip() and task != "caption":
        raise InputError("question= is missing: what to ask about the scene")
    try:
        question.encode()
    except UnicodeEncodeError as error:
        raise InputError(f"question: holds what is no character, at {error.start}") from None


def messages(text: str, pictures: Sequence[Picture], *, side: int, kind: ImageFormat) -> list[dict[str, Any]]:
    """One message of the user: pictures, then words.

    Args:
        text: of `prompt_text`.
        pictures: what the model sees, in order.
        side: longer pictures are made smaller, pixels.
        kind: how they are written.
    """
    parts: list[dict[str, Any]] = [
        {"type": "image_url", "image_url": {"url": data_url(picture, side=side, kind=kind)}} for picture in pictures
    ]
    return [{"role": "user", "content": [*parts, {"type": "text", "text": text}]}]


def data_url(picture: Picture, *, side: int, kind: ImageFormat) -> str:
    """A picture as the protocol carries it."""
    data = encoded_picture(picture, side=side, kind=kind)
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"


def encoded_picture(picture: Picture, *, side: int, kind: ImageFormat) -> bytes:
    """A picture as the bytes of a JPEG or PNG file.

    Args:
        picture: uint8 [H, W, 3].
        side: a longer picture is made smaller, pixels.
        kind: of the file.
    """
    height, width = picture.shape[:2]
    if max(width, height) > side:
        factor = side / max(width, height)
        picture = resized_picture(picture, (max(1, round(width * factor)), max(1, round(height * factor))))
    held = io.BytesIO()
    Image.fromarray(picture).save(held, format=kind, **({"quality": 92} if kind == "jpeg" else {}))
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
