"""Seeds for posed photographs without depth and without points: triangulated matches, then plane sweeps.

Where few features match, as on smooth walls and in small pictures, a first sweep of small pictures over all depths that
the cameras allow finds rough points; they tell the second one at which depths to look.

There is no densification, so every surface must be seeded before the first step. Textured pixels get the depth of a
plane sweep (stereo.py), if two other views find a surface at the same place. Pixels between those are given depths
interpolated between their neighbors', and kept if their colors agree in two other photographs and no other view sees
through them.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, UInt8
from torch import Tensor

from gsencoder.core.errors import InputError
from gsencoder.core.process import Track, untracked
from gsencoder.core.settings import CheckedConfig, option
from gsencoder.data.photographs import Photographs, ScaledPhotograph
from gsencoder.data.seeding.matches import overlaps, triangulate, typical_distance
from gsencoder.data.seeding.points import seed_from_points
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
    to_grid,
    window_mean,
    world_points,
)
from gsencoder.geometry import transform
from gsencoder.types import Cameras, Gaussians, Views

COLOR_TOLERANCE = 0.06  # Largest mean difference of the colors (0 to 1) of one surface in two photographs


def interpolated_depths(
    consistent: Mapping[int, Float[Tensor, "h w"]],
    photos: Mapping[int, ScaledPhotograph],
    poses: Mapping[int, Tensor],
    points: Float32[np.ndarray, "P 3"],
) -> dict[int, Float[Tensor, "h w"]]:
    """Depth at every pixel of every view: that of its plane sweep (`consistent`, 0 = unknown), else that of the nearest
    point that projects there, else one between those of its neighbors."""
    cloud = torch.cat((torch.from_numpy(points), torch.from_numpy(back_project(consistent, photos, poses)[0])))
    return {
        view: interpolate(torch.where(depth > 0, depth, splat_depths(cloud, photos[view], poses[view])))
        for view, depth in consistent.items()
    }


def supported_depths(
    interpolated: Mapping[int, Float[Tensor, "h w"]],
    consistent: Mapping[int, Float[Tensor, "h w"]],
    photos: Mapping[int, ScaledPhotograph],
    poses: Mapping[int, Tensor],
    neighbors: Mapping[int, Sequence[int]],
) -> dict[int, Float[Tensor, "h w"]]:
    """Interpolated depths whose colors two neighbors confirm, and that no neighbor sees through; 0 elsewhere, and where
    plane sweeps (`consistent`) found one."""
    smooth = {view: window_mean(photos[view].image.permute(2, 0, 1)[None])[0] for view in interpolated}
    supported = {}
    for view, depth in interpolated.items():
        candidates = (consistent[view] == 0) & (depth > 0)
        mask = photos[view].mask
        if mask is not None:
            candidates &= mask
        points = world_points(depth, photos[view], poses[view])[candidates]
        colors = smooth[view].permute(1, 2, 0)[candidates]
        votes = torch.zeros(len(points), dtype=torch.int64)
        seen_through = torch.zeros(len(points), dtype=torch.bool)
        for other in neighbors[view]:
            if other not in interpolated:
                continue
            grid, inside = to_grid(transform(poses[other], points), photos[other])
            warped = torch.nn.functional.grid_sample(smooth[other][None], grid[None, None], align_corners=False)
            difference = (warped[0, :, 0].T - colors).abs().mean(dim=-1)
            votes += inside & (difference <= COLOR_TOLERANCE)
            z, measured = sample_depth(points, consistent[other], photos[other], poses[other])
            seen_through |= sees_through(z, measured, DEPTH_TOLERANCE)
        is_supported = torch.zeros_like(candidates)
        is_supported[candidates] = (votes >= 2) & ~seen_through
        supported[view] = torch.where(is_supported, depth, 0)
    return supported


def splat_depths(
    cloud: Float[Tensor, "P 3"], photo: ScaledPhotograph, pose: Float[Tensor, "4 4"]
) -> Float[Tensor, "h w"]:
    """The depth of the nearest point that projects into each pixel, 0 where none does."""
    camera = transform(pose, cloud)
    grid, inside = to_grid(camera, photo)
    camera, grid = camera[inside], grid[inside]
    height, width = photo.image.shape[:2]
    column, row = ((grid + 1) / 2 * torch.tensor([width, height])).long().unbind(-1)
    index = row.clamp(max=height - 1) * width + column.clamp(max=width - 1)
    nearest = torch.full((height * width,), torch.inf)
    nearest.scatter_reduce_(0, index, camera[:, 2], "amin")
    return torch.where(nearest.isfinite(), nearest, 0).reshape(height, width)


def interpolate(depth: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Fills depths of 0 with means of ever larger surroundings (push–pull), in 1/depth, in which planes are linear."""
    has_depth = (depth > 0).float()
    inverse = torch.where(depth > 0, 1 / depth.clamp(min=1e-9), 0)
    levels: list[tuple[Tensor, Tensor]] = [(inverse, has_depth)]
    while max(levels[-1][0].shape) > 1:
        value, weight = (
            torch.nn.functional.avg_pool2d(part[None], 2, ceil_mode=True)[0]
            for part in (levels[-1][0] * levels[-1][1], levels[-1][1])
        )
        levels.append((value / weight.clamp(min=1e-9), (weight > 0).float()))
    result = levels[-1][0]
    for value, weight in reversed(levels[:-1]):
        coarse = torch.nn.functional.interpolate(result[None, None], size=value.shape, mode="bilinear")[0, 0]
        result = torch.where(weight > 0, value, coarse)
    return torch.where(depth > 0, depth, torch.where(result > 0, 1 / result.clamp(min=1e-9), 0))


