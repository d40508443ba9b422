"""The cameras of pose= and view=, and what they see of words: points, their JSON values and pictures."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from gsencoder.core.errors import InputError, listed
from gsencoder.data.readers.transforms_json import read_cameras
from gsencoder.fusion.folder import MEMORY_FILE, load_memories, teachers_in
from gsencoder.infer.localize import LocalizeConfig
from gsencoder.text.table import TextEncoder
from gsencoder.types import Cameras, QueryMemory, Scene

FROM_POSE = "from_pose.json"


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


def memory_of(folder: Path, scene: Scene) -> QueryMemory | None:
    """The memory that the one feature set of a scene was decoded from; None where features are stored themselves."""
    if not (folder / MEMORY_FILE).is_file() and not teachers_in(folder, MEMORY_FILE):
        return None
    (features,) = scene.features.values()
    return next((memory for memory in load_memories(folder).values() if memory.space == features.space), None)


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
    """What each camera sees of the words.

    Args:
        scene: the scene with one feature set.
        text: turns words into the features' space.
        absent: words that are not in the scene, with the probability that they are. They are not visible from anywhere,
            however relevant a pixel may be.
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
