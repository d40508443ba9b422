"""Acc@k: how often the best box for a word overlaps the object of that name (ScanRefer's protocol, axis-aligned)."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from gsencoder.types import Box, Localization, Scene, SceneObject


@dataclass(frozen=True, slots=True, kw_only=True)
class Hit:
    """One object that was asked for by its name.

    Attributes:
        scene: its scene.
        name: its name.
        iou: of the top box of that name with the nearest object of that name; 0 if there is no box.
        oracle_iou: the best over all boxes of that name: the paper's protocol, which no user can follow.
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
    """Intersection over union of two axis-aligned boxes; 0 if either has no volume."""
    overlap = np.prod(np.clip(np.minimum(max_a, max_b) - np.maximum(min_a, min_b), 0, None))
    union = np.prod(max_a - min_a) + np.prod(max_b - min_b) - overlap
    return float(overlap / union) if union > 0 else 0.0


def asked_objects(objects: Sequence[SceneObject], *, min_views: int = 5, min_pixels: int = 60) -> list[SceneObject]:
    """The small objects that have a name and were seen well enough to be asked for."""
    return [o for o in objects if o.placed and o.name and o.views >= min_views and o.max_pixels >= min_pixels]


def score_boxes(scene: Scene, localization: Localization, asked: Sequence[SceneObject]) -> list[Hit]:
    """Holds the boxes of each asked name against all objects of that name."""
    boxes: dict[str, list[Box]] = {}
    for box in localization.boxes:
        boxes.setdefault(box.query, []).append(box)
    hits = []
    for target in asked:
        assert target.name is not None
        same = [o for o in scene.objects if o.name == target.name]
        found = sorted(boxes.get(target.name, []), key=lambda box: box.rank)
        ious = [max(aabb_iou(b.aabb_min, b.aabb_max, o.aabb_min, o.aabb_max) for o in same) for b in found]
        hits.append(
            Hit(scene=scene.name, name=target.name, iou=ious[0] if ious else 0.0, oracle_iou=max(ious, default=0.0))
        )
    return hits


def accuracy(hits: Iterable[Hit], threshold: float, *, oracle: bool = False) -> float:
    """Share of hits whose IoU is at least `threshold`; NaN for none."""
    ious = [hit.oracle_iou if oracle else hit.iou for hit in hits]
    return float(np.mean([iou >= threshold for iou in ious])) if ious else float("nan")
