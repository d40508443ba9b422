"""Localizations: relevancy of words on Gaussians, and the boxes of each word."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Integer


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Box:
    """A box of a query, in world coordinates with the origin of the scene added.

    Attributes:
        query: the word.
        rank: 0 = best of its query.
        score: see infer/localize/boxes.py.
        probability: that the Gaussians inside are what the word says; see infer/localize/presence.py.
        aabb_min, aabb_max: axis-aligned corners.
        obb_center, obb_rotation, obb_size: oriented box; columns of the rotation are its axes.
        rows: the Gaussians inside, as row numbers.
    """

    query: str
    rank: int
    score: float
    probability: float
    aabb_min: Float64[np.ndarray, "3"]
    aabb_max: Float64[np.ndarray, "3"]
    obb_center: Float64[np.ndarray, "3"]
    obb_rotation: Float64[np.ndarray, "3 3"]
    obb_size: Float64[np.ndarray, "3"]
    rows: Integer[np.ndarray, " n"]

    @property
    def center(self) -> Float64[np.ndarray, "3"]:
        return (self.aabb_min + self.aabb_max) / 2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Localization:
    """What a set of words found.

    Attributes:
        queries: the words, in the order asked.
        relevancy: one score a word and Gaussian, in [−1, 1] or [0, 1]; NaN where the Gaussian was never seen.
        thresholds: the relevancy above which a Gaussian was taken, for each word.
        probabilities: that a word is in the scene: the highest of its boxes, those included that were left out as too
            improbable; 0 where no Gaussians answer it.
        boxes: best first within each query, queries in order.
    """

    queries: tuple[str, ...]
    relevancy: Float32[np.ndarray, "Q N"]
    thresholds: Float32[np.ndarray, " Q"]
    probabilities: Float32[np.ndarray, " Q"]
    boxes: tuple[Box, ...]

    @property
    def absent(self) -> dict[str, float]:
        """The words without a box, and their probabilities."""
        boxed = {box.query for box in self.boxes}
        return {
            word: float(value)
            for word, value in zip(self.queries, self.probabilities, strict=True)
            if word not in boxed
        }
