"""Dense seeds from photographs: there is no densification, so every surface must be seeded before the first step.

Two sources, both checked against other photographs. Textured pixels get the depth of a plane sweep (stereo.py), if
two other views find a surface at the same place. Pixels between those are given depths interpolated between their
neighbors', and kept if their colors agree in two other views and no other view sees through them.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import Tensor

from gsencoder.core.errors import InputError
from gsencoder.core.process import Track, untracked
from gsencoder.data.photographs import Photographs, ScaledPhotograph
from gsencoder.data.seeding.fill_depths import interpolated_depths, supported_depths
from gsencoder.data.seeding.hull import outside_hull
from gsencoder.data.seeding.stereo import (
    DEPTH_TOLERANCE,
    MAX_PLANES,
    DepthMap,
    back_project,
    confirms,
    count_agreeing,
    depth_range,
    sample_depth,
    sees_through,
    source_views,
    sweep,
)
from gsencoder.types import Cameras

FILLED_SPACING = 2.0
"""Interpolated seeds stand on a grid this many times coarser: they lie where photographs show little detail."""
MAX_SEE_THROUGH = 1
"""A point that no view confirms may be seen through by this many views."""
MIN_SPACING = 0.1
MIN_CORRELATION = 0.6
"""Normalized cross-correlation of two windows, −1 to 1, from which they are taken to show the same surface."""
CELL = 1 / 40
"""Side of the cells in which coverage is counted, as a share of the picture's longer side."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DenseConfig:
    """When seeds are added, and how many."""

    enough: float = field(
        default=0.95,
        metadata={"help": "seeds are added where points reach less than this share of the pictures' cells; 0 = never"},
    )
    spacing: float = field(default=6.0, metadata={"help": "distance of seeds in pixels of a typical photograph"})
    samples: int = field(default=3, metadata={"help": "pixels that must agree on a seed, from all photographs"})
    size: int = field(default=200, metadata={"help": "longer side in pixels of the pictures that are compared"})
    sources: int = field(default=4, metadata={"help": "other photographs that each is compared with"})

    def __post_init__(self) -> None:
        if not 0 <= self.enough <= 1:
            raise InputError(f"enough: expected a share from 0 to 1, got {self.enough}")
        if not MIN_SPACING <= self.spacing < math.inf:
            raise InputError(f"spacing: expected {MIN_SPACING} pixels or more, got {self.spacing}")
        if self.samples < 1:
            raise InputError(f"samples: expected at least 1 pixel, got {self.samples}")
        if self.size < 32:
            raise InputError(f"size: expected at least 32 pixels, got {self.size}")
        if self.sources < 2:
            raise InputError(f"sources: expected at least 2 photographs to compare with, got {self.sources}")


@dataclass(frozen=True, slots=True, kw_only=True)
class DenseSeeds:
    """Structure-from-motion points and the seeds that were added to them.

    Attributes:
        points: all of them, world units relative to the scene's origin.
        colors: RGB.
        swept: how many came from plane sweeps.
        filled: how many were interpolated.
        coverage: mean share of the pictures' cells with a point, before and after.
    """

    points: Float32[np.ndarray, "P 3"]
    colors: UInt8[np.ndarray, "P 3"]
    swept: int
    filled: int
    coverage: tuple[float, float]


def covered_share(photographs: Photographs, views: Sequence[int], points: Float32[np.ndarray, "P 3"]) -> float:
    """Mean share of the pictures' cells into which some point projects, of those with a pixel that is not masked;
    occlusion is not tested. 0 where all are masked."""
    cameras, shares = photographs.cameras, []
    for view in views:
        width, height = int(cameras.widths[view]), int(cameras.heights[view])
        cell, mask = max(1.0, CELL * max(width, height)), photographs.mask(view)
        across, down = math.ceil(width / cell), math.ceil(height / cell)
        in_mask, covered = np.ones((down, across), bool), np.zeros((down, across), bool)
        if mask is not None:
            in_mask[:] = False
            rows, columns = (mask.nonzero().numpy() / cell).astype(np.int64).T
            in_mask[rows, columns] = True
        pixels, depths = cameras.project(points.astype(np.float64), view)
        columns, rows = (pixels[cameras.in_image(pixels, depths, view)] / cell).astype(np.int64).T
        covered[rows, columns] = True
        if in_mask.any():
            shares.append(float(covered[in_mask].mean()))
    return float(np.mean(shares)) if shares else 0.0


