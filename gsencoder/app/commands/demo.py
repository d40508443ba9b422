"""`gsencoder demo`: the pipeline on a built-in scene, offline, with an HTML report."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from gsencoder.app.commands.localize import add_words
from gsencoder.app.options import CommonConfig, settings
from gsencoder.app.reports import add_features, add_views
from gsencoder.app.run import Run
from gsencoder.core.errors import InputError
from gsencoder.core.files import write_bytes, write_json
from gsencoder.core.process import peak_memory_mb
from gsencoder.core.settings import option
from gsencoder.data.scenes import load_scene
from gsencoder.data.seeding.seed import SeedConfig, seed
from gsencoder.data.splats.files import save_splat
from gsencoder.data.synthetic import color_words, make_room, write_room
from gsencoder.evaluate.benchmarks.localization import aabb_iou
from gsencoder.fusion.folder import load_features, save_features
from gsencoder.fusion.fuse import FuseConfig, Fusion, fuse
from gsencoder.infer.draw import write_boxes_ply
from gsencoder.infer.localize import LocalizeConfig, localization_to_json, localize
from gsencoder.infer.page.page import FileOptions, fitting_page, load_bundle
from gsencoder.infer.page.report import HtmlReport
from gsencoder.teachers.base import Teacher
from gsencoder.teachers.build import text_table_of
from gsencoder.teachers.labels import LabelsTeacher, PaletteConfig, PaletteTeacher
from gsencoder.text.table import WORDS_FILE, TextTable, make_text_table, save_text_table
from gsencoder.types import Localization, Scene, SceneObject

PAGE = "page.html"
PAGE_OPTIONS = FileOptions(error=0.01, sh_degree=3, photographs=16, photograph_side=640)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TeacherResult:
    """The features of a teacher and the words that were localized in them; `ious` are those of the first box of each
    word with the true one, 0 without a box."""

    title: str
    words: tuple[str, ...]
    ious: tuple[float, ...]
    fusion: Fusion
    localization: Localization

    @property
    def num_localized(self) -> int:
        """Number of words whose first box has an IoU of 0.5 or more."""
        return sum(iou >= 0.5 for iou in self.ious)

    @property
    def mean_iou(self) -> float:
        return float(np.mean(self.ious)) if self.ious else 0.0

    def to_dict(self) -> dict[str, Any]:
        """For summary.json."""
        features = self.fusion.features
        return {
            "rank": features.features.shape[1],
            "channels": features.space.channels,
            "seen": int(features.seen.sum()),
            "mean_iou": self.mean_iou,
            "iou": dict(zip(self.words, self.ious, strict=True)),
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoConfig(CommonConfig):
    """Settings of `demo`."""

    seed: int = option(0, "seed of the random room", ge=0)
    objects: int = option(8, "number of named objects", ge=1)
    views: int = option(16, "number of views", ge=1)
    width: int = option(320, "width of the views in pixels; the height is three quarters of it", ge=16)
    seeds: SeedConfig = field(default_factory=SeedConfig)
    fusion: FuseConfig = field(default_factory=FuseConfig)
    localize: LocalizeConfig = field(default_factory=LocalizeConfig)


def run(config: DemoConfig, run: Run) -> None:
    """Makes a room, reads it back, seeds Gaussians, fuses two teachers, localizes words, and writes OUT/report.html."""
    out = run.out("demo")
    with run.folder(out) as folder:
        scene = photographed_room(config, folder, run)
        run.print(f"scene: {len(scene.objects)} objects in {config.views} views with depth")
        with run.step("seeds"):
            scene = replace(scene, gaussians=seed(scene, config.seeds))
        assert scene.gaussians is not None
        save_splat(folder / "splat.ply", scene.gaussians, origin=scene.origin)
        run.print(f"seeds: {len(scene.gaussians):,} Gaussians, no optimization")
        scene_objects = [scene_object for scene_object in scene.objects if scene_object.placed and scene_object.name]
        names = room_words(scene)
        labels = LabelsTeacher(scene.objects, names)
        palette, colors = PaletteTeacher(), text_table_of(PaletteConfig())
        assert colors is not None
        hues = color_words(config.seed, objects=config.objects)
        by_name = [(scene_object.name or "", scene_object) for scene_object in scene_objects]
        by_color = [(hues[scene_object.id], scene_object) for scene_object in scene_objects]
        results = (
            search(scene, labels, names, by_name, config, folder / "names", run),
            search(scene, palette, colors, unrepeated(by_color), config, folder / "colors", run),
        )
        for result in results:
            figures = result.to_dict()
            run.print(
                f"{result.title}: features of {figures['rank']} of {figures['channels']} channels; "
                f"{result.num_localized} of {len(result.words)} words localized (IoU ≥ 0.5), mean IoU "
                f"{result.mean_iou:.2f}"
            )
        run.results.update(
            gaussians=len(scene.gaussians),
            views=config.views,
            report="report.html",
            **{result.title: result.to_dict() for result in results},
        )
        with run.step("page"):
            problem = write_page(folder / PAGE, scene, results[0], names, config.localize)
        if problem:
            run.print(f"{PAGE} is left out: {problem}")
        with run.step("report"):
            write_report(folder / "report.html", scene, results, run, page="" if problem else PAGE)
    run.print(f"{out}/report.html is the report; {out}/room is a scene folder for the other commands")


def write_page(path: Path, scene: Scene, result: TeacherResult, words: TextTable, config: LocalizeConfig) -> str:
    """Writes the room as the page of `gsencoder view`; returns why there is none, or nothing."""
    try:
        bundle = load_bundle()
    except InputError as error:
        return str(error)
    page_scene = replace(scene, features={result.fusion.features.space.name: result.fusion.features})
    page = fitting_page(
        bundle,
        [(page_scene, result.title, words)],
        config,
        scene.objects,
        PAGE_OPTIONS,
        max_gaussians=10**6,
        max_bytes=25 * 10**6,
    )
    write_bytes(path, page.page)
    return ""


def photographed_room(config: DemoConfig, folder: Path, run: Run) -> Scene:
    """Makes a room, writes it as files like those of a capture, and reads these."""
    with run.step("make the scene"):
        height = config.width * 3 // 4
        room = make_room(config.seed, objects=config.objects, views=config.views, width=config.width, height=height)
        write_room(room, folder / "room")
    with run.step("read it"):
        return load_scene(folder / "room")


def room_words(scene: Scene) -> TextTable:
    """A text table with an orthogonal unit vector for each name in the scene."""
    names = sorted({scene_object.name for scene_object in scene.objects if scene_object.name})
    return make_text_table(names, np.eye(len(names), dtype=np.float32), "demo-words")


def unrepeated(pairs: list[tuple[str, SceneObject]]) -> list[tuple[str, SceneObject]]:
    """The pairs whose word stands for one object alone."""
    words = [word for word, _ in pairs]
    return [(word, scene_object) for word, scene_object in pairs if words.count(word) == 1]


def search(
    scene: Scene,
    teacher: Teacher,
    words: TextTable,
    pairs: list[tuple[str, SceneObject]],
    config: DemoConfig,
    folder: Path,
    run: Run,
) -> TeacherResult:
    """Fuses a teacher, stores the features, reads them back, localizes words, and compares boxes with the true ones."""
    title = folder.name
    with run.step(f"fuse {title}"):
        fusion = fuse(scene, teacher, config.fusion, track=run.track)
    folder.mkdir()
    with run.step("store"):
        save_features(
            folder, scene, fusion.features, {"fusion": settings(config.fusion), "teacher": teacher.settings()}
        )
        save_text_table(folder / WORDS_FILE, words)
        stored = load_features(folder)
    start = time.perf_counter()
    localization = localize(stored, [word for word, _ in pairs], words, config.localize)
    run.timings[f"localize {title}"] = time.perf_counter() - start
    write_json(folder / "boxes.json", localization_to_json(localization))
    write_boxes_ply(folder / "boxes.ply", stored, localization)
    ious = []
    for word, scene_object in pairs:
        box = next((box for box in localization.boxes if box.query == word), None)
        ious.append(
            aabb_iou(box.aabb_min, box.aabb_max, scene_object.aabb_min, scene_object.aabb_max)
            if box is not None
            else 0.0
        )
    return TeacherResult(
        title=title, words=tuple(word for word, _ in pairs), ious=tuple(ious), fusion=fusion, localization=localization
    )


TEXTS = {
    "names": (
        "Where is each object?",
        "The labels teacher paints each pixel with the vector of its object's name. The vectors are "
        "lifted from all views onto the Gaussians; a word selects Gaussians by cosine, and DBSCAN clusters them to "
        "boxes.",
    ),
    "colors": (
        "Where is each color?",
        "The palette teacher looks at the photographs alone and names colors. A color on a wall or on the "
        "furniture is localized too: the best box is not always the small object that was meant.",
    ),
}


def write_report(path: Path, scene: Scene, results: Sequence[TeacherResult], run: Run, *, page: str = "") -> None:
    """Draws the pictures and writes the report, with a link to a page next to it if there is one."""
    assert scene.gaussians is not None
    report = HtmlReport(
        "A room and the words in it",
        "Gaussians were seeded from posed pictures with depth, 2D features lifted onto them, and words localized.",
    )
    report.facts(
        {
            "Gaussians": len(scene.gaussians),
            "views": run.results["views"],
            "seconds before this page": sum(run.timings.values()),
            "peak memory, MiB": peak_memory_mb(),
            **{f"{result.title} localized": f"{result.num_localized} of {len(result.words)}" for result in results},
        }
    )
    if page:
        report.section("In a browser")
        report.link("The room as a page: type a word, and see it", page)
    features = {result.title: result.fusion.features for result in results}
    add_views(report, scene, features)
    for result in results:
        report.section(*TEXTS[result.title])
        add_words(report, scene, result.localization, dict(zip(result.words, result.ious, strict=True)))
    report.section("Seconds of each step")
    report.timings(run.timings)
    report.section("Features")
    add_features(report, features, {result.title: result.fusion.truncation for result in results})
    report.write(path)
