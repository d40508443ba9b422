"""How much of a Gaussian's feature is the object's, and how much that of what is around it.

Where an object ends, features are mixtures: fusion averages the pixels that a Gaussian covers, encoders blur. With the
feature a of the object nearby and b of its surroundings nearby, the share of the object in a feature f is

    s = ⟨f − b, a − b⟩ / |a − b|²

the least-squares solution of f = s·a + (1 − s)·b. A threshold of a word's relevancy cannot tell the same: how far the
relevancy falls towards the edge depends on what the object stands on.
"""

import numpy as np
from jaxtyping import Float32, Float64, Int64

from gsencoder.types import GaussianFeatures

CORE_QUANTILE = 0.75
"""Gaussians of a part above this quantile of their relevancy are pure enough to stand for the object."""
GAP = 1.0
"""Gaussians nearer to a part than so many spacings are rims, and do not stand for its surroundings."""
SURROUNDINGS = 2.0
"""Surroundings go as far as so many times the reach."""
RIM = 2.0
"""Gaussians of a part that are farther than so many spacings from all others are inside of the object, whatever their
feature: the surface of a real table has features of many things."""
NEIGHBORS = 8
"""So many nearest Gaussians give the feature of the object, or of its surroundings, at a place."""
BLOCK_BYTES = 1 << 26


def object_shares(
    features: GaussianFeatures,
    means: Float32[np.ndarray, "N 3"],
    rows: Int64[np.ndarray, " n"],
    relevancy: Float32[np.ndarray, " N"],
    *,
    spacing: float,
    reach: float,
    same: Int64[np.ndarray, " m"],
) -> tuple[Int64[np.ndarray, " c"], Float64[np.ndarray, " c"]]:
    """The share of the object in the Gaussians at and around one of its parts.

    Args:
        features: of all Gaussians.
        means: their centers.
        rows: the Gaussians that the part starts with.
        relevancy: of all Gaussians for the word; finite where `features` were seen.
        spacing: of the scene, world units.
        reach: candidates lie within so many spacings of `rows`.
        same: the Gaussians of all parts of the word, which are no surroundings.

    Returns:
        The candidates, ascending, and their shares: about 0 to 1, NaN for those without features. It is 1 for what is
        inside of the part, and where there are no surroundings with features: nothing else is there.
    """
    from scipy.spatial import cKDTree

    core = rows[features.weights[rows] > 0]
    if not len(core):
        return rows, np.full(len(rows), np.nan)
    points = means.astype(np.float64)
    margin = SURROUNDINGS * reach * spacing
    low, high = points[rows].min(axis=0) - margin, points[rows].max(axis=0) + margin
    near = np.flatnonzero(((points >= low) & (points <= high)).all(axis=1))
    distances = np.asarray(cKDTree(points[rows]).query(points[near])[0])
    candidates = near[distances <= reach * spacing]
    in_ring = (distances > GAP * spacing) & (distances <= margin) & (features.weights[near] > 0)
    surroundings = np.setdiff1d(near[in_ring], same, assume_unique=True)
    # What is as relevant as the part, but too small or sparse for a box of its own, does not stand for something else.
    surroundings = surroundings[relevancy[surroundings] < relevancy[core].min()]
    shares = np.full(len(candidates), np.nan)
    with_features = np.flatnonzero(features.weights[candidates] > 0)
    if not len(surroundings):
        shares[with_features] = 1.0
        return candidates, shares
    others = np.setdiff1d(near, same, assume_unique=True)
    depths = np.asarray(cKDTree(points[others]).query(points[rows])[0])
    inside = rows[depths > RIM * spacing]
    pure = core[relevancy[core] >= np.quantile(relevancy[core], CORE_QUANTILE)]
    core = np.union1d(pure, np.intersect1d(core, inside))
    trees = [(cKDTree(points[pure]), pure) for pure in (core, surroundings)]
    step = max(1, BLOCK_BYTES // (8 * NEIGHBORS * features.features.shape[1]))
    for start in range(0, len(with_features), step):
        block = with_features[start : start + step]
        batch = candidates[block]
        a, b = (_local_mean(features, points[batch], tree, pure) for tree, pure in trees)
        between = a - b
        length = (between**2).sum(axis=1)
        along = ((features.stored(batch) - b) * between).sum(axis=1)
        # Where object and surroundings have one feature, a Gaussian is what it started as.
        alike = np.isin(batch, rows).astype(np.float64)
        shares[block] = np.divide(along, length, out=alike, where=length > 1e-12 * (a**2 + b**2).sum(axis=1))
    shares[np.isin(candidates, inside)] = 1.0
    return candidates, shares


def _local_mean(
    features: GaussianFeatures, positions: Float64[np.ndarray, "c 3"], tree: object, rows: Int64[np.ndarray, " n"]
) -> Float64[np.ndarray, "c channels"]:
    """The mean feature of the nearest of some Gaussians to each place."""
    nearest = tree.query(positions, k=min(NEIGHBORS, len(rows)))[1]  # type: ignore[attr-defined]
    nearest = np.asarray(nearest).reshape(len(positions), -1)
    values = features.stored(rows[nearest.ravel()]).astype(np.float64)
    return np.asarray(values.reshape(*nearest.shape, -1).mean(axis=1))
