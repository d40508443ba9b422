"""Which Gaussians of a scene a training sample holds: those in the frusta of a few views, and no more than fit."""

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float32, Int64

from gsencoder.core.errors import InputError
from gsencoder.types import Cameras

_AROUND = 4
"""Times the size of a crop: so many of the nearest Gaussians are held against the frusta before all are."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SamplingConfig:
    """How a sample is cut out of a scene (SplatDistill sec. 3.3, "view-dependent selection")."""

    scope: Literal["frusta", "scene"] = field(
        default="frusta", metadata={"help": "Gaussians in the frusta of the target views, or of the whole scene"}
    )
    views: int = field(default=4, metadata={"help": "target views of a sample; render losses are taken in them"})
    gaussians: int = field(default=30_000, metadata={"help": "most Gaussians of a sample, nearest first; 0 = all"})
    smallest: int = field(
        default=4_000, metadata={"help": "crops are of sizes from this up to the most, in equal ratios; 0 = all of one"}
    )
    rare_centers: float = field(
        default=0.8, metadata={"help": "share of crops whose center is of any kind of target alike, not just anywhere"}
    )

    def __post_init__(self) -> None:
        if self.views < 1:
            raise InputError(f"views: expected at least 1 target view, got {self.views}")
        if self.gaussians < 0:
            raise InputError(f"gaussians: expected 0 (all) or more, got {self.gaussians}")
        if self.smallest < 0:
            raise InputError(f"smallest: expected 0 (crops of one size) or more, got {self.smallest}")
        if not 0 <= self.rare_centers <= 1:
            raise InputError(f"rare_centers: expected a share in [0, 1], got {self.rare_centers}")


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


def nearest(means: Float32[np.ndarray, "n 3"], center: Float32[np.ndarray, "3"], count: int) -> Int64[np.ndarray, " m"]:
    """The `count` rows nearest to a point, in ascending order of rows; all of them where there are no more."""
    if len(means) <= count:
        return np.arange(len(means))
    distances = np.square(means - center).sum(axis=1)
    return np.sort(np.argpartition(distances, count)[:count])


def crop_size(config: SamplingConfig, rng: np.random.Generator) -> int:
    """How many Gaussians a crop holds at most; 0 = all. Small crops show small things often; large ones show what a
    door or a sofa can be told by."""
    if not 0 < config.smallest < config.gaussians:
        return config.gaussians
    return round(config.smallest * (config.gaussians / config.smallest) ** rng.random())


def choose_part(
    means: Float32[np.ndarray, "N 3"],
    cameras: Cameras,
    chances: Float32[np.ndarray, " N"],
    config: SamplingConfig,
    size: int,
    rng: np.random.Generator,
) -> tuple[tuple[int, ...], Int64[np.ndarray, " n"]]:
    """Target views, and the rows of the sample that is cut for them.

    Without a limit the views are drawn first, and everything in their frusta is taken, as in the paper. With one, the
    center of the crop is drawn first and the views are among those that look at it: views that look elsewhere would
    show nothing of the sample.

    Args:
        means: of the whole scene.
        cameras: of all its views.
        chances: of each Gaussian to be the center of a crop; 0 = has no target, and never is.
        config: see there.
        size: most Gaussians (`crop_size`); 0 = all.
        rng: everything random comes from it.

    Returns:
        Views without repetition (all that there are, where there are no more than asked for), and rows, ascending.

    Raises:
        InputError: no Gaussian lies in the frustum of any view.
    """
    everywhere = config.scope == "scene"
    if not 0 < size < len(means):
        drawn = rng.permutation(len(cameras))
        views = drawn[: config.views]
        rows = np.arange(len(means)) if everywhere else np.flatnonzero(in_frusta(means, cameras.select(views)))
        for view in drawn[config.views :]:
            if len(rows):
                break
            # A camera that looks into the void is no reason to stop; another takes its place.
            views = np.array([view])
            rows = np.flatnonzero(in_frusta(means, cameras.select(views)))
    else:
        center = means[_draw(chances, config, rng)]
        looking = np.flatnonzero(seen_by(center, cameras))
        views = rng.permutation(looking if len(looking) else len(cameras))[: config.views]
        rows = nearest(means, center, len(means) if everywhere else _AROUND * size)
        if not everywhere:
            chosen = cameras.select(views)
            rows = rows[in_frusta(means[rows], chosen)]
            if len(rows) < size:
                rows = np.flatnonzero(in_frusta(means, chosen))
            if not len(rows):  # Nobody looks at the center, and these views see nothing: take whoever sees something.
                views = rng.permutation(len(cameras))
                rows = np.flatnonzero(in_frusta(means, cameras))
        rows = rows[nearest(means[rows], center, size)]
    if not len(rows):
        raise InputError("sample: no Gaussian lies in the frustum of any view; check poses and units")
    return tuple(int(view) for view in views), rows


def _draw(chances: Float32[np.ndarray, " N"], config: SamplingConfig, rng: np.random.Generator) -> int:
    """The center of a crop."""
    each = chances.astype(np.float64)
    if rng.random() >= config.rare_centers:
        each = (each > 0).astype(np.float64)
    total = np.cumsum(each)
    if not 0 < total[-1] < math.inf:
        return int(rng.integers(len(chances)))
    return int(min(np.searchsorted(total, rng.random() * total[-1], side="right"), len(chances) - 1))


def thin_out(rows: Int64[np.ndarray, " n"], most: float, rng: np.random.Generator) -> Int64[np.ndarray, " m"]:
    """Leaves out a random share of rows, at most `most` of them on average; never all."""
    if not most:
        return rows
    kept = rows[rng.random(len(rows)) >= rng.uniform(0, most)]
    return kept if len(kept) else rows