def densify(
    photographs: Photographs,
    training: Sequence[int],
    points: Float32[np.ndarray, "P 3"],
    colors: UInt8[np.ndarray, "P 3"],
    config: DenseConfig = DenseConfig(),
    *,
    guide: Float32[np.ndarray, "G 3"] | None = None,
    track: Track = untracked,
) -> DenseSeeds | None:
    """Points on every surface that the training photographs show; None where `points` cover enough. Points where
    photographs show empty space are removed.

    Args:
        photographs: of all views.
        training: the views that may be looked at.
        points: from structure from motion.
        colors: beside them.
        config: settings.
        guide: points that tell which views to compare and at which depths, and are no seeds; None = `points`.
        track: progress.
    """
    cameras = photographs.cameras
    guide = points if guide is None else guide
    before = covered_share(photographs, training, points)
    if before >= config.enough:
        return None
    neighbors = source_views(cameras, guide, training, config.sources)
    photos, poses = scaled_photographs(photographs, training, config.size)
    maps: dict[int, DepthMap] = {}
    for view in track(training, "sweeping planes"):
        limits, others = depth_range(cameras, view, guide), neighbors[view]
        if limits is not None and len(others) >= 2:
            maps[view] = sweep_neighbors(view, others, photos, poses, *limits)
    consistent = consistent_depths(maps, photos, poses, neighbors)
    swept = back_project(consistent, photos, poses)
    interpolated = interpolated_depths(consistent, photos, poses, guide)
    filled = back_project(supported_depths(interpolated, consistent, photos, poses, neighbors), photos, poses)
    voxel = config.spacing * _pixel_size(cameras, consistent)
    swept = carve(*average_by_voxel(*swept, voxel, config.samples), consistent, photos, poses, DEPTH_TOLERANCE)
    filled = average_by_voxel(*filled, FILLED_SPACING * voxel, config.samples, beside=swept[0])
    filled = carve(*filled, consistent, photos, poses, DEPTH_TOLERANCE)
    sparse, swept, filled = (
        (positions[inside], rgb[inside])
        for positions, rgb in ((points, colors), swept, filled)
        for inside in [~outside_hull(positions, photographs, training)]
    )
    positions, rgb = (np.concatenate(arrays) for arrays in zip(sparse, swept, filled, strict=True))
    after = covered_share(photographs, training, positions)
    return DenseSeeds(
        points=positions, colors=rgb, swept=len(swept[0]), filled=len(filled[0]), coverage=(before, after)
    )


def scaled_photographs(
    photographs: Photographs, views: Sequence[int], size: int
) -> tuple[dict[int, ScaledPhotograph], dict[int, Tensor]]:
    """Photographs shrunk by a whole number to a longer side of about `size` pixels, and their cam_from_world."""
    cameras = photographs.cameras
    photos, poses = {}, {}
    for view in views:
        longest = max(int(cameras.widths[view]), int(cameras.heights[view]))
        photos[view] = photographs.at_scale(view, max(1, round(longest / size)))
        poses[view] = torch.from_numpy(cameras.cam_from_world[view].copy())
    return photos, poses


