"""A splat whose Gaussians have labels, as two files: labels.ply, which any viewer shows, and labels.json."""

import unicodedata
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsencoder.core.files import write_json
from gsencoder.data.splats.files import save_splat
from gsencoder.infer.draw import word_color
from gsencoder.infer.localize import box_around
from gsencoder.infer.select import Selection
from gsencoder.types import Scene

LABELS_PLY, LABELS_JSON = "labels.ply", "labels.json"
PROPERTY = "label"
"""The property of the .ply; a float, as viewers expect of every property of a splat."""
NO_COLOR = (128, 128, 128)
"""Of the Gaussians that have no word."""


def labels_to_json(scene: Scene, selection: Selection, files: Mapping[int, str]) -> dict[str, Any]:
    """Names, colors, counts and boxes as JSON values.

    Args:
        files: names of the splats that were written, by label.
    """
    assert scene.gaussians is not None
    rows: list[dict[str, Any]] = []
    for number, word in enumerate([None, *selection.words]):
        members = np.flatnonzero(selection.labels == number)
        row: dict[str, Any] = {
            "label": number,
            "name": word,
            "color": list(NO_COLOR if word is None else word_color(number - 1)),
            "count": len(members),
            "aabb_min": None,
            "aabb_max": None,
            "obb": None,
            "file": files.get(number),
        }
        if word is not None and len(members):
            around = box_around(scene.gaussians, members, up=scene.up)
            row["aabb_min"] = (around.aabb_min + scene.origin).tolist()
            row["aabb_max"] = (around.aabb_max + scene.origin).tolist()
            row["obb"] = {
                "center": (around.center + scene.origin).tolist(),
                "rotation": around.rotation.tolist(),
                "size": around.size.tolist(),
            }
        rows.append(row)
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
    The first of several words that would have one name keeps it, others get a number; `taken` is not given out.
    """
    used = {name.casefold() for name in taken} | RESERVED
    stems = []
    for word in words:
        # Letters, their marks, and numbers.
        letters = (
            letter if unicodedata.category(letter)[0] in "LMN" else " "
            for letter in unicodedata.normalize("NFKC", word)
        )
        plain = "_".join("".join(letters).split())
        plain = plain.encode()[:LONGEST].decode(errors="ignore").rstrip("_") or "object"
        stem, number = plain, 1
        while stem.casefold() in used:
            number += 1
            stem = f"{plain}_{number}"
        used.add(stem.casefold())
        stems.append(stem)
    return stems
