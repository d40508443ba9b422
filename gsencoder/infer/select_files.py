"""A splat whose Gaussians have labels, as two files: labels.ply, which any viewer shows, and labels.json."""

import json
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, Int32

from gsencoder.core.errors import InputError
from gsencoder.core.files import check_written, read_foreign_text, write_json
from gsencoder.data.splats.files import load_property, load_splat, save_splat
from gsencoder.infer.draw import word_color
from gsencoder.infer.localize import box_around
from gsencoder.infer.select import Selection
from gsencoder.types import Gaussians, Scene

LABELS_PLY, LABELS_JSON = "labels.ply", "labels.json"
PROPERTY = "label"
"""The property of the .ply; a float, as viewers expect of every property of a splat."""
NO_COLOR = (128, 128, 128)
"""Of the Gaussians that have no word."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Label:
    """What a label stands for.

    Attributes:
        label: its number; 0 = none of the words.
        name: the word; None for label 0.
        color: RGB, 0 to 255.
        aabb_min: lower corner of the box around their centers, world coordinates; None where there are none, and for
            label 0.
        file: of the splat of these Gaussians alone, beside labels.json; None where none was written.
    """

    label: int
    name: str | None
    color: tuple[int, int, int]
    count: int
    aabb_min: Float64[np.ndarray, "3"] | None
    aabb_max: Float64[np.ndarray, "3"] | None
    file: str | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LabeledSplat:
    """A splat with a label for each Gaussian.

    Attributes:
        origin: of the scene, world coordinates.
        labels: of each Gaussian, a row of `names`.
        names: what the labels stand for, by their number.
    """

    gaussians: Gaussians
    origin: Float64[np.ndarray, "3"]
    labels: Int32[np.ndarray, " N"]
    names: tuple[Label, ...]


def labels_to_json(scene: Scene, selection: Selection, files: Mapping[int, str]) -> dict[str, Any]:
    """Names, colors, counts and boxes as JSON values.

    Args:
        files: names of the splats that were written, by label.
    """
    assert scene.gaussians is not None
    rest: dict[str, Any] = {"label": 0, "name": None, "color": list(NO_COLOR), "count": int(selection.rest.sum())}
    rows = [rest | {"aabb_min": None, "aabb_max": None, "obb": None, "file": files.get(0)}]
    for number, word in enumerate(selection.words):
        members = selection.rows(number)
        row: dict[str, Any] = {
            "label": number + 1,
            "name": word,
            "color": list(word_color(number)),
            "count": len(members),
        }
        corners: dict[str, Any] = {"aabb_min": None, "aabb_max": None, "obb": None}
        if len(members):
            around = box_around(scene.gaussians, members, up=scene.up)
            corners["aabb_min"] = (around.aabb_min + scene.origin).tolist()
            corners["aabb_max"] = (around.aabb_max + scene.origin).tolist()
            corners["obb"] = {
                "center": (around.center + scene.origin).tolist(),
                "rotation": around.rotation.tolist(),
                "size": around.size.tolist(),
            }
        rows.append(row | corners | {"file": files.get(number + 1)})
    return {
        "splat": LABELS_PLY,
        "property": PROPERTY,
        "gaussians": len(scene.gaussians),
        "origin": scene.origin.tolist(),
        "labels": rows,
    }


def write_labels(folder: Path, scene: Scene, selection: Selection, files: Mapping[int, str]) -> None:
    """Writes labels.ply, the whole splat with the property `label`, and labels.json."""
    assert scene.gaussians is not None
    further = {PROPERTY: selection.labels.astype(np.float32)}
    save_splat(folder / LABELS_PLY, scene.gaussians, origin=scene.origin, further=further)
    write_json(folder / LABELS_JSON, labels_to_json(scene, selection, files))


def read_labels(folder: str | Path) -> LabeledSplat:
    """Reads labels.ply and labels.json."""
    path = Path(folder) / LABELS_JSON
    check_written(path)
    try:
        content = json.loads(read_foreign_text(path))
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{path}: cannot be read: {reason}; expected a file that gsencoder select wrote") from error
    try:
        names = _names(content["labels"])
        origin = np.array(content["origin"], np.float64)
        claimed = int(content["gaussians"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: is not what gsencoder select writes ({type(error).__name__}: {error})") from error
    splat = Path(folder) / LABELS_PLY
    gaussians = load_splat(splat, origin=origin)
    values = load_property(splat, PROPERTY)
    if len(gaussians) != claimed:
        raise InputError(f"{splat}: has {len(gaussians):,} Gaussians, and {path.name} states {claimed:,}")
    if not np.isin(values, np.arange(len(names))).all():
        raise InputError(f"{splat}: expected labels from 0 to {len(names) - 1}, got others")
    labels = values.astype(np.int32)
    counts = np.bincount(labels, minlength=len(names))
    for each in names:
        if counts[each.label] != each.count:
            raise InputError(
                f"{splat}: {counts[each.label]:,} Gaussians have label {each.label}, and {path.name} states "
                f"{each.count:,}; the files are of two runs"
            )
    return LabeledSplat(gaussians=gaussians, origin=origin, labels=labels, names=names)


def _names(rows: Sequence[Mapping[str, Any]]) -> tuple[Label, ...]:
    names = []
    for number, row in enumerate(rows):
        if row["label"] != number:
            raise ValueError(f"label {row['label']} is number {number} of the list")
        red, green, blue = (int(value) for value in row["color"])
        corners = [None if row[key] is None else np.array(row[key], np.float64) for key in ("aabb_min", "aabb_max")]
        names.append(
            Label(
                label=number,
                name=None if row["name"] is None else str(row["name"]),
                color=(red, green, blue),
                count=int(row["count"]),
                aabb_min=corners[0],
                aabb_max=corners[1],
                file=None if row["file"] is None else str(row["file"]),
            )
        )
    return tuple(names)


LONGEST = 60
"""Bytes of a name, without its ending."""
RESERVED = frozenset(
    {"con", "prn", "aux", "nul", *(f"{port}{number}" for port in ("com", "lpt") for number in "0123456789")}
)
"""Names that Windows keeps for devices."""


def file_stems(words: Sequence[str], taken: Sequence[str] = ()) -> list[str]:
    """A name for each word that is safe on every file system, and differs from all others in any case of letters.

    Letters and digits of any script stay, each run of other characters becomes one underscore. Marks that change the
    direction of writing, slashes, quotes, and all that a shell or a browser takes for more than text are among these.

    Args:
        words: in order; the first of several that would have one name keeps it, others get a number.
        taken: names that are not given out.
    """
    used = {name.casefold() for name in taken} | RESERVED
    stems = []
    for word in words:
        plain = _plain(word)
        stem, number = plain, 1
        while stem.casefold() in used:
            number += 1
            stem = f"{plain}_{number}"
        used.add(stem.casefold())
        stems.append(stem)
    return stems


def _plain(word: str) -> str:
    letters = "".join(
        # Letters, their marks, and numbers.
        letter if unicodedata.category(letter)[0] in "LMN" else " "
        for letter in unicodedata.normalize("NFKC", word)
    )
    stem = "_".join(letters.split())
    while len(stem.encode("utf-8")) > LONGEST:
        stem = stem[:-1]
    return stem.rstrip("_") or "object"
