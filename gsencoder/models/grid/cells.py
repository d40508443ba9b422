"""From points to cells of the grid."""

import torch
from jaxtyping import Int64
from torch import Tensor

from gsencoder.core.errors import InputError
from gsencoder.models.grid.serialize import ALIGN, check_extent


def cells_of(points: Tensor, voxel: float, corner: Tensor | None = None) -> Int64[Tensor, "N 3"]:
    """Grid cells of points [N, 3] in world units, counted on each axis from just below the lowest occupied one.

    The grid is anchored at the world's zero and counted from a multiple of ALIGN cells, so that a part of a scene is
    cut and pooled as the whole is. With the corner of the whole it is also ordered alike.

    Args:
        points: world units.
        voxel: edge of a cell, world units.
        corner: from where cells are counted, [3], world units; None = the lowest of the points.

    Raises:
        InputError: points that are not finite, or that spread over 2²⁰ cells or more on an axis.
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
