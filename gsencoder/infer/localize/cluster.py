"""Clusters of points by density: DBSCAN (Ester et al. 1996)."""

import numpy as np
from jaxtyping import Float32, Float64, Int64

MAX_NEIGHBORS = 50_000_000
"""So many neighbors of all points together may be held in memory (8 bytes each); with more of them, clusters are
computed on a grid of eps / 4."""
NEIGHBOR_CELLS = 4.2
"""Volume of a ball of radius eps, in cubes of edge eps."""


def cluster(points: Float32[np.ndarray, "n 3"], eps: float, min_samples: int) -> Int64[np.ndarray, " n"]:
    """DBSCAN labels, −1 = noise; clusters are numbered in the order of the points.

    Libraries keep the neighbors of every point, which on a dense splat grows with the square of the density. Where
    these would not fit into memory, the occupied cells of a grid of eps / 4 are clustered instead, each weighted by its
    number of points, and points take the label of their cell: distances are then off by up to 0.43 eps.

    Args:
        points: positions.
        eps: radius, in their unit.
        min_samples: points within the radius, the point itself included, that make it a core point.
    """
    if len(points) == 0:
        return np.zeros(0, np.int64)
    local = points.astype(np.float64) - points.min(axis=0)
    if _expected_neighbors(local, eps) <= MAX_NEIGHBORS:
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