MIN_VIEWS = 2  # Photographs that must show a point's place to be empty: one pose may be off


def outside_hull(
    points: Float32[np.ndarray, "P 3"], photographs: Photographs, training: Sequence[int]
) -> Bool[np.ndarray, " P"]:
    """Which points lie where photographs show that nothing is."""
    cameras, seen_empty = photographs.cameras, np.zeros(len(points), np.int64)
    for view in training:
        empty = photographs.empty[view]
        if empty is None:
            continue
        pixels, depths = cameras.project(points.astype(np.float64), view)
        inside = cameras.in_image(pixels, depths, view)
        columns, rows = torch.from_numpy(pixels[inside].astype(np.int64)).unbind(1)
        seen_empty[inside] += empty[rows, columns].numpy()
    return np.asarray(seen_empty >= min(MIN_VIEWS, len(training)))


FILLED_SPACING = 2.0
"""Interpolated seeds stand on a grid this many times coarser: they lie where photographs show little detail."""
MAX_SEE_THROUGH = 1  # A point that no view confirms may be seen through by this many views
MIN_CORRELATION = 0.6
"""Normalized cross-correlation of two windows, −1 to 1, from which they are taken to show the same surface."""
SIZE, SOURCES = 200, 4  # Longer side in pixels of the pictures that are compared, and with how many others each is
CELL = 1 / 40  # Side of the cells in which coverage is counted, as a share of the picture's longer side


@dataclass(frozen=True, slots=True, kw_only=True)
class DenseConfig(CheckedConfig):
    """When seeds are added, and how many."""

    enough: float = option(
        0.95, "seeds are added where points reach less than this share of the pictures' cells; 0 = never", ge=0, le=1
    )
    spacing: float = option(6.0, "distance of seeds in pixels of a typical photograph", ge=0.1, lt=math.inf)
    samples: int = option(3, "pixels that must agree on a seed, from all photographs", ge=1)


@dataclass(frozen=True, slots=True, kw_only=True)
class DenseSeeds:
    """Structure-from-motion points and the seeds that were added to them."""

    points: Float32[np.ndarray, "P 3"]  # all of them, world units relative to the scene's origin
    colors: UInt8[np.ndarray, "P 3"]  # RGB
    swept: int  # how many came from plane sweeps
    filled: int  # how many were interpolated
    coverage: tuple[float, float]  # mean share of the pictures' cells with a point, before and after
    triangulated: int | None = None  # how many are points of matched features; None where those were given


