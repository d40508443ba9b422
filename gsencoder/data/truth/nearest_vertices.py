"""Labels of mesh vertices for Gaussians, and back.

As published work does: a Gaussian has the label of the nearest vertex within a distance (SceneSplat takes 0.25 m), and
a vertex the most frequent label among the k nearest Gaussians that have features (SceneSplat's benchmark takes k = 25).
Queries run in chunks, so that memory does not grow with their number.

Reference: Li et al., SceneSplat, 2025; SceneSplat's pointcept/utils/misc.py (neighbor_voting).
"""

from collections.abc import Iterator
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
    _check(means, "Gaussians")
    _check(vertices, "vertices")
    nearest = nearest_rows(means, vertices, max_distance=max_distance)
    near = nearest >= 0
    result = np.full(len(means), none, np.int32)
    result[near] = labels[nearest[near]]
    return GaussianLabels(labels=result, vertices=nearest, far=int(len(means) - near.sum()))


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
        InputError: positions that are not finite, k below 1, or a distance that is not positive.
    """
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
    k = min(k, len(means))
    chunk = max(1, min(CHUNK, MAX_VOTES // max(len(names) + 1, k)))
    for part, rows in _neighbors(vertices, means, k, max_distance, chunk):
        votes = codes[rows] + np.arange(len(rows))[:, None] * (len(names) + 1)
        counts = np.bincount(votes.ravel(), minlength=len(rows) * (len(names) + 1))
        counts = counts.reshape(len(rows), len(names) + 1)[:, : len(names)]
        best = counts.argmax(axis=1)
        elected = counts[np.arange(len(rows)), best] > 0
        result[part][elected] = names[best[elected]]
    return result


def nearest_rows(
    points: Float[np.ndarray, "P 3"], targets: Float[np.ndarray, "T 3"], *, max_distance: float = np.inf
) -> Int64[np.ndarray, " P"]:
    """The row of the nearest target of each point; -1 where none is near enough.

    Args:
        points: finite, in the frame of the targets.
        targets: finite.
        max_distance: largest distance, itself included, in the unit of both.

    Raises:
        InputError: a distance that is not positive.
    """
    result = np.full(len(points), -1, np.int64)
    for part, rows in _neighbors(points, targets, 1, max_distance, CHUNK):
        result[part] = np.where(rows[:, 0] < len(targets), rows[:, 0], -1)
    return result


def _neighbors(
    points: Float[np.ndarray, "P 3"], targets: Float[np.ndarray, "T 3"], k: int, max_distance: float, chunk: int
) -> Iterator[tuple[slice, Int64[np.ndarray, "n {k}"]]]:
    """The rows of the k nearest targets, of one chunk of points after the other; T beyond the distance."""
    from scipy.spatial import cKDTree

    if not max_distance > 0:
        raise InputError(f"max_distance: expected a positive length, got {max_distance}")
    if not len(targets):
        return
    tree = cKDTree(targets)
    for start in range(0, len(points), chunk):
        part = slice(start, start + chunk)
        # The bound excludes itself, and makes queries far from the targets short.
        _, rows = tree.query(points[part], k=k, distance_upper_bound=np.nextafter(max_distance, np.inf))
        yield part, rows.reshape(-1, k).astype(np.int64)


def _check(points: np.ndarray, subject: str) -> None:
    good = np.isfinite(points).all(axis=1)
    if not good.all():
        raise InputError(
            f"{subject}: row {int(np.flatnonzero(~good)[0])} is not finite ({int((~good).sum()):,} of {len(points):,})"
        )
