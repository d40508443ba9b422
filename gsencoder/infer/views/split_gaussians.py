"""Large Gaussians as many small ones, so that what asks for the nearest few, or for the cell of each, meets all of
them."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int64

from gsencoder.geometry import rotmats_from_quats
from gsencoder.infer.views.constants import CONSTANTS
from gsencoder.types import Gaussians


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Patches:
    """Parts of Gaussians, each an ellipsoid of the same turn.

    Attributes:
        centers: of the patches, world units.
        rows: of their Gaussians.
        scales: standard deviations along the axes of the Gaussian.
    """

    centers: Float64[np.ndarray, "P 3"]
    rows: Int64[np.ndarray, " P"]
    scales: Float32[np.ndarray, "P 3"]


def patches(gaussians: Gaussians, edge: float) -> Patches:
    """A splat as patches. Where a Gaussian, up to its surface, is longer than `ViewConstants.max_uncut_edges` edges, it
    is cut along that axis into equal parts of an edge at most; those are kept whose middles lie in its ellipsoid.

    Args:
        gaussians: whole ones that are small enough stay as they are.
        edge: world units, > 0.
    """
    most = CONSTANTS.max_patches_per_gaussian
    parts = _parts(gaussians, edge, most)
    while parts.prod(axis=1).sum() > max(CONSTANTS.max_patches, len(gaussians)) and most > 1:
        most //= 2
        parts = _parts(gaussians, edge, most)
    large = np.flatnonzero(parts.prod(axis=1) > 1)
    turn_of = np.zeros(len(gaussians), np.int64)
    turn_of[large] = np.arange(len(large))
    turns = rotmats_from_quats(torch.from_numpy(gaussians.quats[large]).double()).numpy()
    kinds, kind_of = np.unique(parts, axis=0, return_inverse=True)
    centers, rows, scales = [], [], []
    for number, kind in enumerate(kinds):
        chosen = np.flatnonzero(kind_of.reshape(-1) == number)
        offsets = _middles(kind)
        means = gaussians.means[chosen].astype(np.float64)
        if len(offsets) > 1:
            reach = CONSTANTS.surface_sigmas * gaussians.scales[chosen].astype(np.float64)
            offsets_rotated = np.einsum("nij,nkj->nki", turns[turn_of[chosen]], offsets[None] * reach[:, None])
            means = (means[:, None] + offsets_rotated).reshape(-1, 3)
        centers.append(means)
        rows.append(np.repeat(chosen, len(offsets)))
        scales.append(np.repeat(gaussians.scales[chosen] / kind.astype(np.float32), len(offsets), axis=0))
    return Patches(centers=np.concatenate(centers), rows=np.concatenate(rows), scales=np.concatenate(scales))


def _parts(gaussians: Gaussians, edge: float, most: int) -> Int64[np.ndarray, "N 3"]:
    """Into how many parts each axis is cut."""
    length = 2 * CONSTANTS.surface_sigmas * gaussians.scales.astype(np.float64) / edge
    cuts = np.where(length > CONSTANTS.max_uncut_edges, np.ceil(length), 1)
    axes = np.maximum((cuts > 1).sum(axis=1), 1)
    shrink = np.minimum((most / cuts.prod(axis=1)) ** (1 / axes), 1)
    return np.maximum(cuts * shrink[:, None], 1).astype(np.int64)


def _middles(parts: Int64[np.ndarray, "3"]) -> Float64[np.ndarray, "k 3"]:
    """The middles of the parts that lie in the unit ball; at least that of the whole."""
    axes = [(2 * np.arange(count) + 1) / count - 1 for count in parts]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return grid[np.linalg.norm(grid, axis=1) <= 1] if len(grid) > 1 else grid
