"""Quantization of points to integer coordinates of a voxel grid."""

import torch
from jaxtyping import Int64
from torch import Tensor

from gsencoder.core.errors import InputError
from gsencoder.models.grid.serialize import ALIGN, check_extent


def grid_coords(points: Tensor, voxel: float, corner: Tensor | None = None) -> Int64[Tensor, "N 3"]:
    """Non-negative grid coordinates of points [N, 3].

    Cell borders lie at multiples of `voxel` in world coordinates. The origin of the coordinates is the largest multiple
    of ALIGN cells at or below the lowest point on each axis, so that a part of a scene is divided into cells and pooled
    exactly as the full scene is. With the corner of the full scene its cells also have the same coordinates.

    Args:
        points: world units.
        voxel: edge length of a cell, world units.
        corner: lowest corner of the full scene, [3], world units; None = the lowest of the points.

    Raises:
        InputError: points that are not finite, or that spread over 2²⁰ cells or more along an axis.
    """
    if not len(points):
        return torch.zeros(0, 3, dtype=torch.int64, device=points.device)
    if not torch.isfinite(points).all():
        bad = int((~torch.isfinite(points).all(dim=1)).sum())
        raise InputError(f"grid: {bad} of {len(points)} positions are not finite")
    scaled = torch.floor(points.double() / voxel)
    low, high = scaled.aminmax(dim=0)
    if corner is not None:
        low = torch.minimum(low, torch.floor(corner.to(scaled) / voxel))
    check_extent((high - low + 1).max().item(), voxel)
    return (scaled - torch.floor(low / ALIGN) * ALIGN).long()
