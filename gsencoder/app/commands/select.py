"""`gsencoder select FEATURES query=…`: objects as splats of their own, the scene without them, and labels."""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from gsencoder.app.options import QueriesConfig
from gsencoder.app.run import Progress, Run
from gsencoder.app.scenes import queried_scene, query_words
from gsencoder.core.errors import InputError, counted, one_line
from gsencoder.core.files import write_json
from gsencoder.core.settings import option
from gsencoder.data.splats.files import save_splat
from gsencoder.data.up import with_up
from gsencoder.fusion.folder import load_features
from gsencoder.infer.localize import LocalizeConfig, describe_absent, words_to_json
from gsencoder.infer.select import SelectConfig, Selection, find_holes, sample_views, select
from gsencoder.infer.select_files import LABELS_JSON, LABELS_PLY, file_stems, labels_to_json, write_labels
from gsencoder.text.vocabulary import TableTextConfig, TextConfig
from gsencoder.types import Scene

REST, HOLES = "rest", "holes.json"


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
        queried, table = queried_scene(
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
