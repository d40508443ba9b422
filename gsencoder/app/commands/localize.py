"""`gsencoder localize FEATURES query=…`: boxes, scores and pictures for words."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from gsencoder.app.options import QueriesConfig
from gsencoder.app.run import Run
from gsencoder.app.scenes import load_feature_scene, load_query, memory_of, query_words
from gsencoder.core.errors import InputError, counted, listed, one_line
from gsencoder.core.files import write_json, write_picture
from gsencoder.core.settings import option
from gsencoder.data.readers.transforms_json import read_cameras
from gsencoder.data.scenes import SceneConfig
from gsencoder.data.up import with_up
from gsencoder.infer.draw import color_bar, write_boxes_ply
from gsencoder.infer.localize import LocalizeConfig, describe_absent, localization_to_json, localize, words_to_json
from gsencoder.infer.page.report import HtmlReport
from gsencoder.text.table import TextEncoder
from gsencoder.text.vocabulary import TableTextConfig, TextConfig
from gsencoder.types import Cameras, Localization, QueryMemory, Scene
from gsencoder.types.scene import concatenate_cameras

FROM_POSE = "from_pose.json"


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalizeCommandConfig(QueriesConfig):
    """Settings of `localize`."""

    pose: str = option(
        "",
        "a JSON file of cameras in world coordinates (cam_from_world or transform_matrix, fx, fy, cx, cy, width, "
        "height); in each the pixel that answers a word best, and its position, are found",
    )
    view: tuple[str, ...] = option((), "names of views of the scene, whose cameras are asked like those of pose=")
    pictures: int = option(4, "number of views drawn for each word; 0 = none", ge=0)
    photos: str = option("", "the scene that was fused; its photographs are drawn next to relevancy, not renders")
    report: bool = option(False, "write report.html, a page with pictures and figures")
    data: SceneConfig = field(default_factory=SceneConfig)
    localize: LocalizeConfig = field(default_factory=LocalizeConfig)
    text: TextConfig = field(default_factory=TableTextConfig)

    def __post_init__(self) -> None:
        QueriesConfig.__post_init__(self)
        if (self.pose or self.view) and self.localize.contrast:
            raise InputError("pose= and view= compare cosines, not contrasts; leave localize.contrast=true out")


def run(config: LocalizeCommandConfig, run: Run) -> None:
    """Reads features, finds each word, writes boxes as JSON and .ply, and draws them."""
    folder = Path(config.paths[0])
    words = query_words(config.query, config.queries)
    with run.step("load"):
        scene, _ = with_up(load_feature_scene(folder, config.photos, config.data))
        queried, table = load_query(
            scene, folder, head=config.head, space=config.space, words_file=config.words, text=config.text
        )
        cameras = requested_cameras(scene, config.pose, config.view) if config.pose or config.view else None
    with run.step("localize"):
        localization = localize(queried, words, table, config.localize)
    space = next(iter(queried.features.values())).space.describe()
    presences, boxes = words_to_json(localization), localization_to_json(localization)
    run.results.update(
        space=space,
        boxes=boxes,
        thresholds=dict(zip(words, localization.thresholds.tolist(), strict=True)),
        words=presences,
        metres_per_unit=scene.metres_per_unit,
    )
    points: list[dict[str, Any]] = []
    out = run.out(scene.name, "boxes")
    with run.folder(out) as target:
        write_json(target / "boxes.json", boxes)
        write_json(target / "words.json", presences)
        write_boxes_ply(target / "boxes.ply", scene, localization)
        if config.pictures and scene.views is not None:
            from gsencoder.infer.pictures import relevancy_pictures

            with run.step("pictures"):
                for name, picture in relevancy_pictures(scene, localization, per_word=config.pictures):
                    write_picture(target / f"{name}.png", picture)
        if cameras is not None:
            with run.step("from_pose"):
                # The outputs of heads are in other spaces than the one in which a memory attends.
                memory = None if config.head else memory_of(folder, queried)
                absent, drawn = localization.absent, config.pictures > 0
                for pose_points, pose_pictures in search_from_poses(
                    queried, *cameras, words, table, config.localize, absent=absent, memory=memory, pictures=drawn
                ):
                    points += pose_points
                    for name, picture in pose_pictures:
                        write_picture(target / f"{name}.png", picture)
            write_json(target / FROM_POSE, points)
            run.results["from_pose"] = points
        if config.report:
            with run.step("report"):
                report_words(target, scene, localization, run)
    lines = []
    for word in words:
        lines.append(f"{one_line(word)}: {_first_box(localization, word)}")
        lines += [f"  {one_line(describe_point(point))}" for point in points if point["query"] == word]
    drawn_files = "boxes.ply and pictures" if config.pictures and scene.views is not None else "boxes.ply"
    more = f" {FROM_POSE}," if cameras is not None else ""
    files = f"boxes.json, words.json,{more} {drawn_files}"
    run.print(*lines, f"{out}: {files}; boxes are drawn around Gaussian {config.localize.extent}")


def _first_box(localization: Localization, word: str) -> str:
    boxes = [box for box in localization.boxes if box.query == word]
    if not boxes:
        return describe_absent(localization.absent[word])
    best = boxes[0]
    center = ", ".join(f"{value:.3f}" for value in best.center)
    size = " × ".join(f"{value:.3f}" for value in np.asarray(best.aabb_max - best.aabb_min))
    return (
        f"at ({center}), {size}, probability {best.probability:.2f}, score {best.score:.3f}, "
        f"{len(best.rows):,} Gaussians ({counted(len(boxes), 'box', 'boxes')})"
    )


def requested_cameras(scene: Scene, pose: str, views: Sequence[str]) -> tuple[Cameras, tuple[str | None, ...]]:
    """The cameras of a file, followed by those of views of the scene, relative to its origin, and for each the name of
    its view or None."""
    parts = [read_cameras(Path(pose), scene.origin)] if pose else []
    names: list[str | None] = [None] * sum(map(len, parts))
    row_of = {} if scene.views is None else {name: row for row, name in enumerate(scene.views.names)}
    for name in views:
        if scene.views is None or name not in row_of:
            some = f"its views are {listed(list(row_of))}" if row_of else "it has no views"
            raise InputError(f"view: scene {scene.name} has no view {name[:80]!r}; {some}")
        parts.append(scene.views.cameras.select([row_of[name]]))
        names.append(name)
    return concatenate_cameras(parts), tuple(names)


def search_from_poses(
    scene: Scene,
    cameras: Cameras,
    names: Sequence[str | None],
    words: Sequence[str],
    text: TextEncoder,
    config: LocalizeConfig,
    *,
    absent: Mapping[str, float] = {},
    memory: QueryMemory | None = None,
    pictures: bool = True,
) -> Iterator[tuple[list[dict[str, Any]], list[tuple[str, Image.Image]]]]:
    """What each camera sees of the words: the points of the words as JSON values, and pictures with their names.

    Args:
        scene: the scene with one feature set, to whose origin the cameras are relative.
        names: for each camera the name of the scene's view, or None.
        config: its mode and threshold are used.
        absent: words that are not in the scene, with the probability that they are; they are visible from nowhere.
        memory: of the Gaussians, where the features come from one.
    """
    # Rendering needs torch, which finding boxes does without.
    from gsencoder.infer.from_pose import FeatureField, FromPoseConfig, pose_picture, view_picture

    field = FeatureField(scene, memory=memory, config=FromPoseConfig(mode=config.mode, threshold=config.threshold))
    for view, name in enumerate(names):
        frame = field.at(cameras, view)
        points, named_pictures = [], []
        rgb = view_picture(frame) if pictures else None
        for number, point in enumerate(frame.find(words, text)):
            point = replace(point, visible=point.visible and point.query not in absent)
            values = {
                "query": point.query,
                "camera": view,
                "view": name,
                "visible": point.visible,
                "absent": point.query in absent,
                "relevancy": point.relevancy,
                "threshold": point.threshold,
                "alpha": point.alpha,
                "pixel": point.pixel.tolist(),
                "depth": point.depth,
                "position": point.position.tolist(),
            }
            points.append({key: value if _is_finite(value) else None for key, value in values.items()})
            if rgb is not None:
                (relevancy,) = frame.relevancy([point.query], text)
                safe = "".join(c if c.isalnum() else "_" for c in point.query)[:60]
                picture = pose_picture(rgb, frame, point, relevancy)
                named_pictures.append((f"pose{view:03d}_{number:02d}_{safe}", Image.fromarray(picture)))
        yield points, named_pictures


def _is_finite(value: Any) -> bool:
    numbers = value if isinstance(value, list) else [value]
    return all(not isinstance(number, float) or math.isfinite(number) for number in numbers)


def describe_point(point: dict[str, Any]) -> str:
    """A line about one point, for people."""
    camera = f"camera {point['camera']}" if point["view"] is None else f"view {point['view']}"
    if point["relevancy"] is None:
        return f"{camera}: nothing that has features is in view"
    if point["absent"]:
        return f"{camera}: not visible (absent from the scene; relevancy {point['relevancy']:.2f})"
    if not point["visible"]:
        return f"{camera}: not visible (relevancy {point['relevancy']:.2f}, threshold {point['threshold']:.2f})"
    x, y = point["pixel"]
    coordinates = ", ".join(f"{value:.3f}" for value in point["position"])
    return f"{camera}: pixel ({x:.1f}, {y:.1f}), relevancy {point['relevancy']:.2f}, at ({coordinates})"


PAIR_CELL = 560
"""Smallest width of a view with its relevancy on the page, CSS pixels."""


def report_words(folder: Path, scene: Scene, localization: Localization, run: Run) -> None:
    """Writes the page of words in a scene."""
    report = HtmlReport(f"Words in {scene.name}", "Clusters of Gaussians whose features answer a word.")
    boxed = {box.query for box in localization.boxes}
    counts = {"words": len(localization.queries), "with a box": len(boxed), "boxes": len(localization.boxes)}
    report.facts({**counts, **run.costs()})
    report.section("Words")
    add_words(report, scene, localization)
    report.section("Seconds of each step")
    report.timings(run.timings)
    report.write(folder / "report.html")


def add_words(
    report: HtmlReport, scene: Scene, localization: Localization, ious: Mapping[str, float] | None = None
) -> None:
    """Adds a picture of each word, with its relevancy and boxes, where the scene has views, and a table of the words;
    `ious` are those of the first box of each word with the true one, where that is known."""
    words = localization.queries
    boxes = {word: [box for box in localization.boxes if box.query == word] for word in words}
    if scene.views is not None:
        from gsencoder.infer.pictures import relevancy_pictures  # with torch

        # Names begin with the number of the word.
        pictures = dict(relevancy_pictures(scene, localization, per_word=1))
        captions = [_caption(word, len(boxes[word]), None if ious is None else ious[word]) for word in words]
        report.pictures([np.asarray(pictures[name]) for name in sorted(pictures)], captions, cell=PAIR_CELL)
        marks = set(localization.thresholds.tolist())
        mark = marks.pop() if len(marks) == 1 else None
        report.pictures([color_bar(640, 0.0, 1.0, mark=mark)], ["relevancy, with the threshold"], lossless=True)
    rows = []
    for word, probability in zip(words, localization.probabilities.tolist(), strict=True):
        best = boxes[word][0] if boxes[word] else None
        center = "–" if best is None else ", ".join(f"{value:.2f}" for value in best.center)
        row: Sequence[object] = (word, len(boxes[word]), center, best.score if best is not None else 0.0, probability)
        rows.append(row if ious is None else (*row, ious[word]))
    columns = ("word", "boxes", "center of the first", "score", "probability")
    report.table(columns if ious is None else (*columns, "IoU with the truth"), rows)


def _caption(word: str, boxes: int, iou: float | None) -> str:
    if not boxes:
        return f"{word}: no box"
    found = f"{boxes} box{'es' if boxes > 1 else ''}"
    return f"{word}: {found}" if iou is None else f"{word}: IoU {iou:.2f} with the true box"
