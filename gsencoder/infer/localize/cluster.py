"""Clusters of points by density (DBSCAN, Ester et al. 1996), and things, which may be several clusters."""

from functools import cache, cached_property, partial
from itertools import combinations
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Int64

EPS_SPACINGS = 1.5
"""Radius of clusters, in spacings: a surface on a square grid holds together at √2."""
MAX_NEIGHBORS = 50_000_000
"""So many neighbors of all points together may be held in memory (8 bytes each); with more of them, clusters are
computed on a grid of eps / 4."""
NEIGHBOR_CELLS = 4.2
"""Volume of a ball of radius eps, in cubes of edge eps."""
SPARSE, GROWTH, SPARSE_RADII = 0.25, 2**0.5, 6
"""Where more than this share of the points is in no cluster of four neighbors within a spacing, they are sparser than
the scene: the radius grows by this factor, at most this often (8 times)."""
GAP = 0.25
"""Clusters are one thing up to a gap of this share of the larger one's size."""
STRAY = 0.02
"""Clusters with less than this share of the larger one's points are not joined to it: strays would thicken a door."""
WIDEST = 8
"""No gap within a thing is wider than this many radii. In house rooms those of tables and sofas are up to 7.5 wide, and
those between two things of a name 11 and more."""
MAX_PARTS = 32
"""So many of the largest clusters are joined; others stay as they are."""


def cluster_by_gaps(points: Float32[np.ndarray, "n 3"], smallest: float, min_samples: int) -> Int64[np.ndarray, " n"]:
    """DBSCAN labels after joining clusters whose gap is small beside their size, −1 = noise.

    One thing is seen or fitted in patches, and the gaps between these are small beside the thing: the legs of a table
    and its top, the halves of a treadmill. The next thing of the name is farther away than a quarter of its size. The
    size is that of what was joined so far, twice the root mean square distance from the center (0.6 of a rod's length,
    0.8 of a square's side), which does not depend on the axes of the world.

    Args:
        points: positions.
        smallest: radius of DBSCAN, in their unit, `EPS_SPACINGS` of the scene; larger where the points are sparser.
        min_samples: see `cluster`.
    """
    radius = smallest
    for _ in range(SPARSE_RADII):
        if np.count_nonzero(cluster(points, radius / EPS_SPACINGS, 5) < 0) <= SPARSE * len(points):
            break
        radius *= GROWTH
    labels = cluster(points, radius, min_samples)
    largest = np.argsort(-np.bincount(labels[labels >= 0]), kind="stable")[:MAX_PARTS]
    parts = [_Part(points, np.flatnonzero(labels == label)) for label in largest]
    belong = cache(partial(_belong_together, widest=WIDEST * radius))
    while pair := next((pair for pair in combinations(parts, 2) if belong(*pair)), None):
        rows = np.concatenate([part.rows for part in pair])
        parts = [part for part in parts if part not in pair] + [_Part(points, rows)]
        parts.sort(key=lambda part: -len(part.rows))
    for part in parts:
        labels[part.rows] = labels[part.rows].min()
    return np.unique(np.append(labels, -1), return_inverse=True)[1][:-1].astype(np.int64) - 1


class _Part:
    """A cluster, or several that were joined."""

    def __init__(self, points: Float32[np.ndarray, "N 3"], rows: Int64[np.ndarray, " n"]) -> None:
        self.rows, self.points = rows, points[rows].astype(np.float64)
        self.low, self.high = self.points.min(axis=0), self.points.max(axis=0)
        self.size = 2 * float(np.sqrt(self.points.var(axis=0).sum()))

    @cached_property
    def tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(self.points, balanced_tree=False, compact_nodes=False)


def _belong_together(larger: _Part, smaller: _Part, widest: float) -> bool:
    if len(smaller.rows) < STRAY * len(larger.rows):
        return False
    limit = min(GAP * max(larger.size, smaller.size), widest)
    near = ((smaller.points >= larger.low - limit) & (smaller.points <= larger.high + limit)).all(axis=1)
    return bool(np.isfinite(larger.tree.query(smaller.points[near], distance_upper_bound=limit)[0]).any())


def cluster(points: Float32[np.ndarray, "n 3"], eps: float, min_samples: int) -> Int64[np.ndarray, " n"]:
    """DBSCAN labels, −1 = noise; clusters are numbered in the order of the points.

    Libraries keep the neighbors of every point, which on a dense splat grows with the square of the density. Where
    these would not fit into memory, the occupied cells of a grid of eps / 4 are clustered instead, each weighted by its
    number of points, and points take the label of their cell: distances are then off by up to 0.43 eps.

    Args:
        points: positions.
        eps: radius, in their unit. Points at this distance are neighbors, also where their float32 coordinates round.
        min_samples: points within the radius, the point itself included, that make it a core point.
    """
    if len(points) == 0:
        return np.zeros(0, np.int64)
    local = points.astype(np.float64) - points.min(axis=0)
    # open3d looks for distances below the radius, not up to it.
    eps = float(np.nextafter(eps + 2 * np.spacing(np.abs(points).max()), np.inf))
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
