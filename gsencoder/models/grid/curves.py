"""Where the curves of a whole scene are cut into patches, so that parts of it are cut in the same places."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int64

from gsencoder.models.grid.serialize import ALIGN, LARGEST_EXTENT, Order, bits_of, encode_morton, morton_codes


class Curves(NamedTuple):
    """A whole scene along its curves, for plans of parts of it.

    Attributes:
        corner: from where cells are counted, world units.
        starts: for each level, in each of O orders, the code at which each of P patches begins.
    """

    corner: Float32[np.ndarray, "3"]
    starts: tuple[Int64[np.ndarray, "O _P"], ...]


def curves_of(
    means: Float32[np.ndarray, "N 3"], voxel: float, *, levels: int, orders: Sequence[Order], patch: int
) -> Curves | None:
    """A scene along its curves; None where it has too many cells for one set of codes, and each part has its own.

    Args:
        means: centers, world units; at least one.
        voxel: edge of the finest grid, world units; each level below doubles it.
        levels: how many there are.
        orders: the curves that attention follows.
        patch: most tokens in a patch. T tokens have ⌈T / patch⌉ patches, of which the k-th begins at token
            ⌊k·T / patches⌋.
    """
    scaled = np.floor(means.astype(np.float64) / voxel)
    low, high = scaled.min(axis=0), scaled.max(axis=0)
    # Two cells fewer than would fit: a part of the scene may be counted from a cell beside the lowest.
    if not (high - low).max() < LARGEST_EXTENT - 2:
        return None
    cells = (scaled - np.floor(low / ALIGN) * ALIGN).astype(np.int64)
    morton = np.unique(morton_codes(cells))
    along = [np.sort(encode_morton(morton, order, bits_of(cells))) for order in orders]
    starts = []
    for level in range(levels):
        if level:
            along = [_distinct(codes >> 3) for codes in along]
        count = len(along[0])
        patches = -(-count // patch)
        begins = np.arange(patches) * count // patches
        starts.append(np.stack([codes[begins] for codes in along]))
    return Curves(means.min(axis=0), tuple(starts))


def _distinct(sorted_codes: Int64[np.ndarray, " T"]) -> Int64[np.ndarray, " t"]:
    return sorted_codes[np.concatenate(([True], sorted_codes[1:] != sorted_codes[:-1]))]
