"""Which Gaussians of a scene a training sample holds: those in the frusta of a few views, and no more than fit."""

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float32, Int64

from gsencoder.errors import InputError
from gsencoder.types import Cameras


@dataclass(frozen=True, slots=True, kw_only=True)
class SamplingConfig:
    """How a sample is cut out of a scene (SplatDistill sec. 3.3, "view-dependent selection")."""

    scope: Literal["frusta", "scene"] = field(
        default="frusta", metadata={"help": "Gaussians in the frusta of the target views, or of the whole scene"}
    )
    views: int = field(default=4, metadata={"help": "target views of a sample; render losses are taken in them"})
    gaussians: int = field(default=30_000, metadata={"help": "most Gaussians of a sample, nearest first; 0 = all"})
    rare_centers: float = field(
        default=0.5, metadata={"help": "share of crops whose centre is drawn by rarity of its target, not evenly"}
    )

    def __post_init__(self) -> None:
        if self.views < 1:
            raise InputError(f"views: expected at least 1 target view, got {self.views}")
        if self.gaussians < 0:
            raise InputError(f"gaussians: expected 0 (all) or more, got {self.gaussians}")
        if not 0 <= self.rare_centers <= 1:
            raise InputError(f"rare_centers: expected a share in [0, 1], got {self.rare_centers}")


def in_frusta(means: Float32[np.ndarray, "N 3"], cameras: Cameras, *, near: float = 0.01) -> Bool[np.ndarray, " N"]:
    """True for Gaussians whose centre lies in the image of at least one camera and beyond its near plane.

    Args:
        means: in the cameras' world.
        cameras: all of them count.
        near: smallest depth, world units.
    """
    inside = np.zeros(len(means), bool)
    for pose, K, width, height in zip(cameras.cam_from_world, cameras.Ks, cameras.widths, cameras.heights, strict=True):
        # The rows that are found already need not be looked at again.
        rows = np.flatnonzero(~inside)
        x, y, z = (means[rows] @ pose[:3, :3].T + pose[:3, 3]).T
        safe = np.where(z > near, z, 1)
        u, v = K[0, 0] * x / safe + K[0, 2], K[1, 1] * y / safe + K[1, 2]
        inside[rows] = (z > near) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    return inside


def nearest(means: Float32[np.ndarray, "n 3"], center: Float32[np.ndarray, "3"], count: int) -> Int64[np.ndarray, " m"]:
    """The `count` rows nearest to a point, in ascending order of rows; all of them where there are no more."""
    if len(means) <= count:
        return np.arange(len(means))
    distances = np.square(means - center).sum(axis=1)
    return np.sort(np.argpartition(distances, count)[:count])


def choose_views(count: int, config: SamplingConfig, rng: np.random.Generator) -> tuple[int, ...]:
    """Target views, drawn without repetition; all of them where there are no more."""
    return tuple(int(view) for view in rng.permutation(count)[: config.views])


def choose_rows(
    means: Float32[np.ndarray, "N 3"],
    cameras: Cameras,
    rarity: Float32[np.ndarray, " N"],
    config: SamplingConfig,
    rng: np.random.Generator,
) -> Int64[np.ndarray, " n"]:
    """Rows of a sample, ascending.

    Args:
        means: of the whole scene.
        cameras: the target views.
        rarity: how rare each Gaussian's target is; 0 = has none, and is never the centre of a crop.
        config: see there.
        rng: everything random comes from it.

    Raises:
        InputError: no Gaussian lies in any frustum.
    """
    rows = np.arange(len(means)) if config.scope == "scene" else np.flatnonzero(in_frusta(means, cameras))
    if not len(rows):
        raise InputError("sample: no Gaussian lies in the frusta of the chosen views; check poses and units")
    if 0 < config.gaussians < len(rows):
        chances = rarity[rows].astype(np.float64)
        if rng.random() >= config.rare_centers:
            chances = (chances > 0).astype(np.float64)
        total = chances.sum()
        center = rng.choice(len(rows), p=chances / total) if 0 < total < math.inf else rng.integers(len(rows))
        rows = rows[nearest(means[rows], means[rows[center]], config.gaussians)]
    return rows


def thin_out(rows: Int64[np.ndarray, " n"], most: float, rng: np.random.Generator) -> Int64[np.ndarray, " m"]:
    """Leaves out a random share of rows, at most `most` of them on average; never all."""
    if not most:
        return rows
    kept = rows[rng.random(len(rows)) >= rng.uniform(0, most)]
    return kept if len(kept) else rows
