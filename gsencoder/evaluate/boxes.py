"""Acc@k: the share of objects whose name's best box overlaps them (ScanRefer's metric, with axis-aligned boxes)."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from gsencoder.core.errors import InputError
from gsencoder.evaluate.tables import mean_of
from gsencoder.types import Box, Localization, Scene, SceneObject


@dataclass(frozen=True, slots=True, kw_only=True)
class Hit:
    """The result of querying the name of one object.

    Attributes:
        iou: largest IoU of the first box for the name with any object of that name; 0 if there is no box.
        oracle_iou: the largest of these over all boxes for the name, as the paper has it; a user cannot know which box
            that is.
    """

    scene: str
    name: str
    iou: float
    oracle_iou: float


def aabb_iou(
    min_a: Float64[np.ndarray, "3"],
    max_a: Float64[np.ndarray, "3"],
    min_b: Float64[np.ndarray, "3"],
    max_b: Float64[np.ndarray, "3"],
) -> float:
    """Intersection over union of two axis-aligned boxes; 0 if either has no volume.

    It is exact, in any unit. Benchmarks add 1e-8 cubic metres to the union, which lowers the IoU of small boxes, by a
    percent for a cube of 1 cm; `box_ious` of `gsencoder.evaluate.benchmarks.referring` does so where results must equal
    theirs.
    """
    overlap = np.prod(np.clip(np.minimum(max_a, max_b) - np.maximum(min_a, min_b), 0, None))
    union = np.prod(max_a - min_a) + np.prod(max_b - min_b) - overlap
    return float(overlap / union) if union > 0 else 0.0


def queryable_objects(objects: Sequence[SceneObject], *, min_views: int = 5, min_pixels: int = 60) -> list[SceneObject]:
    """Selects the objects to query: small objects that have a name and are seen well enough.

    Args:
        objects: all objects of a scene.
        min_views: smallest number of views in which an object is seen.
        min_pixels: smallest number of pixels that an object has in the view that shows it best.
    """
    return [o for o in objects if o.placed and o.name and is_seen(o, min_views=min_views, min_pixels=min_pixels)]


def is_seen(scene_object: SceneObject, *, min_views: int, min_pixels: int) -> bool:
    """Whether an object shows in enough views, and in one of them with enough pixels."""
    if scene_object.views is None or scene_object.max_pixels is None:
        raise InputError(
            f"object {scene_object.id}: the views that show it were not counted; with_counted_views of "
            "gsencoder.data.labels.scans counts them"
        )
    return scene_object.views >= min_views and scene_object.max_pixels >= min_pixels


def score_boxes(scene: Scene, localization: Localization, targets: Sequence[SceneObject]) -> list[Hit]:
    """Compares the boxes for each target's name with all objects of that name; one hit per target."""
    boxes: dict[str, list[Box]] = {}
    for box in localization.boxes:
        boxes.setdefault(box.query, []).append(box)
    hits = []
    for target in targets:
        assert target.name is not None
        same = [o for o in scene.objects if o.name == target.name]
        ranked = sorted(boxes.get(target.name, []), key=lambda box: box.rank)
        ious = [max(aabb_iou(b.aabb_min, b.aabb_max, o.aabb_min, o.aabb_max) for o in same) for b in ranked]
        hits.append(
            Hit(scene=scene.name, name=target.name, iou=ious[0] if ious else 0.0, oracle_iou=max(ious, default=0.0))
        )
    return hits


def accuracy(hits: Iterable[Hit], threshold: float, *, oracle: bool = False) -> float:
    """The share of hits whose IoU is at least `threshold`; NaN without hits."""
    ious = [hit.oracle_iou if oracle else hit.iou for hit in hits]
    return mean_of([float(iou >= threshold) for iou in ious])
