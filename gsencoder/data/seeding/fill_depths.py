"""Depths of the pixels for which a plane sweep gives none, interpolated between those of their neighbors.

An interpolated depth is used where its color agrees in two other photographs and no other view sees through it.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from gsencoder.data.photographs import ScaledPhotograph
from gsencoder.data.seeding.stereo import (
    DEPTH_TOLERANCE,
    back_project,
    sample_depth,
    sees_through,
    to_grid,
    window_mean,
    world_points,
)
from gsencoder.geometry import transform

COLOR_TOLERANCE = 0.06
"""Largest mean difference of the colors (0 to 1) of one surface in two photographs."""


def interpolated_depths(
    consistent: Mapping[int, Float[Tensor, "h w"]],
    photos: Mapping[int, ScaledPhotograph],
    poses: Mapping[int, Tensor],
    points: Float32[np.ndarray, "P 3"],
) -> dict[int, Float[Tensor, "h w"]]:
    """Depth at every pixel of every view: that of its plane sweep, else that of the nearest point that projects there,
    else one between those of its neighbors.

    Args:
        consistent: depths of plane sweeps, 0 = unknown.
        photos: the views.
        poses: their cam_from_world.
        points: further points on surfaces, world units.
    """
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
    """Interpolated depths whose colors two other photographs confirm, and that no other view sees through.

    Args:
        interpolated: depth of each pixel of each view (`interpolated_depths`).
        consistent: depths of plane sweeps, 0 = unknown; pixels that have one are left out.
        photos: the views.
        poses: their cam_from_world.
        neighbors: the other views that each is compared with.

    Returns:
        Depths by view; 0 where they are not supported.
    """
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
    column, row = ((grid + 1) / 2 * torch.tensor([photo.width, photo.height])).long().unbind(-1)
    index = row.clamp(max=photo.height - 1) * photo.width + column.clamp(max=photo.width - 1)
    nearest = torch.full((photo.height * photo.width,), torch.inf)
    nearest.scatter_reduce_(0, index, camera[:, 2], "amin")
    return torch.where(nearest.isfinite(), nearest, 0).reshape(photo.height, photo.width)


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
