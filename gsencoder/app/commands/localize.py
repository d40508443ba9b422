"""`gsencoder localize FEATURES query=…`: boxes, scores and pictures for words."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gsencoder.app.from_poses import (
    FROM_POSE,
    describe_point,
    memory_of,
    requested_cameras,
    search_from_poses,
)
from gsencoder.app.output import output_folder
from gsencoder.app.progress import console
from gsencoder.app.scenes import WordsOptions, queried_scene, query_words, shown_scene
from gsencoder.app.summary import Summary
from gsencoder.core.errors import InputError, one_line
from gsencoder.core.files import write_json, write_picture
from gsencoder.core.settings import option
from gsencoder.core.threads import import_ahead
from gsencoder.data.scenes import SceneConfig
from gsencoder.data.up import with_up
from gsencoder.infer.boxes import localization_to_json, words_to_json
from gsencoder.infer.draw import write_boxes_ply
from gsencoder.infer.localize import LocalizeConfig, describe_absent, localize
from gsencoder.text.vocabulary import TableTextConfig, TextConfig
from gsencoder.types import Localization


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalizeCommandConfig(WordsOptions):
    """Settings of `localize`."""

    paths: tuple[str, ...] = option(
        (), "a folder written by fuse, encode, pack or memory", metavar="FEATURES", required=True
    )
    query: tuple[str, ...] = option((), "one or several words, separated by commas")
    queries: str = option("", "a text file with one query a line")
    pose: str = option(
        "",
        "a JSON file of cameras in world coordinates (cam_from_world or transform_matrix, fx, fy, cx, cy, "
        "width, height); in each the pixel that answers a word best, and its position, are found",
    )
    view: tuple[str, ...] = option((), "names of views of the scene, whose cameras are asked like those of pose=")
    pictures: int = option(4, "number of views drawn for each word; 0 = none")
    photos: str = option("", "the scene that was fused; its photographs are drawn beside relevancy, not renders")
    report: bool = option(False, "write report.html, a page with pictures and figures")
    data: SceneConfig = field(default_factory=SceneConfig)
    localize: LocalizeConfig = field(default_factory=LocalizeConfig)
    text: TextConfig = field(default_factory=TableTextConfig)

    def __post_init__(self) -> None:
        if len(self.paths) > 1:
            raise InputError(f"paths: expected one folder of features, got {len(self.paths)}")
        if self.pictures < 0:
            raise InputError(f"pictures: expected 0 or more, got {self.pictures}")
        if (self.pose or self.view) and self.localize.contrast:
            raise InputError("pose= and view= compare cosines, not contrasts; leave localize.contrast=true out")


def run(config: LocalizeCommandConfig, summary: Summary) -> None:
    """Reads features, finds each word, writes boxes as JSON and .ply, and draws them."""
    folder = Path(config.paths[0])
    words = query_words(config.query, config.queries)
    if config.pictures:
        # Drawing needs torch, which finding boxes does without; it takes as long to load as they take to find.
        import_ahead("gsencoder.infer.pictures")
    with summary.step("load"):
        scene = shown_scene(folder, config.photos, config.data)
        # Features of earlier versions may lie in a scene whose up nobody estimated.
        scene, _ = with_up(scene)
        queried, table = queried_scene(
            scene, folder, head=config.head, space=config.space, words_file=config.words, text=config.text
        )
        cameras = requested_cameras(scene, config.pose, config.view)
    with summary.step("localize"):
        localization = localize(queried, words, table, config.localize)
    out = config.out or Path("outputs") / scene.name / "boxes"
    summary.results["space"] = next(iter(queried.features.values())).space.describe()
    boxes = localization_to_json(localization)
    summary.results.update(boxes=boxes, thresholds=dict(zip(words, localization.thresholds.tolist(), strict=True)))
    summary.results.update(words=words_to_json(localization))
    summary.results["metres_per_unit"] = scene.metres_per_unit
    with output_folder(out, overwrite=config.overwrite, summary=summary) as target:
        write_json(target / "boxes.json", boxes)
        write_json(target / "words.json", summary.results["words"])
        write_boxes_ply(target / "boxes.ply", scene, localization)
        if config.pictures and scene.views is not None:
            from gsencoder.infer.pictures import relevancy_pictures

            with summary.step("pictures"):
                for name, picture in relevancy_pictures(scene, localization, per_word=config.pictures):
                    write_picture(target / f"{name}.png", picture)
        points: list[dict[str, Any]] = []
        if cameras is not None:
            with summary.step("from_pose"):
                # Heads lead into other spaces than the one in which a memory attends.
                memory = None if config.head else memory_of(folder, queried)
                for pose_points, pose_pictures in search_from_poses(
                    queried,
                    cameras,
                    words,
                    table,
                    config.localize,
                    absent=localization.absent,
                    memory=memory,
                    pictures=config.pictures > 0,
                ):
                    points += pose_points
                    for name, picture in pose_pictures:
                        write_picture(target / f"{name}.png", picture)
            write_json(target / FROM_POSE, points)
            summary.results["from_pose"] = points
        if config.report:
            from gsencoder.app.reports import report_words

            with summary.step("report"):
                report_words(target, scene, localization, summary)
    screen = console(config.quiet)
    for word in words:
        screen.print(f"{one_line(word)}: {_first_box(localization, word)}")
        for point in points:
            if point["query"] == word:
                screen.print(f"  {one_line(describe_point(point))}")
    drawn_files = "boxes.ply and pictures" if config.pictures and scene.views is not None else "boxes.ply"
    more = f" {FROM_POSE}," if cameras is not None else ""
    screen.print(
        f"{out}: boxes.json, words.json,{more} {drawn_files}; boxes are drawn around Gaussian {config.localize.extent}"
    )


def _first_box(localization: Localization, word: str) -> str:
    boxes = [box for box in localization.boxes if box.query == word]
    if not boxes:
        return describe_absent(localization.absent[word])
    best = boxes[0]
    center = ", ".join(f"{value:.3f}" for value in best.center)
    size = " × ".join(f"{value:.3f}" for value in np.asarray(best.aabb_max - best.aabb_min))
    return (
        f"at ({center}), {size}, probability {best.probability:.2f}, score {best.score:.3f}, "
        f"{len(best.rows):,} Gaussians ({len(boxes)} boxes)"
    )
