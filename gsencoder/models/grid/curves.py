"""Patch boundaries along the space-filling curves of a full scene, so that its parts are cut into the same patches."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int64

from gsencoder.core.process import parallel
from gsencoder.models.grid.serialize import (
    ALIGN,
    MAX_EXTENT,
    Order,
    coordinate_bits,
    curve_from_morton,
    morton_codes,
)


class SceneCurves(NamedTuple):
    """The patch boundaries of a full scene, for the plans of its parts.

    Attributes:
        corner: lowest corner of the scene, which is the origin of its grid coordinates; world units.
        starts: for each level, the first code of each of P patches along each of O orders.
    """

    corner: Float32[np.ndarray, "3"]
    starts: tuple[Int64[np.ndarray, "O _P"], ...]


def cut_scene_curves(
    means: Float32[np.ndarray, "N 3"], voxel: float, *, levels: int, orders: Sequence[Order], patch: int
) -> SceneCurves | None:
    """Cuts the curves of a scene into patches.

    Args:
        means: centers, world units; at least one.
        voxel: edge length of the finest grid's cells, world units; it doubles from level to level.
        levels: number of levels.
        orders: the curves that attention follows.
        patch: largest number of tokens in a patch. T tokens make ⌈T / patch⌉ patches, and the k-th begins at token
            ⌊k·T / patches⌋.

    Returns:
        The boundaries; None if the scene has too many cells for one set of codes, so that each part needs its own.
    """
    scaled = np.floor(means.astype(np.float64) / voxel)
    low, high = scaled.min(axis=0), scaled.max(axis=0)
    # Two cells fewer than would fit, since the origin of a part may be rounded to a cell next to the lowest one.
    if not (high - low).max() < MAX_EXTENT - 2:
        return None
    cells = (scaled - np.floor(low / ALIGN) * ALIGN).astype(np.int64)
    # Sorting is faster than the hash table of np.unique, and the codes must be in order anyway.
    morton, bits = _unique_sorted(np.sort(morton_codes(cells))), coordinate_bits(cells)

    def codes_along(order: int) -> Int64[np.ndarray, " T"]:
        return np.sort(curve_from_morton(morton, orders[order], bits))

    curve_codes = parallel(codes_along, range(len(orders)))
    starts = []
    for level in range(levels):
        if level:
            curve_codes = [_unique_sorted(codes >> 3) for codes in curve_codes]
        count = len(curve_codes[0])
        patches = -(-count // patch)
        first_tokens = np.arange(patches) * count // patches
        starts.append(np.stack([codes[first_tokens] for codes in curve_codes]))
    return SceneCurves(means.min(axis=0), tuple(starts))


def _unique_sorted(sorted_codes: Int64[np.ndarray, " T"]) -> Int64[np.ndarray, " t"]:
    return sorted_codes[np.concatenate(([True], sorted_codes[1:] != sorted_codes[:-1]))]
