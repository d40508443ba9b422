"""Segments of a splat: pieces of surface of one direction and color, within which an encoder's outputs are averaged.

Cells of a grid are joined along the edges between neighbors, those that differ least first, while an edge is not much
heavier than those that the segments on both sides hold (Felzenszwalb and Huttenlocher 2004, "Efficient Graph-Based
Image Segmentation", https://doi.org/10.1023/B:VISI.0000022288.19776.77).
"""

from typing import no_type_check

import numpy as np
from jaxtyping import Float32, Float64, Int64

from gsencoder.core.threads import kernel
from gsencoder.types import SH_C0, Gaussians

SEGMENT_CELL = 0.05
"""Edge of the cells for splats in metres: finer ones follow a depth camera's noise."""
NEIGHBORS, REACH = 8, 3.0
"""Neighbors of a cell that edges lead to, and the largest distance of these, cells."""
COLOR = 0.3
"""Weight of a difference of colors, summed over channels, relative to 1 − |cosine| of the normals."""
SCALE = 1.0
"""k of the paper: a segment of n cells joins along edges up to k / n heavier than those that it holds."""
SMALLEST = 10
"""Cells of a segment below which it joins the neighbor that differs least."""
LAST_CELL = 2**20
"""Further cells along an axis count as this one, so that three numbers of cells fit into one integer."""


def cell_keys(means: Float32[np.ndarray, "N 3"], edge: float) -> Int64[np.ndarray, " N"]:
    """The cell of each Gaussian: its three numbers from the lowest, in base LAST_CELL + 1.

    Borders lie at multiples of the edge in the world, so that a cell is the same whatever else there is.
    """
    keys = np.zeros(len(means), np.int64)
    for column in means.T:
        cells = np.floor(column.astype(np.float64) / edge)
        keys = keys * (LAST_CELL + 1) + np.minimum(cells - cells.min(), LAST_CELL).astype(np.int64)
    return keys


def surface_segments(gaussians: Gaussians, cell: float) -> Int64[np.ndarray, " N"]:
    """The number, from 0, of the segment of each Gaussian.

    Args:
        cell: edge of the cells, world units.
    """
    from scipy.spatial import cKDTree

    _, cell_of, counts = np.unique(cell_keys(gaussians.means, cell), return_inverse=True, return_counts=True)
    if len(counts) == 1:
        return np.zeros(len(gaussians), np.int64)
    centers, colors = (
        np.stack([np.bincount(cell_of, column) for column in values.T], axis=1) / counts[:, None]
        for values in (gaussians.means, SH_C0 * gaussians.sh[:, 0])
    )
    _, near = cKDTree(centers).query(centers, k=min(NEIGHBORS + 1, len(centers)))
    normals = _normals(centers[near])
    first, second = np.repeat(np.arange(len(centers)), near.shape[1] - 1), near[:, 1:].reshape(-1)
    apart = np.linalg.norm(centers[first] - centers[second], axis=1)
    joined = (first < second) & (apart <= REACH * cell)
    first, second = first[joined], second[joined]
    weights = 1 - np.abs((normals[first] * normals[second]).sum(axis=1))
    weights += COLOR * np.abs(colors[first] - colors[second]).sum(axis=1)
    order = np.argsort(weights, kind="stable")
    roots = _join(first[order], second[order], weights[order], len(centers))
    return np.unique(roots, return_inverse=True)[1][cell_of]


def average_within(
    segments: Int64[np.ndarray, " N"], values: Float32[np.ndarray, "N channels"], share: float = 1.0
) -> None:
    """Moves the rows of each segment to their mean, by a share of the way."""
    counts = np.bincount(segments)
    for column in values.T:
        means = (np.bincount(segments, column) / counts).astype(np.float32)
        column += np.float32(share) * (means[segments] - column)


def _normals(neighborhoods: Float64[np.ndarray, "n k 3"]) -> Float64[np.ndarray, "n 3"]:
    """The direction in which the points of each neighborhood spread least."""
    offsets = neighborhoods - neighborhoods.mean(axis=1, keepdims=True)
    return np.linalg.eigh(np.einsum("nki,nkj->nij", offsets, offsets))[1][:, :, 0]


@kernel
@no_type_check
def _find(parents, node):
    while parents[node] != node:
        parents[node] = parents[parents[node]]
        node = parents[node]
    return node


@kernel
@no_type_check
def _join(first, second, weights, nodes):
    """The root of each node's segment; edges come in ascending order."""
    parents, sizes, limits = np.arange(nodes), np.ones(nodes, np.int64), np.full(nodes, SCALE)
    for small_only in (False, True):
        for edge in range(len(first)):
            one, other = _find(parents, first[edge]), _find(parents, second[edge])
            if one == other:
                continue
            if small_only:
                joins = min(sizes[one], sizes[other]) < SMALLEST
            else:
                joins = weights[edge] <= min(limits[one], limits[other])
            if joins:
                if sizes[one] < sizes[other]:
                    one, other = other, one
                parents[other] = one
                sizes[one] += sizes[other]
                limits[one] = weights[edge] + SCALE / sizes[one]
    for node in range(nodes):
        parents[node] = _find(parents, node)
    return parents
