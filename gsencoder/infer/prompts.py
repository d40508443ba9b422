"""What a VLM is told: SplatDistill's three tasks on pictures of a scene (question answering, visual grounding, dense
captioning), as messages of OpenAI's chat protocol."""

import base64
import io
import re
from collections.abc import Collection, Sequence
from typing import Any, Literal

from PIL import Image

from gsencoder.errors import InputError
from gsencoder.infer.photographs import resized_picture
from gsencoder.infer.pictures import Picture
from gsencoder.infer.view_pictures import PictureKind

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
MARKED = "It carries the mark {number} in the pictures."


def prompt_text(
    task: Task, question: str, names: Sequence[str], *, marked: bool, kinds: Collection[PictureKind]
) -> str:
    """What is asked, in words.

    Args:
        task: see the module.
        question: the user's; a caption needs none.
        names: of what was looked for and found, in the order of their marks.
        marked: whether the pictures carry marks.
        kinds: of the pictures.

    Raises:
        InputError: no question for a task that needs one; nothing to ground or caption.
    """
    question = question.strip()
    if not question and task != "caption":
        raise InputError("question= is missing: what to ask about the scene")
    if task != "answer" and not names:
        raise InputError(f"task={task}: nothing was found that could be meant; give query= or aabb=")
    if task == "ground" and not marked:
        raise InputError("task=ground: needs the marks; leave out marks=false")
    shown_by = "both" if len(set(kinds)) > 1 else next(iter(kinds))
    lines = [f"{SETTING} {SHOWN_BY[shown_by]}", ROLES[task]]
    if task == "caption":
        lines.append(f"The thing is the {_bare(names[0])}.")
        if marked:
            lines.append(MARKED.format(number=1))
    elif marked:
        told = (f"{number} = {_bare(name)}" for number, name in enumerate(names, start=1))
        lines.append(f"Marks: {'; '.join(told)}.")
    if question:
        lines.append(f"Question: {question}" if task == "answer" else f"Meant is: {question}")
    return "\n".join(lines)


def _bare(name: str) -> str:
    """A target's name without the rank that tells it from others of its word."""
    return re.sub(r" \d+$", "", name)


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
    height, width = picture.shape[:2]
    if max(width, height) > side:
        factor = side / max(width, height)
        picture = resized_picture(picture, (max(1, round(width * factor)), max(1, round(height * factor))))
    held = io.BytesIO()
    Image.fromarray(picture).save(held, format=kind, **({"quality": 92} if kind == "jpeg" else {}))
    return f"data:image/{kind};base64,{base64.b64encode(held.getvalue()).decode()}"


def number_in(text: str, count: int) -> int | None:
    """The mark that an answer names: the first whole number in it, 0 for none of them; None where it names no mark."""
    found = re.search(r"(?<![\d.])\d+(?![\d]|\.\d)", text)
    if found is None or int(found[0]) > count:
        return None
    return int(found[0])
