"""Labels of mesh vertices for Gaussians, and back.

As published work does: a Gaussian has the label of the nearest vertex within a distance (SceneSplat takes 0.25 m), and
a vertex the most frequent label among the k nearest Gaussians that have features (SceneSplat's benchmark takes k = 25).
Queries run in chunks, so that memory does not grow with their number.

Reference: Li et al., SceneSplat, 2025; SceneSplat's pointcept/utils/misc.py (neighbor_voting).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, Int32, Int64

from gsencoder.core.errors import InputError

VOTERS = 25
"""Gaussians that vote for the label of a vertex, as in SceneSplat's benchmark."""
MAX_DISTANCE = 0.25
"""Largest distance from a Gaussian to the vertex whose label it takes, metres, as in SceneSplat's preparation."""
CHUNK = 1 << 16
"""Points of one query."""
MAX_VOTES = 1 << 22
"""Counters of votes that exist at once: points times distinct labels."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GaussianLabels:
    """Labels of Gaussians from a mesh.

    Attributes:
        labels: of each Gaussian; `none` where no vertex is near enough.
        vertices: the nearest vertex of each Gaussian, -1 where it is too far.
        far: number of Gaussians without a vertex near enough.
    """

    labels: Int32[np.ndarray, " N"]
    vertices: Int64[np.ndarray, " N"]
    far: int


def labels_of_gaussians(
    means: Float[np.ndarray, "N 3"],
    vertices: Float[np.ndarray, "V 3"],
    labels: Int[np.ndarray, " V"],
    *,
    max_distance: float = MAX_DISTANCE,
    none: int = 0,
) -> GaussianLabels:
    """The label of the nearest vertex for each Gaussian.

    Args:
        means: centers of the Gaussians, in the frame of the vertices (`Scene.origin` added back).
        vertices: of the mesh.
        labels: of the vertices.
        max_distance: largest distance, itself included, in the unit of both.
        none: label of Gaussians that are farther from every vertex.

    Raises:
        InputError: positions that are not finite, or a distance that is not positive.
    """
    from scipy.spatial import cKDTree

    _check(means, "Gaussians")
    _check(vertices, "vertices")
    if not max_distance > 0:
        raise InputError(f"max_distance: expected a positive length, got {max_distance}")
    nearest = np.full(len(means), -1, np.int64)
    if len(vertices):
        tree = cKDTree(vertices)
        for start in range(0, len(means), CHUNK):
            part = slice(start, start + CHUNK)
            # The bound excludes itself, and makes queries far from the mesh short; beyond it the row is len(vertices).
            _, rows = tree.query(means[part], distance_upper_bound=np.nextafter(max_distance, np.inf))
            nearest[part] = np.where(rows < len(vertices), rows, -1)
    result = np.full(len(means), none, np.int32)
    found = nearest >= 0
    result[found] = labels[nearest[found]]
    return GaussianLabels(labels=result, vertices=nearest, far=int(len(means) - found.sum()))


def labels_of_vertices(
    vertices: Float[np.ndarray, "V 3"],
    means: Float[np.ndarray, "N 3"],
    labels: Int[np.ndarray, " N"],
    *,
    k: int = VOTERS,
    none: int = -1,
    voters: Bool[np.ndarray, " N"] | None = None,
    max_distance: float = np.inf,
) -> Int32[np.ndarray, " V"]:
    """The most frequent label among the k nearest Gaussians of each vertex; of equally frequent ones the smallest.

    Labels `none` are among the k but do not count; a vertex whose nearest Gaussians all have it has none.

    Args:
        vertices: to be labeled.
        means: centers of the Gaussians, in the frame of the vertices.
        labels: of the Gaussians.
        k: number of Gaussians that vote; 1 = the nearest one. All vote where there are fewer.
        none: what means no label, in and out.
        voters: which Gaussians are looked at, such as those that were seen; None = all.
        max_distance: Gaussians farther than this do not vote.

    Raises:
        InputError: positions that are not finite, or k below 1.
    """
    from scipy.spatial import cKDTree

    _check(means, "Gaussians")
    _check(vertices, "vertices")
    if k < 1:
        raise InputError(f"k: expected at least 1 Gaussian, got {k}")
    if voters is not None:
        means, labels = means[voters], labels[voters]
    result = np.full(len(vertices), none, np.int32)
    if not len(means):
        return result
    names, codes = np.unique(labels, return_inverse=True)
    # The last counter is that of neighbors that do not vote.
    codes = np.where(labels == none, len(names), codes).astype(np.int64)
    codes = np.append(codes, len(names))
    tree, k = cKDTree(means), min(k, len(means))
    chunk = max(1, min(CHUNK, MAX_VOTES // max(len(names) + 1, k)))
    for start in range(0, len(vertices), chunk):
        part = vertices[start : start + chunk]
        # A neighbor beyond the distance has the row len(means).
        _, rows = tree.query(part, k=k, distance_upper_bound=np.nextafter(max_distance, np.inf))
        votes = codes[rows.reshape(len(part), k)] + np.arange(len(part))[:, None] * (len(names) + 1)
        counts = np.bincount(votes.ravel(), minlength=len(part) * (len(names) + 1))
        counts = counts.reshape(len(part), len(names) + 1)[:, : len(names)]
        best = counts.argmax(axis=1)
        elected = counts[np.arange(len(part)), best] > 0
        result[start : start + len(part)][elected] = names[best[elected]]
    return result


def _check(points: np.ndarray, what: str) -> None:
    good = np.isfinite(points).all(axis=1)
    if not good.all():
        raise InputError(
            f"{what}: row {int(np.flatnonzero(~good)[0])} is not finite ({int((~good).sum()):,} of {len(points):,})"
        )
