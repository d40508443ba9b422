"""What a scene holds, and what it lacks."""

from collections import Counter
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from gsencoder.core.arrays import even_indices
from gsencoder.data.labels.mesh import MeshInstances
from gsencoder.data.readers.label_images import ArchivedLabels
from gsencoder.data.readers.posed import PosedImage, PosedImages
from gsencoder.data.up import Up, up_of_scene
from gsencoder.types import Scene, Views
from gsencoder.types.scene import Selected

MAX_DEPTH_IMAGES = 24
"""So many depth images, evenly spaced, are read for their coverage and range."""
MAX_MASKS = 8
"""So many photographs, evenly spaced, are asked where they are empty."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthFacts:
    """The depth images of a scene.

    Attributes:
        views: views that have one.
        coverage: share of the pixels with depth.
        near: 1st percentile of the depth, world units.
        far: 99th percentile.
        sensor: how the depth camera differs from the photographs'; empty if it is the same.
    """

    views: int
    coverage: float
    near: float
    far: float
    sensor: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SceneFacts:
    """What a scene with posed views holds.

    Attributes:
        layout: in which it is stored.
        views: number of them.
        sizes: width and height of the views, after undistortion and scaling, with the number of views that have it.
        models: names of the camera models in the files, with the number of views.
        focal: smallest and largest focal length, pixels.
        field: median horizontal and vertical field of view, degrees.
        spread: extent of the camera centers along the world's axes, units.
        depth: None where there is none.
        masks: whether there are any.
        empty: share of the pixels that show that nothing is there; None where nothing says so.
        points: of structure from motion.
        objects: labeled ones.
        instances: where instance maps come from; empty where there are none.
        metres_per_unit: None where unknown.
        up: stated or estimated; None where nothing says.
        missing: what is not there, and what follows from it.
        unused: keys of the files, and folders, that were not used.
    """

    layout: str
    views: int
    sizes: dict[tuple[int, int], int]
    models: dict[str, int]
    focal: tuple[float, float]
    field: tuple[float, float]
    spread: tuple[float, float, float]
    depth: DepthFacts | None
    masks: bool
    empty: float | None
    points: int
    objects: int
    instances: str
    metres_per_unit: float | None
    up: Up | None
    missing: tuple[str, ...]
    unused: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """The facts as JSON values."""
        values = asdict(self)
        values["field_of_view"], values["camera_extent"] = values.pop("field"), values.pop("spread")
        sizes = [[*size, count] for size, count in self.sizes.items()]
        return values | {"sizes": sizes, "up": None if self.up is None else self.up.to_dict()}


def scene_facts(scene: Scene, posed: PosedImages, layout: str) -> SceneFacts:
    """The facts of a loaded scene; some of its depth images are read.

    Args:
        posed: the same views as their files describe them.
    """
    views = scene.views
    assert views is not None
    cameras, names = views.cameras, set(views.names)
    posed = replace(posed, images=tuple(image for image in posed.images if image.name in names))
    focal = cameras.Ks[:, 0, 0]
    fields = [
        float(np.rad2deg(2 * np.median(np.arctan(size / 2 / cameras.Ks[:, axis, axis]))))
        for axis, size in enumerate((cameras.widths, cameras.heights))
    ]
    extent = np.ptp(cameras.centers, axis=0) if len(cameras) else np.zeros(3)
    up = up_of_scene(scene)
    return SceneFacts(
        layout=layout,
        views=len(views),
        sizes=dict(Counter(zip(cameras.widths.tolist(), cameras.heights.tolist(), strict=True)).most_common()),
        models=dict(Counter(image.camera.model for image in posed.images).most_common()),
        focal=(float(focal.min()), float(focal.max())),
        field=(fields[0], fields[1]),
        spread=(float(extent[0]), float(extent[1]), float(extent[2])),
        depth=_depth_facts(scene, posed),
        masks=views.masks is not None,
        empty=_empty_share(views),
        points=0 if scene.sfm_points is None else len(scene.sfm_points),
        objects=len(scene.objects),
        instances=_instances_source(views),
        metres_per_unit=scene.metres_per_unit,
        up=up,
        missing=_missing(scene, up),
        unused=(*posed.unused, *(f"folder {name}" for name in posed.unused_folders(scene.folder, layout))),
    )


def _empty_share(views: Views) -> float | None:
    if views.empty is None:
        return None
    rows = even_indices(len(views), MAX_MASKS)
    return float(np.mean([views.empty[int(row)].mean() for row in rows]))


def _instances_source(views: Views) -> str:
    maps = views.instances
    while isinstance(maps, Selected):
        maps = maps.items
    if isinstance(maps, ArchivedLabels):
        return f"pictures in {maps.archive.name}"
    if isinstance(maps, MeshInstances):
        return "drawn from the labeled mesh"
    return "" if maps is None else "pictures"


def _depth_facts(scene: Scene, posed: PosedImages) -> DepthFacts | None:
    views = scene.views
    if views is None or views.depths is None:
        return None
    measured_pixels, pixels, values = 0, 0, []
    for view in even_indices(len(views), MAX_DEPTH_IMAGES):
        depth = views.depths[int(view)]
        measured = depth[depth > 0]
        measured_pixels, pixels = measured_pixels + len(measured), pixels + depth.size
        values.append(measured[:: max(1, len(measured) // 10_000)])
    sample = np.concatenate(values)
    near, far = np.percentile(sample, (1, 99)) if len(sample) else (float("nan"),) * 2
    sensors = {_sensor(image) for image in posed.images if image.depth is not None} - {""}
    return DepthFacts(
        views=sum(image.depth is not None for image in posed.images),
        coverage=measured_pixels / max(1, pixels),
        near=float(near),
        far=float(far),
        sensor="; ".join(sorted(sensors)[:2]),
    )


def _sensor(image: PosedImage) -> str:
    """How a depth camera differs from the photograph's, in words."""
    parts = []
    if image.depth_camera is not None and image.depth_camera.params[0] != image.camera.params[0]:
        parts.append(f"f = {image.depth_camera.params[0]:g} (photographs {image.camera.params[0]:g})")
    if image.depth_from_color is not None:
        shift = float(np.linalg.norm(image.depth_from_color[:3, 3]))
        parts.append(f"{shift:.3g} units beside the camera")
    return ", ".join(parts)


def _missing(scene: Scene, up: Up | None) -> tuple[str, ...]:
    views = scene.views
    assert views is not None
    gaps = []
    if views.depths is None and scene.sfm_points is None:
        gaps.append("depth and points: seeds are triangulated from the photographs")
    elif views.depths is None:
        gaps.append("depth: visibility is tested against rendered depth, and seeds come from the points")
    if len(views) > 1 and not np.ptp(views.cameras.centers, axis=0).any():
        gaps.append("baselines: all cameras stand in one place, so that photographs alone say nothing about depth")
    if scene.metres_per_unit is None:
        gaps.append("unit of length: sizes are in world units (metres_per_unit=)")
    if up is None or up.source != "stated":
        gaps.append("up: it is estimated" if up is not None else "up: boxes have any orientation")
    return tuple(gaps)
