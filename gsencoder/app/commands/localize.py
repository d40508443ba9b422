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
from gsencoder.app.scenes import memory_of, queried_scene, query_words, shown_scene
from gsencoder.core.errors import InputError, listed, one_line
from gsencoder.core.files import write_json, write_picture
from gsencoder.core.settings import option
from gsencoder.core.threads import import_ahead
from gsencoder.data.readers.transforms_json import read_cameras
from gsencoder.data.scenes import SceneConfig
from gsencoder.data.up import with_up
from gsencoder.infer.draw import write_boxes_ply
from gsencoder.infer.localize import LocalizeConfig, describe_absent, localization_to_json, localize, words_to_json
from gsencoder.text.table import TextEncoder
from gsencoder.text.vocabulary import TableTextConfig, TextConfig
from gsencoder.types import Cameras, Localization, QueryMemory, Scene

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
    photos: str = option("", "the scene that was fused; its photographs are drawn beside relevancy, not renders")
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
    if config.pictures:
        # Drawing needs torch, which finding boxes does without; it takes as long to load as they take to find.
        import_ahead("gsencoder.infer.pictures")
    with run.step("load"):
        scene, _ = with_up(shown_scene(folder, config.photos, config.data))
        queried, table = queried_scene(
            scene, folder, head=config.head, space=config.space, words_file=config.words, text=config.text
        )
        cameras = requested_cameras(scene, config.pose, config.view)
    with run.step("localize"):
        localization = localize(queried, words, table, config.localize)
    out, boxes = run.out(scene.name, "boxes"), localization_to_json(localization)
    run.results.update(
        space=next(iter(queried.features.values())).space.describe(),
        boxes=boxes,
        thresholds=dict(zip(words, localization.thresholds.tolist(), strict=True)),
        words=words_to_json(localization),
        metres_per_unit=scene.metres_per_unit,
    )
    points: list[dict[str, Any]] = []
    with run.folder(out) as target:
        write_json(target / "boxes.json", boxes)
        write_json(target / "words.json", run.results["words"])
        write_boxes_ply(target / "boxes.ply", scene, localization)
        if config.pictures and scene.views is not None:
            from gsencoder.infer.pictures import relevancy_pictures

            with run.step("pictures"):
                for name, picture in relevancy_pictures(scene, localization, per_word=config.pictures):
                    write_picture(target / f"{name}.png", picture)
        if cameras is not None:
            with run.step("from_pose"):
                # Heads lead into other spaces than the one in which a memory attends.
                memory = None if config.head else memory_of(folder, queried)
                absent, drawn = localization.absent, config.pictures > 0
                for pose_points, pose_pictures in search_from_poses(
                    queried, cameras, words, table, config.localize, absent=absent, memory=memory, pictures=drawn
                ):
                    points += pose_points
                    for name, picture in pose_pictures:
                        write_picture(target / f"{name}.png", picture)
            write_json(target / FROM_POSE, points)
            run.results["from_pose"] = points
        if config.report:
            from gsencoder.app.reports import report_words

            with run.step("report"):
                report_words(target, scene, localization, run)
    for word in words:
        run.print(f"{one_line(word)}: {_first_box(localization, word)}")
        run.print(*(f"  {one_line(describe_point(point))}" for point in points if point["query"] == word))
    drawn_files = "boxes.ply and pictures" if config.pictures and scene.views is not None else "boxes.ply"
    more = f" {FROM_POSE}," if cameras is not None else ""
    run.print(
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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RequestedCameras:
    """Cameras that words are searched from.

    Attributes:
        cameras: relative to the scene's origin.
        views: for each the name of the scene's view, or None for a camera of a file.
    """

    cameras: Cameras
    views: tuple[str | None, ...]


def requested_cameras(scene: Scene, pose: str, views: Sequence[str]) -> RequestedCameras | None:
    """The cameras of a file, followed by those of views of the scene; None where neither is asked for.

    Args:
        scene: whose views and origin they are.
        pose: path of a JSON file in the form of `gsencoder.data.readers.transforms_json`, or empty.
    """
    parts, names = [], [*views]
    in_file = 0
    if pose:
        parts.append(read_cameras(Path(pose), scene.origin))
        in_file = len(parts[0])
    if names:
        row_of = {} if scene.views is None else {name: row for row, name in enumerate(scene.views.names)}
        for name in names:
            if name not in row_of:
                some = f"its views are {listed(list(row_of))}" if row_of else "it has no views"
                raise InputError(f"view: scene {scene.name} has no view {name[:80]!r}; {some}")
        assert scene.views is not None
        parts.append(scene.views.cameras.select([row_of[name] for name in names]))
    if not parts:
        return None
    cameras = Cameras(
        cam_from_world=np.concatenate([part.cam_from_world for part in parts]),
        Ks=np.concatenate([part.Ks for part in parts]),
        widths=np.concatenate([part.widths for part in parts]),
        heights=np.concatenate([part.heights for part in parts]),
    )
    return RequestedCameras(cameras=cameras, views=(*(None,) * in_file, *names))


def search_from_poses(
    scene: Scene,
    cameras: RequestedCameras,
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
        scene: the scene with one feature set.
        cameras: relative to its origin.
        words: that `text` knows.
        text: turns words into the features' space.
        config: its mode and threshold are used.
        absent: words that are not in the scene, with the probability that they are; they are visible from nowhere.
        memory: of the Gaussians, where the features come from one.
        pictures: draw a picture for each word.
    """
    # Rendering needs torch, which finding boxes does without.
    from gsencoder.infer.from_pose import FeatureField, FromPoseConfig, pose_picture, view_picture

    field = FeatureField(scene, memory=memory, config=FromPoseConfig(mode=config.mode, threshold=config.threshold))
    for view, name in enumerate(cameras.views):
        frame = field.at(cameras.cameras, view)
        points = [
            replace(point, visible=point.visible and point.query not in absent) for point in frame.find(words, text)
        ]
        named_pictures = []
        if pictures:
            rgb = view_picture(frame)
            for number, point in enumerate(points):
                (relevancy,) = frame.relevancy([point.query], text)
                safe = "".join(c if c.isalnum() else "_" for c in point.query)[:60]
                picture = pose_picture(rgb, frame, point, relevancy)
                named_pictures.append((f"pose{view:03d}_{number:02d}_{safe}", Image.fromarray(picture)))
        yield (
            [
                {
                    "query": point.query,
                    "camera": view,
                    "view": name,
                    "visible": point.visible,
                    "absent": point.query in absent,
                    "relevancy": _finite(point.relevancy),
                    "threshold": _finite(point.threshold),
                    "alpha": _finite(point.alpha),
                    "pixel": _finite_all(point.pixel.tolist()),
                    "depth": _finite(point.depth),
                    "position": _finite_all(point.position.tolist()),
                }
                for point in points
            ],
            named_pictures,
        )


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _finite_all(values: list[float]) -> list[float] | None:
    return values if all(map(math.isfinite, values)) else None


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
