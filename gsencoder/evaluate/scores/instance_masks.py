"""Instances of a scene as sets of its vertices: those of the truth, and masks with classes and scores."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from gsencoder.core.errors import InputError


@dataclass(frozen=True, slots=True, kw_only=True)
class InstanceTruth:
    """The instance of each vertex of a scene.

    Attributes:
        scene: its name.
        ids: class id · 1000 + number of the instance; other ids, such as 0, are no instance.
    """

    scene: str
    ids: Int64[np.ndarray, " V"]


@dataclass(frozen=True, slots=True, kw_only=True)
class InstancePrediction:
    """Masks of a scene, each with a class and a score; masks may overlap.

    Attributes:
        scene: its name.
        num_vertices: of the scene, V.
        vertices: of all masks, one mask after the other; ascending within a mask.
        offsets: where each mask begins in `vertices`, and at last their number.
        labels: class ids.
        scores: finite; predictions are ranked by them.
    """

    scene: str
    num_vertices: int
    vertices: Int64[np.ndarray, " E"]
    offsets: Int64[np.ndarray, " M_1"]
    labels: Int64[np.ndarray, " M"]
    scores: Float64[np.ndarray, " M"]

    def __post_init__(self) -> None:
        masks, ends = len(self.labels), self.offsets
        if len(self.scores) != masks or len(ends) != masks + 1:
            raise InputError(
                f"{self.scene}: expected as many labels as scores and masks, got {masks} labels, {len(self.scores)} "
                f"scores and {len(ends) - 1} masks"
            )
        if ends[0] != 0 or ends[-1] != len(self.vertices) or (np.diff(ends) < 0).any():
            raise InputError(
                f"{self.scene}: the offsets of the masks do not divide their {len(self.vertices):,} vertices"
            )
        if not np.isfinite(self.scores).all():
            worst = int(np.flatnonzero(~np.isfinite(self.scores))[0])
            raise InputError(
                f"{self.scene}: prediction {worst} has the score {self.scores[worst]}; expected finite scores"
            )
        rising = np.diff(self.vertices) > 0
        rising[ends[(ends > 0) & (ends < len(self.vertices))] - 1] = True
        if not rising.all():
            raise InputError(f"{self.scene}: the vertices of a mask are not ascending, each once")
        if len(self.vertices) and not (self.vertices.min() >= 0 and self.vertices.max() < self.num_vertices):
            raise InputError(f"{self.scene}: a mask has a vertex outside of the scene's {self.num_vertices:,}")

    def mask(self, index: int) -> Int64[np.ndarray, " n"]:
        """The vertices of one mask."""
        return self.vertices[self.offsets[index] : self.offsets[index + 1]]


def prediction_of_masks(
    scene: str,
    masks: Sequence[Bool[np.ndarray, " V"]] | Bool[np.ndarray, "M V"],
    labels: Sequence[int],
    scores: Sequence[float],
    *,
    num_vertices: int,
) -> InstancePrediction:
    """The prediction of masks that say for each vertex whether it belongs to them.

    Raises:
        InputError: masks of another length than `num_vertices`, or what `InstancePrediction` refuses.
    """
    for index, mask in enumerate(masks):
        if len(mask) != num_vertices:
            raise InputError(f"{scene}: mask {index} has {len(mask):,} vertices, and the scene {num_vertices:,}")
    parts = [np.flatnonzero(mask) for mask in masks]
    return InstancePrediction(
        scene=scene,
        num_vertices=num_vertices,
        vertices=np.concatenate([np.zeros(0, np.int64), *parts]),
        offsets=np.cumsum([0, *(len(part) for part in parts)], dtype=np.int64),
        labels=np.array(labels, np.int64),
        scores=np.array(scores, np.float64),
    )
