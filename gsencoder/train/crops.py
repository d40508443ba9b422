"""Crops: selection of the Gaussians of a training sample, those in the frusta of a few views up to a maximum number."""

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float32, Int64

from gsencoder.core.errors import InputError
from gsencoder.types import Cameras

_CANDIDATES_PER_GAUSSIAN = 4
"""Gaussians nearest to the center that are tested against the frusta first, as a multiple of the size of a crop."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SamplingConfig:
    """Selection of the Gaussians and views of a sample (SplatDistill sec. 3.3, "view-dependent selection")."""

    scope: Literal["frusta", "scene"] = field(
        default="frusta",
        metadata={"help": "candidates: Gaussians in the frusta of the target views, or all of the scene"},
    )
    views: int = field(
        default=4, metadata={"help": "number of target views of a sample, in which the render loss is computed"}
    )
    gaussians: int = field(
        default=30_000,
        metadata={"help": "largest number of Gaussians of a sample, nearest to its center first; 0 = all"},
    )
    smallest: int = field(
        default=4_000,
        metadata={"help": "smallest size of a crop; sizes are log-uniform up to `gaussians`; 0 = all of that size"},
    )
    rare_centers: float = field(
        default=0.8,
        metadata={"help": "share of crops whose center is drawn evenly over target classes instead of over Gaussians"},
    )

    def __post_init__(self) -> None:
        if self.views < 1:
            raise InputError(f"views: expected at least 1 target view, got {self.views}")
        if self.gaussians < 0:
            raise InputError(f"gaussians: expected 0 (no limit) or more, got {self.gaussians}")
        if self.smallest < 0:
            raise InputError(f"smallest: expected 0 (crops of one size) or more, got {self.smallest}")
        if not 0 <= self.rare_centers <= 1:
            raise InputError(f"rare_centers: expected a number in [0, 1], got {self.rare_centers}")


def in_frusta(means: Float32[np.ndarray, "N 3"], cameras: Cameras, *, near: float = 0.01) -> Bool[np.ndarray, " N"]:
    """True for Gaussians whose center lies in the image of at least one camera and beyond its near plane.

    Args:
        means: in the cameras' world.
        cameras: all of them count.
        near: smallest depth, world units.
    """
    inside = np.zeros(len(means), bool)
    for view in range(len(cameras)):
        # The rows that are found already need not be looked at again.
        rows = np.flatnonzero(~inside)
        inside[rows] = cameras.in_image(*cameras.project(means[rows], view), view, near=near)
    return inside


def seen_by(point: Float32[np.ndarray, "3"], cameras: Cameras, *, near: float = 0.01) -> Bool[np.ndarray, " V"]:
    """True for cameras in whose image a point lies, beyond the near plane."""
    return cameras.in_image(*cameras.project(point[None]), near=near)[:, 0]


def nearest_rows(
    means: Float32[np.ndarray, "n 3"], center: Float32[np.ndarray, "3"], count: int
) -> Int64[np.ndarray, " m"]:
    """The `count` rows nearest to a point, in ascending order; all rows if there are not more."""
    if len(means) <= count:
        return np.arange(len(means))
    distances = np.square(means - center).sum(axis=1)
    return np.sort(np.argpartition(distances, count)[:count])


def crop_size(config: SamplingConfig, rng: np.random.Generator) -> int:
    """Draws the largest number of Gaussians of a crop; 0 = no limit.

    Small crops show small objects often; large ones show the context by which a door or a sofa is recognized.
    """
    if not 0 < config.smallest < config.gaussians:
        return config.gaussians
    return round(config.smallest * (config.gaussians / config.smallest) ** rng.random())


def choose_crop(
    means: Float32[np.ndarray, "N 3"],
    cameras: Cameras,
    center_weights: Float32[np.ndarray, " N"],
    config: SamplingConfig,
    size: int,
    rng: np.random.Generator,
) -> tuple[tuple[int, ...], Int64[np.ndarray, " n"]]:
    """Chooses target views and the Gaussians of a sample.

    Without a limit of size the views are drawn first and all Gaussians in their frusta are taken, as in the paper. With
    a limit the center of the crop is drawn first, and the views are drawn from those that see it: other views would
    show nothing of the sample.

    Args:
        means: centers of all Gaussians of the scene.
        cameras: all cameras of the scene.
        center_weights: for each Gaussian, its weight in drawing the center of a crop; 0 for those without a target.
        config: settings of sampling.
        size: largest number of Gaussians (`crop_size`); 0 = no limit.
        rng: source of all random numbers.

    Returns:
        Distinct views, fewer than `config.views` if no more are suitable, and rows in ascending order.

    Raises:
        InputError: no Gaussian lies in the frustum of any view.
    """
    full_scene = config.scope == "scene"
    if not 0 < size < len(means):
        drawn = rng.permutation(len(cameras))
        views = drawn[: config.views]
        rows = np.arange(len(means)) if full_scene else np.flatnonzero(in_frusta(means, cameras.select(views)))
        for view in drawn[config.views :]:
            if len(rows):
                break
            # A view that sees nothing is replaced by another one.
            views = np.array([view])
            rows = np.flatnonzero(in_frusta(means, cameras.select(views)))
    else:
        center = means[_draw_center(center_weights, config, rng)]
        seeing = np.flatnonzero(seen_by(center, cameras))
        views = rng.permutation(seeing if len(seeing) else len(cameras))[: config.views]
        rows = nearest_rows(means, center, len(means) if full_scene else _CANDIDATES_PER_GAUSSIAN * size)
        if not full_scene:
            selected = cameras.select(views)
            rows = rows[in_frusta(means[rows], selected)]
            if len(rows) < size:
                rows = np.flatnonzero(in_frusta(means, selected))
            if not len(rows):  # No view sees the center, and those drawn see no Gaussian at all: use all views.
                views = rng.permutation(len(cameras))
                rows = np.flatnonzero(in_frusta(means, cameras))
        rows = rows[nearest_rows(means[rows], center, size)]
    if not len(rows):
        raise InputError("sample: no Gaussian lies in the frustum of any view; check poses and units")
    return tuple(int(view) for view in views), rows


def _draw_center(center_weights: Float32[np.ndarray, " N"], config: SamplingConfig, rng: np.random.Generator) -> int:
    """Draws the row of the center of a crop."""
    weights = center_weights.astype(np.float64)
    if rng.random() >= config.rare_centers:
        weights = (weights > 0).astype(np.float64)
    cumulative = np.cumsum(weights)
    if not 0 < cumulative[-1] < math.inf:
        return int(rng.integers(len(center_weights)))
    return int(min(np.searchsorted(cumulative, rng.random() * cumulative[-1], side="right"), len(center_weights) - 1))


def drop_random(rows: Int64[np.ndarray, " n"], max_share: float, rng: np.random.Generator) -> Int64[np.ndarray, " m"]:
    """Drops each row with one probability that is drawn between 0 and `max_share`; never drops all rows."""
    if not max_share:
        return rows
    remaining = rows[rng.random(len(rows)) >= rng.uniform(0, max_share)]
    return remaining if len(remaining) else rows
