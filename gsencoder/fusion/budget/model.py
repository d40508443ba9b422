"""The error of a setting, predicted from what views see of a sample and from how much the teacher's vectors vary.

A Gaussian's feature is a mean Σ w·f / Σ w over views. If its vectors f scatter about a common one, independently from
view to view, with a mean squared distance σ² about it, then the means with normalized weights a (the setting's) and b
(those of all views at the exact settings) differ by

    E |Δ|² = σ² c,   c = Σ_v (a_v − b_v)²,   and   1 − cosine ≈ ρ c   with   ρ = σ² / 2|f|²  (across f).

c is geometry. ρ is measured on a few views: leave some out, and see how far the mean turns.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from gsencoder.core.process import kernel
from gsencoder.fusion.coverage.sight import Sight
from gsencoder.fusion.feature_error import row_cosines
from gsencoder.types import FeatureMap

UNKNOWN_SCATTER = 1.0
"""ρ where no Gaussian of the sample is seen twice: whatever is not measured counts in full."""
NEGLIGIBLE_STOP = 1e-4
"""Rays that end at no more of their light than this leave out next to nothing, whatever a sample says."""
SMALL_CHANGE = 0.1
"""ρ is also measured where c is at most this: cosines of vectors that are turned far grow more slowly than c."""
TINY = 1e-30


@dataclass(frozen=True, slots=True, kw_only=True)
class Predicted:
    """A predicted error.

    Attributes:
        error: mean over the Gaussians that the exact settings see.
        deviation: its standard error, from the size of the sample.
    """

    error: float
    deviation: float


def setting_weights(sight: Sight, stop: float, exact_stop: float) -> Float32[np.ndarray, "V n"]:
    """The blending weights of the sample where rays end at `stop`: of those that were followed to a Gaussian, the ones
    count that still reach it."""
    if stop <= exact_stop:
        return np.where(sight.remains > exact_stop, sight.weights, np.float32(0))
    weights, m = sight.weights.copy(), len(sight.groups)
    for view, rays in enumerate(sight.rays):
        totals = np.bincount(rays.owners, rays.weights, m)
        reached = np.bincount(rays.owners, np.where(rays.remains > stop, rays.weights, 0), m)
        weights[view, sight.singles :] *= reached / np.maximum(totals, TINY)
    return weights


@kernel
@no_type_check
def _curve(order, setting, exact, scatter, out):
    """out[k, g]: the predicted error of each Gaussian with the first k + 1 views; NaN where the exact settings see
    nothing."""
    count, n = exact.shape
    for g in range(n):
        total, squares = 0.0, 0.0
        for v in range(count):
            x = np.float64(exact[v, g])
            total += x
            squares += x * x
        s, q, mixed, reachable = 0.0, 0.0, 0.0, 0.0
        for k in range(len(order)):
            if total <= 0:
                out[k, g] = np.nan
                continue
            x = np.float64(setting[order[k], g])
            s += x
            q += x * x
            mixed += x * np.float64(exact[order[k], g])
            reachable += np.float64(exact[order[k], g])
            out[k, g] = 1.0
            if s > 0:
                c = q / (s * s) - 2 * mixed / (s * total) + squares / (total * total)
                # The share of the weight that is lost within the views scatters like what is left.
                lost = 1 - s / reachable
                out[k, g] = min(1.0, scatter * (max(c, 0.0) + 2 * lost * lost))


def predict_curve(
    sight: Sight,
    order: Int64[np.ndarray, " V"],
    *,
    stop: float,
    exact_stop: float,
    scatter: float,
    drift: float = 0.0,
) -> list[Predicted]:
    """The error with the first 1, 2, … views of an order.

    Single Gaussians tell which share no view sees, were there nothing in front of them; the groups, to which rays were
    followed, what that leaves out, and how the features of those that are seen differ. The mean of the space, which
    centered cosines take off, adds `drift` (`measure_drift`) times 1/n − 1/V with n of V views.
    """
    exact, setting = setting_weights(sight, exact_stop, exact_stop), setting_weights(sight, stop, exact_stop)
    errors = np.empty((len(order), exact.shape[1]), np.float32)
    _curve(order, setting, exact, scatter, errors)
    n = sight.singles
    single = np.where(np.isnan(errors[:, :n]), np.nan, errors[:, :n] >= 1) if n else errors[:, :0]
    alone = np.empty_like(errors[:, n:])
    _curve(order, sight.areas[:, n:], sight.areas[:, n:], 0.0, alone)
    beyond = errors[:, n:] - alone
    numbers = sight.groups
    # What so many groups show nothing of may still be in the rest of the scene.
    unknown = 1 / max(len(np.unique(numbers)), 1) ** 2 if stop > NEGLIGIBLE_STOP else 0.0
    for k in range(len(order)):
        beyond[k] += np.where(errors[k, n:] < 1, drift * (1 / (k + 1) - 1 / len(order)), 0)
    return [_mean(single[k], beyond[k], numbers, sight, unknown) for k in range(len(order))]


def _mean(single: np.ndarray, beyond: np.ndarray, numbers: np.ndarray, sight: Sight, unknown: float) -> Predicted:
    seen, of_group = single[np.isfinite(single)], np.isfinite(beyond)
    error, variance = 0.0, 0.0
    if len(seen):
        error += float(seen.mean())
        left = 1 - len(single) / max(sight.gaussians, 1)
        variance += max(error * (1 - error), 1 / len(seen)) / len(seen) * left
    if of_group.any():
        error += float(beyond[of_group].mean())
        counts = np.bincount(numbers[of_group])
        means = np.bincount(numbers[of_group], beyond[of_group]) / np.maximum(counts, 1)
        means = means[counts > 0]
        variance += float(means.var()) / len(means)
    elif not len(seen):
        return Predicted(error=0.0, deviation=0.0)
    return Predicted(error=min(max(error, 0.0), 1.0), deviation=float(np.sqrt(variance)) + unknown)


def rows_at(feature_map: FeatureMap, rows: Int64[np.ndarray, " n"]) -> Float64[np.ndarray, "n D"]:
    """The vectors of some cells of a map; NaN where a cell has none."""
    if feature_map.features is not None:
        return feature_map.features.reshape(-1, feature_map.space.channels)[rows].astype(np.float64)
    assert feature_map.table is not None
    table = feature_map.table.astype(np.float64)
    if feature_map.codes is not None:
        codes = feature_map.codes.ravel()[rows]
        return np.where((codes >= 0)[:, None], table[np.maximum(codes, 0)] if len(table) else np.nan, np.nan)
    assert feature_map.shares is not None
    shares = feature_map.shares.reshape(-1, len(table))[rows].astype(np.float64)
    total = shares.sum(axis=1, keepdims=True)
    return shares @ table / np.where(total > 0, total, np.nan)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SampleFeatures:
    """What some views show at the Gaussians of the groups.

    Attributes:
        vectors: of each of these views and each Gaussian; 0 where it is not seen.
        weights: blending weights; 0 where it is not seen.
    """

    vectors: Float64[np.ndarray, "M m D"]
    weights: Float64[np.ndarray, "M m"]

    def fused(self) -> tuple[Float64[np.ndarray, "m D"], Bool[np.ndarray, " m"]]:
        """Their weighted means, and which Gaussians have one."""
        total = self.weights.sum(axis=0)
        sums = np.einsum("vm,vmd->md", self.weights, self.vectors)
        return sums / np.maximum(total, TINY)[:, None], total > 0


def sample_features(sight: Sight, maps: Mapping[int, FeatureMap]) -> SampleFeatures:
    """Reads maps where the rays to the Gaussians of the groups meet them."""
    m = len(sight.groups)
    vectors, weights = [], []
    for view, feature_map in sorted(maps.items()):
        rays = sight.rays[view]
        cells = rows_at(feature_map, rays.rows)
        weight = np.where(np.isfinite(cells[:, 0]), rays.weights, 0).astype(np.float64)
        total = np.bincount(rays.owners, weight, m)
        sums = np.zeros((m, cells.shape[1]))
        np.add.at(sums, rays.owners, np.where(weight[:, None] > 0, cells, 0) * weight[:, None])
        vectors.append(sums / np.maximum(total, TINY)[:, None])
        weights.append(np.where(total > 0, sight.weights[view, sight.singles :], 0))
    return SampleFeatures(vectors=np.stack(vectors), weights=np.stack(weights).astype(np.float64))


def measure_scatter(features: SampleFeatures, mean: Float64[np.ndarray, " D"]) -> float:
    """ρ: over all Gaussians, how far the mean turns if some of the views are left out, per c. Each view is left out for
    itself, and then each half of a recording at once; the larger ρ counts: neighboring views are alike, so that leaving
    out one of them hides how much lies between views that are far apart.

    Args:
        features: of views in ascending order.
        mean: of the teacher's vectors.
    """
    parts = _parts(len(features.weights))
    sums = [_scatter(features, mean, subsets, largest) for subsets in parts for largest in (SMALL_CHANGE, np.inf)]
    ratios = [turned / geometry for turned, geometry in sums if geometry > 0]
    return max(ratios) if ratios else UNKNOWN_SCATTER


def _parts(count: int) -> list[list[Bool[np.ndarray, " M"]]]:
    """Views that are left, where each is left out in turn, and the first and the second half of them."""
    views, half = np.arange(count), (count + 1) // 2
    return [[views != view for view in views], [views < half], [views >= count - half]]


def _scatter(
    features: SampleFeatures, mean: Float64[np.ndarray, " D"], subsets: list[Bool[np.ndarray, " M"]], largest: float
) -> tuple[float, float]:
    """Sums of 1 − cosine and of c, where c is at most `largest`, of the means over some views with those over all."""
    weights, vectors = features.weights, features.vectors
    total, squares = weights.sum(axis=0), np.square(weights).sum(axis=0)
    fused, _ = features.fused()
    turned, geometry = 0.0, 0.0
    for subset in subsets:
        part = weights[subset].sum(axis=0)
        rows = np.flatnonzero((part > 1e-6 * total) & (part < (1 - 1e-6) * total))
        if not len(rows):
            continue
        w, s, all_ = weights[subset][:, rows], part[rows], total[rows]
        some = np.einsum("vm,vmd->md", w, vectors[subset][:, rows]) / s[:, None]
        q = np.square(w).sum(axis=0)
        c = q * (1 / s**2 - 2 / (s * all_)) + squares[rows] / all_**2
        small = c <= largest
        turned += float((1 - row_cosines(some - mean, fused[rows] - mean))[small].sum())
        geometry += float(c[small].sum())
    return turned, geometry


def measure_drift(features: SampleFeatures, means: Float64[np.ndarray, "M D"]) -> float:
    """How far centered features turn if the mean of the space is that of the maps of fewer views, per 1/n − 1/M; those
    that `measure_scatter` leaves out are left out.

    Args:
        features: of the sample.
        means: of the map of each view.
    """
    count = len(means)
    all_fused, seen = features.fused()
    if count < 2 or not seen.any():
        return UNKNOWN_SCATTER
    fused, mean = all_fused[seen], means.mean(axis=0)
    ratios = []
    for subsets in _parts(count):
        turned = [
            float((1 - row_cosines(fused - means[subset].mean(axis=0), fused - mean)).mean()) for subset in subsets
        ]
        geometry = [1 / subset.sum() - 1 / count for subset in subsets]
        ratios.append(sum(turned) / sum(geometry))
    return max(ratios)
