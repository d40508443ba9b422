"""Captions of objects and of views, as the scripts of Scan2Cap compare them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from gsencoder.core.errors import InputError
from gsencoder.core.files import write_json
from gsencoder.data.labels.files import (
    MAX_TEXT,
    entries_of,
    name_value,
    read_benchmark_json,
    read_checked_text,
    refuse_repeated,
    scene_name,
    text_value,
)


def wrapped_caption(text: str) -> str:
    """A caption between sos and eos with full stops as words, as LEO wraps what a language model says; one that begins
    with sos and ends with eos is left as it is.
    """
    words = text.split(" ")
    return text if words[0] == "sos" and words[-1] == "eos" else f"sos {text} eos".replace(". ", " . ")


EXPECTED = "scene_id, view and caption"
MAX_LIST_BYTES = 256 << 20


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewCaption:
    """What was written of a view.

    Attributes:
        view: name of the view in it, as transforms.json or its image file has it.
    """

    scene: str
    view: str
    caption: str

    @property
    def name(self) -> str:
        """Scene and view, which together have one caption."""
        return f"{self.scene}/{self.view}"


def read_view_captions(path: Path) -> tuple[ViewCaption, ...]:
    """Reads captions of views."""
    captions = tuple(
        ViewCaption(
            scene=scene_name(entry.get("scene_id"), where),
            view=name_value(entry.get("view"), where, "view"),
            caption=text_value(entry.get("caption"), where, "caption"),
        )
        for entry, where in entries_of(read_benchmark_json(path), path, EXPECTED)
    )
    refuse_repeated(path, [each.name for each in captions], lambda name: name[:80], what="view")
    if not captions:
        raise InputError(f"{path}: holds no captions; expected a list of objects with {EXPECTED}")
    return captions


def write_view_captions(path: Path, captions: Sequence[ViewCaption]) -> None:
    """Writes captions as `read_view_captions` reads them."""
    write_json(path, [{"scene_id": each.scene, "view": each.view, "caption": each.caption} for each in captions])


def read_texts(path: Path) -> tuple[str, ...]:
    """The lines of a text file that are not blank, each once, such as captions of COCO's pictures."""
    lines = [line.strip() for line in read_checked_text(path, max_bytes=MAX_LIST_BYTES).splitlines()]
    long = next((number for number, line in enumerate(lines, start=1) if len(line) > MAX_TEXT), None)
    if long is not None:
        raise InputError(f"{path}: line {long} has more than {MAX_TEXT:,} characters")
    texts = tuple(dict.fromkeys(line for line in lines if line))
    if not texts:
        raise InputError(f"{path}: holds no text; expected one a line")
    return texts
