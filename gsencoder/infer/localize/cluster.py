"""Clusters of points by density: DBSCAN (Ester et al. 1996), at a given radius or at one that follows the points."""

from itertools import groupby
from operator import itemgetter

import numpy as np
from jaxtyping import Float32, Float64, Int64

MAX_NEIGHBORS = 50_000_000
"""So many neighbors of all points together may be held in memory (8 bytes each); with more of them, clusters are
computed on a grid of eps / 4."""
NEIGHBOR_CELLS = 4.2
"""Volume of a ball of radius eps, in cubes of edge eps."""
RADII, GROWTH = 6, 2**0.5
"""`cluster_by_gaps` compares this many radii, each this factor above the one before: 1 to 5.7 times the smallest.
Things of one name stood 16 spacings apart or more in house rooms; parts of one thing that is fitted or seen in patches
come together at 2 to 6 spacings."""
SPARSE_RADII = 8
"""Where the smallest radius leaves three of four points without a cluster, it grows by at most this many steps (16
times)."""
LARGE = 0.05
"""Clusters with this share of the largest one's points are counted; less are floaters."""
COARSE = 10
"""Above the smallest radius, neighbors are held for `MAX_NEIGHBORS` / this, as only the number of clusters counts."""


def cluster_by_gaps(points: Float32[np.ndarray, "n 3"], smallest: float, min_samples: int) -> Int64[np.ndarray, " n"]:
    """DBSCAN labels at a radius that separates gaps within things from gaps between them, −1 = noise.

    The radius grows from `smallest` in steps of √2, and the large clusters are counted at each. The number that stays
    the same over most steps is taken, at the smallest radius that gives it: pieces of one thing come together early,
    and its distance to the next thing is much larger. Without such a number (all last equally long) the radius is the
    smallest one.

    Args:
        points: positions.
        smallest: radius to start from, in their unit.
        min_samples: see `cluster`.
    """
    labels = cluster(points, smallest, min_samples)
    for _ in range(SPARSE_RADII):
        if 4 * np.count_nonzero(labels >= 0) >= len(labels):
            break
        smallest *= GROWTH
        labels = cluster(points, smallest, min_samples)
    found = [(_count_large(labels), labels)]
    while len(found) < RADII and found[-1][0] != 1:
        radius = smallest * GROWTH ** len(found)
        labels = cluster(points, radius, min_samples, max_neighbors=MAX_NEIGHBORS // COARSE)
        found.append((_count_large(labels), labels))
    # One thing remains one at larger radii.
    found += [found[-1]] * (RADII - len(found))
    runs = [list(group) for _, group in groupby(found, key=itemgetter(0))]
    # Of runs of equal length the first one counts.
    return max(runs, key=lambda run: len(run) if run[0][0] else 0)[0][1]


def _count_large(labels: Int64[np.ndarray, " n"]) -> int:
    sizes = np.bincount(labels[labels >= 0])
    return int((sizes >= LARGE * sizes.max()).sum()) if len(sizes) else 0


def cluster(
    points: Float32[np.ndarray, "n 3"], eps: float, min_samples: int, *, max_neighbors: int | None = None
) -> Int64[np.ndarray, " n"]:
    """DBSCAN labels, −1 = noise; clusters are numbered in the order of the points.

    Libraries keep the neighbors of every point, which on a dense splat grows with the square of the density. Where
    these would not fit into memory, the occupied cells of a grid of eps / 4 are clustered instead, each weighted by its
    number of points, and points take the label of their cell: distances are then off by up to 0.43 eps.

    Args:
        points: positions.
        eps: radius, in their unit. Points at this distance are neighbors, also where their float32 coordinates round.
        min_samples: points within the radius, the point itself included, that make it a core point.
        max_neighbors: see `MAX_NEIGHBORS`, which is the default.
    """
    if len(points) == 0:
        return np.zeros(0, np.int64)
    local = points.astype(np.float64) - points.min(axis=0)
    # open3d looks for distances below the radius, not up to it.
    eps = float(np.nextafter(eps + 2 * np.spacing(np.abs(points).max()), np.inf))
    if _expected_neighbors(local, eps) <= (MAX_NEIGHBORS if max_neighbors is None else max_neighbors):
        return _dbscan(local, eps, min_samples)
    from sklearn.cluster import DBSCAN

    cells = np.floor(local * (4 / eps))
    _, cell_of, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    cell_of = cell_of.ravel()
    centers = np.stack([np.bincount(cell_of, local[:, axis]) for axis in range(3)], axis=1) / counts[:, None]
    labels = DBSCAN(eps=eps, min_samples=min_samples).fit_predict(centers, sample_weight=counts)
    return labels[cell_of].astype(np.int64)


def _expected_neighbors(local: Float64[np.ndarray, "n 3"], eps: float) -> float:
    """An estimate of the neighbors of all points together, from how full the cells of a grid of eps are."""
    cells = np.floor(local / eps).astype(np.int64)
    size = cells.max(axis=0) + 1
    if np.prod(size.astype(np.float64)) < 2**62:
        counts = np.unique((cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2], return_counts=True)[1]
    else:
        counts = np.unique(cells, axis=0, return_counts=True)[1]
    return NEIGHBOR_CELLS * float(np.square(counts.astype(np.float64)).sum())


def _dbscan(local: Float64[np.ndarray, "n 3"], eps: float, min_samples: int) -> Int64[np.ndarray, " n"]:
    """Labels by open3d, which is the fastest, or by scikit-learn where open3d cannot be loaded."""
    try:
        import open3d
    except (ImportError, OSError):
        from sklearn.cluster import DBSCAN

        return np.asarray(DBSCAN(eps=eps, min_samples=min_samples).fit_predict(local), np.int64)
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(local))
    return np.asarray(cloud.cluster_dbscan(eps, min_samples), np.int64)
