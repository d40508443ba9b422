"""`gsencoder select FEATURES query=…`: objects as splats of their own, the scene without them, and labels."""

import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from gsencoder.app.options import QueriesConfig
from gsencoder.app.run import Progress, Run
from gsencoder.app.scenes import load_query, query_words
from gsencoder.core.errors import InputError, counted, one_line
from gsencoder.core.files import write_json
from gsencoder.core.settings import option
from gsencoder.data.splats.files import save_splat
from gsencoder.data.up import with_up
from gsencoder.fusion.folder import load_features
from gsencoder.infer.draw import word_color
from gsencoder.infer.localize import LocalizeConfig, box_around, describe_absent, words_to_json
from gsencoder.infer.select import SelectConfig, Selection, find_holes, sample_views, select
from gsencoder.text.vocabulary import TableTextConfig, TextConfig
from gsencoder.types import Scene

REST, HOLES = "rest", "holes.json"
LABELS_PLY, LABELS_JSON = "labels.ply", "labels.json"
PROPERTY = "label"
"""The property of the .ply; a float, as viewers expect of every property of a splat."""
NO_COLOR = (128, 128, 128)
"""Of the Gaussians that have no word."""
LONGEST = 60
"""Bytes of a name, without its ending."""
RESERVED = frozenset(
    {"con", "prn", "aux", "nul", *(f"{port}{number}" for port in ("com", "lpt") for number in "0123456789")}
)
"""Names that Windows keeps for devices."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SelectCommandConfig(QueriesConfig):
    """Settings of `select`."""

    box: tuple[int, ...] = option(
        (),
        "numbers of the boxes of each word that are taken, best first from 0, as in boxes.json; empty = the most "
        "probable one, and those nearly as probable",
        ge=0,
    )
    threshold: float | None = option(None, "all Gaussians from this relevancy on, instead of boxes", ge=-1, le=1)
    write: tuple[Literal["objects", "rest", "labels"], ...] = option(
        ("objects", "rest", "labels"),
        "objects = a splat of each word alone; rest = the scene without them, and the holes that they leave; labels = "
        "the whole scene with the property label, and labels.json",
    )
    format: Literal["ply", "compressed.ply", "spz"] = option("ply", "of the objects and the rest")
    select: SelectConfig = field(default_factory=SelectConfig)
    localize: LocalizeConfig = field(default_factory=LocalizeConfig)
    text: TextConfig = field(default_factory=TableTextConfig)

    def __post_init__(self) -> None:
        QueriesConfig.__post_init__(self)
        if not self.write:
            raise InputError("write: expected some of objects, rest, labels, got none")
        if self.box and self.threshold is not None:
            raise InputError("box= and threshold= are two ways to choose where a selection starts; give one of them")


def run(config: SelectCommandConfig, run: Run) -> None:
    """Finds the Gaussians of each word and writes them, what is left, and the labels."""
    folder = Path(config.paths[0])
    words = query_words(config.query, config.queries)
    with run.step("load"):
        scene, _ = with_up(load_features(folder))
        queried, table = load_query(
            scene, folder, head=config.head, space=config.space, words_file=config.words, text=config.text
        )
    with run.step("select"):
        selection, localization = select(
            queried,
            words,
            table,
            config.select,
            boxes=config.box,
            threshold=config.threshold,
            localization=config.localize,
            track=run.track,
        )
    out, files = run.out(scene.name, "selection"), _files(selection, config)
    run.results.update(
        space=next(iter(queried.features.values())).space.describe(),
        metres_per_unit=scene.metres_per_unit,
        words=words_to_json(localization),
        seeds=[int((selection.seeds == number + 1).sum()) for number in range(len(words))],
        views=selection.views,
        placed_cameras=selection.placed,
        selection=labels_to_json(scene, selection, files),
    )
    with run.folder(out) as target:
        with run.step("write"):
            assert scene.gaussians is not None
            for label, name in files.items():
                save_splat(target / name, scene.gaussians.select(selection.labels == label), origin=scene.origin)
            if "labels" in config.write:
                write_labels(target, scene, selection, files)
        if "rest" in config.write and scene.views is not None and config.select.views:
            with run.step("holes"):
                run.results["holes"] = _holes(scene, selection, config.select, run.track)
            write_json(target / HOLES, run.results["holes"])
    for number, word in enumerate(words):
        count = len(selection.rows(number))
        text = f"{count:,} Gaussians, from {run.results['seeds'][number]:,} to start with"
        if not count:
            absent = localization.absent
            text = describe_absent(absent[word]) if word in absent else "no Gaussians"
        elif number + 1 in files:
            text += f", {files[number + 1]}"
        run.print(f"{one_line(word)}: {text}")
    run.print(f"{out}: {_listing(selection, config, files, run.results.get('holes'))}")


def _files(selection: Selection, config: SelectCommandConfig) -> dict[int, str]:
    """The name of the splat of each label that has Gaussians, of those that are written."""
    names = {}
    if "rest" in config.write:
        names[0] = f"{REST}.{config.format}"
    if "objects" in config.write:
        stems = file_stems(selection.words, taken=(REST, Path(LABELS_PLY).stem, Path(HOLES).stem, "summary"))
        names |= {
            number + 1: f"{stem}.{config.format}" for number, stem in enumerate(stems) if len(selection.rows(number))
        }
    return names


def _holes(scene: Scene, selection: Selection, config: SelectConfig, track: Progress) -> dict[str, Any]:
    """The holes of each view that has one, and of all views together, as JSON values."""
    assert scene.gaussians is not None
    assert scene.views is not None
    samples = sample_views(scene.views.cameras, config.views)
    holes = find_holes(scene.gaussians, scene.views.cameras, ~selection.rest, samples, track=track)
    rows = [asdict(hole) | {"view": scene.views.names[hole.view]} for hole in holes if hole.pixels]
    return {
        "views": len(samples),
        "views_with_objects": len(holes),
        "views_with_holes": len(rows),
        "pixels": sum(hole.pixels for hole in holes),
        "removed": sum(hole.removed for hole in holes),
        "largest_area": max((hole.area for hole in holes), default=0.0),
        "by_view": rows,
    }


def _listing(
    selection: Selection, config: SelectCommandConfig, files: dict[int, str], holes: dict[str, Any] | None
) -> str:
    parts = []
    if "objects" in config.write:
        parts.append(counted(sum(label > 0 for label in files), "object"))
    if "rest" in config.write:
        parts.append(f"{files[0]} of {int(selection.rest.sum()):,} Gaussians")
    if "labels" in config.write:
        parts.append(f"{LABELS_PLY} and {LABELS_JSON}")
    text = ", ".join(parts)
    if holes is not None:
        share = holes["pixels"] / max(holes["removed"], 1)
        text += (
            f"; nothing is behind {share:.0%} of the removed pixels in {holes['views_with_objects']} views, at most "
            f"{holes['largest_area']:.3g} square units in one"
        )
    return text


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