def sweep_neighbors(
    view: int,
    others: Sequence[int],
    photos: Mapping[int, ScaledPhotograph],
    poses: Mapping[int, Tensor],
    near: float,
    far: float,
    *,
    max_planes: int = MAX_PLANES,
) -> DepthMap:
    """The plane sweep of a view against others; its depth is 0 where their windows do not correlate."""
    depth_map = sweep(
        photos[view],
        poses[view],
        [photos[o] for o in others],
        [poses[o] for o in others],
        near,
        far,
        max_planes=max_planes,
    )
    return depth_map._replace(depth=torch.where(depth_map.score >= MIN_CORRELATION, depth_map.depth, 0))


def _pixel_size(cameras: Cameras, depths: Mapping[int, Float[Tensor, "h w"]]) -> float:
    """What a pixel of a typical photograph covers of the known surfaces, in world units."""
    measured = [(view, depth[depth > 0]) for view, depth in depths.items()]
    return float(np.median([float(z.median() / cameras.Ks[view, 0, 0]) for view, z in measured if len(z)] or [1.0]))


def carve(
    points: Float32[np.ndarray, "P 3"],
    colors: UInt8[np.ndarray, "P 3"],
    consistent: Mapping[int, Float[Tensor, "h w"]],
    photos: Mapping[int, ScaledPhotograph],
    poses: Mapping[int, Tensor],
    tolerance: float,
) -> tuple[Float32[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"]]:
    """Removes points in free space: those that more views see through, to a surface behind, than confirm.

    Args:
        points: world units.
        colors: beside them.
        consistent: depths of each view, 0 = unknown.
        photos: the views.
        poses: their cam_from_world.
        tolerance: relative difference of depths that agree; what lies in front by twice as much is seen through.
    """
    positions = torch.from_numpy(points)
    through, confirmed = (torch.zeros(len(points), dtype=torch.int64) for _ in range(2))
    for view, depth in consistent.items():
        z, measured = sample_depth(positions, depth, photos[view], poses[view])
        through += sees_through(z, measured, tolerance)
        confirmed += confirms(z, measured, tolerance)
    keep = (through <= confirmed.clamp(min=MAX_SEE_THROUGH)).numpy()
    return points[keep], colors[keep]


def average_by_voxel(
    points: Float32[np.ndarray, "P 3"],
    colors: UInt8[np.ndarray, "P 3"],
    voxel: float,
    samples: int,
    *,
    beside: Float32[np.ndarray, "Q 3"] | None = None,
) -> tuple[Float32[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"]]:
    """Means of the points and colors of each voxel with at least so many samples; none where `beside` has points."""
    cells = np.floor(points.astype(np.float64) / voxel).astype(np.int64)
    occupied = np.floor(np.empty((0, 3)) if beside is None else beside.astype(np.float64) / voxel).astype(np.int64)
    cells_used, inverse, counts = np.unique(
        np.concatenate((cells, occupied)), axis=0, return_inverse=True, return_counts=True
    )
    inverse = inverse.reshape(-1)
    keep = counts >= samples
    keep[inverse[len(cells) :]] = False
    inverse = inverse[: len(cells)]
    columns = (*points.T.astype(np.float64), *colors.T.astype(np.float64))
    means = np.stack([np.bincount(inverse, column, len(cells_used))[keep] / counts[keep] for column in columns], axis=1)
    return means[:, :3].astype(np.float32), np.round(means[:, 3:]).astype(np.uint8)


def consistent_depths(
    maps: Mapping[int, DepthMap],
    photos: Mapping[int, ScaledPhotograph],
    poses: Mapping[int, Tensor],
    neighbors: Mapping[int, Sequence[int]],
    tolerance: float = DEPTH_TOLERANCE,
) -> dict[int, Float[Tensor, "h w"]]:
    """Depths that two other views confirm; 0 elsewhere."""
    consistent = {}
    for view, depth_map in maps.items():
        others = [(maps[other], photos[other], poses[other]) for other in neighbors[view] if other in maps]
        votes = count_agreeing(depth_map.depth, photos[view], poses[view], others, tolerance)
        consistent[view] = torch.where(votes >= 2, depth_map.depth, 0)
    return consistent