def covered_share(photographs: Photographs, views: Sequence[int], points: Float32[np.ndarray, "P 3"]) -> float:
    """Mean share of the pictures' cells into which some point projects, of those with a pixel that is not masked;
    occlusion is not tested. 0 where all are masked."""
    cameras, shares = photographs.cameras, []
    for view in views:
        width, height = int(cameras.widths[view]), int(cameras.heights[view])
        cell, mask = max(1.0, CELL * max(width, height)), photographs.masks[view]
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
        guide: points that tell which views to compare and at which depths, and are no seeds; None = `points`.
    """
    cameras = photographs.cameras
    guide = points if guide is None else guide
    before = covered_share(photographs, training, points)
    if before >= config.enough:
        return None
    neighbors = source_views(cameras, guide, training, SOURCES)
    photos, poses = scaled_photographs(photographs, training, SIZE)
    limits = {view: depth_range(cameras, view, guide) for view in training}
    consistent = consistent_depths(photos, poses, neighbors, limits, track(training, "sweeping planes"))
    swept = back_project(consistent, photos, poses)
    interpolated = interpolated_depths(consistent, photos, poses, guide)
    filled = back_project(supported_depths(interpolated, consistent, photos, poses, neighbors), photos, poses)
    voxel = config.spacing * _pixel_size(cameras, consistent)
    swept = carve(*average_by_voxel(*swept, voxel, config.samples), consistent, photos, poses)
    filled = average_by_voxel(*filled, FILLED_SPACING * voxel, config.samples, occupied=swept[0])
    filled = carve(*filled, consistent, photos, poses)
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


def consistent_depths(
    photos: Mapping[int, ScaledPhotograph],
    poses: Mapping[int, Tensor],
    neighbors: Mapping[int, Sequence[int]],
    limits: Mapping[int, tuple[float, float] | None],
    views: Iterable[int],
    *,
    max_planes: int = MAX_PLANES,
    tolerance: float = DEPTH_TOLERANCE,
) -> dict[int, Float[Tensor, "h w"]]:
    """Depths of plane sweeps that two neighbors confirm, 0 elsewhere, of the views with two neighbors or more.

    Args:
        limits: the nearest and the largest depth to sweep; None = the view is left out.
        tolerance: largest relative difference of two depths of one surface.
    """
    maps: dict[int, DepthMap] = {}
    for view in views:
        depths, others = limits[view], neighbors[view]
        if depths is None or len(others) < 2:
            continue
        sources, source_poses = [photos[other] for other in others], [poses[other] for other in others]
        found = sweep(photos[view], poses[view], sources, source_poses, *depths, max_planes=max_planes)
        maps[view] = found._replace(depth=torch.where(found.score >= MIN_CORRELATION, found.depth, 0))
    consistent = {}
    for view, depth_map in maps.items():
        swept = [(maps[other], photos[other], poses[other]) for other in neighbors[view] if other in maps]
        votes = count_agreeing(depth_map.depth, photos[view], poses[view], swept, tolerance)
        consistent[view] = torch.where(votes >= 2, depth_map.depth, 0)
    return consistent


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
) -> tuple[Float32[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"]]:
    """Removes points in free space: points that more views see through, to a surface behind, than confirm."""
    positions = torch.from_numpy(points)
    through, confirmed = (torch.zeros(len(points), dtype=torch.int64) for _ in range(2))
    for view, depth in consistent.items():
        z, measured = sample_depth(positions, depth, photos[view], poses[view])
        through += sees_through(z, measured, DEPTH_TOLERANCE)
        confirmed += confirms(z, measured, DEPTH_TOLERANCE)
    keep = (through <= confirmed.clamp(min=MAX_SEE_THROUGH)).numpy()
    return points[keep], colors[keep]


def average_by_voxel(
    points: Float32[np.ndarray, "P 3"],
    colors: UInt8[np.ndarray, "P 3"],
    voxel: float,
    samples: int,
    *,
    occupied: Float32[np.ndarray, "Q 3"] | None = None,
) -> tuple[Float32[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"]]:
    """Means of the points and colors of each voxel with at least `samples` samples, except `occupied` ones."""
    cells = np.floor(points.astype(np.float64) / voxel).astype(np.int64)
    others = points[:0] if occupied is None else occupied
    taken = np.floor(others.astype(np.float64) / voxel).astype(np.int64)
    cells_used, inverse, counts = np.unique(
        np.concatenate((cells, taken)), axis=0, return_inverse=True, return_counts=True
    )
    inverse = inverse.reshape(-1)
    keep = counts >= samples
    keep[inverse[len(cells) :]] = False
    inverse = inverse[: len(cells)]
    columns = (*points.T.astype(np.float64), *colors.T.astype(np.float64))
    means = np.stack([np.bincount(inverse, column, len(cells_used))[keep] / counts[keep] for column in columns], axis=1)
    return means[:, :3].astype(np.float32), np.round(means[:, 3:]).astype(np.uint8)


MAX_DENSE_SPACING = 4.0  # Spacing of dense seeds is clipped to this many medians: outliers must not become large blobs
MIN_COVERAGE = 0.25
"""Where triangulated points reach a smaller share of the pictures' cells, a sweep over all depths finds rough points.
"""
ROUGH_SIZE = 80  # Longer side in pixels of the pictures of that sweep
ROUGH_PLANES = 192
ROUGH_TOLERANCE = 0.06  # Largest relative difference of two rough depths of one surface


def seeds_of_photographs(
    photographs: Photographs,
    views: Views,
    config: DenseConfig = DenseConfig(),
    *,
    training: Sequence[int] | None = None,
    track: Track = untracked,
) -> DenseSeeds:
    """Points on the surfaces that posed photographs show.

    Args:
        training: their row numbers among the photographs; None = all.
    """
    rows = list(range(len(photographs))) if training is None else list(training)
    if len(rows) < 2:
        raise InputError(
            f"seeds: {len(rows)} photograph without depth and points says nothing about where surfaces are; give two "
            "or more, a splat (splat=PATH), or a mesh (seeds.source=mesh seeds.mesh=PATH)"
        )
    points, colors = triangulate(views, track=track)
    guide = points
    if covered_share(photographs, rows, points) < MIN_COVERAGE:
        guide = np.concatenate((points, _rough_points(photographs, rows, views.cameras, track)))
    dense = densify(photographs, rows, points, colors, config, guide=guide, track=track)
    if dense is None:
        dense = DenseSeeds(points=points, colors=colors, swept=0, filled=0, coverage=(1.0, 1.0))
    if not len(dense.points):
        raise InputError(
            f"seeds: no two of the {len(rows)} photographs show the same surface from different places by their poses; "
            "check the poses (axes, translations, world_from_camera or its inverse), or give photographs with more "
            "overlap and detail, depth, a mesh or a splat"
        )
    return replace(dense, triangulated=len(points))


def seed_from_photographs(views: Views, config: DenseConfig = DenseConfig(), *, track: Track = untracked) -> Gaussians:
    """Flat Gaussians at `seeds_of_photographs`, as wide as they are apart."""
    dense = seeds_of_photographs(Photographs(views, track=track), views, config, track=track)
    return seed_from_points(dense.points, dense.colors, views=views, largest_spacing=MAX_DENSE_SPACING)


def _rough_points(
    photographs: Photographs, rows: Sequence[int], cameras: Cameras, track: Track
) -> Float32[np.ndarray, "P 3"]:
    """Points of plane sweeps of small pictures over a fifth to four times the typical distance of the cameras."""
    distance = typical_distance(cameras)
    shares = overlaps(cameras, distance)
    neighbors = {
        row: [rows[other] for other in _spread_neighbors(cameras, shares[index], index)]
        for index, row in enumerate(rows)
    }
    photos, poses = scaled_photographs(photographs, rows, ROUGH_SIZE)
    depths = consistent_depths(
        photos,
        poses,
        neighbors,
        dict.fromkeys(rows, (distance / 5, 4 * distance)),
        track(rows, "sweeping planes at all depths"),
        max_planes=ROUGH_PLANES,
        tolerance=ROUGH_TOLERANCE,
    )
    return back_project(depths, photos, poses)[0]


def _spread_neighbors(cameras: Cameras, shares: np.ndarray, view: int) -> list[int]:
    """Four views that overlap with a view, and whose centers are neither equal to its own nor far away."""
    distance = typical_distance(cameras)
    apart = np.linalg.norm(cameras.centers - cameras.centers[view], axis=1) / distance
    # A baseline of an eighth of the distance measures depth well, and windows still look alike.
    fits = np.exp(-np.square(np.log(np.maximum(apart, 1e-6) / 0.125)))
    value = shares * fits
    return [int(other) for other in np.argsort(-value, kind="stable")[:4] if value[other] > 0.01]
