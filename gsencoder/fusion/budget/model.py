"""The error of a setting, predicted from what views see of a sample and from how much the teacher's vectors vary.

A Gaussian's feature is a mean Σ w·f / Σ w over views. If its vectors f scatter about a common one, independently from
view to view, with a mean squared distance σ² about it, then the means with normalized weights a (the setting's) and b
(those of all views at the exact settings) differ by

    E |Δ|² = σ² c,   c = Σ_v (a_v − b_v)²,   and   1 − cosine ≈ ρ c   with   ρ = σ² / 2|f|²  (across f).

c is geometry. ρ is measured on a few views: leave one out, and see how far the mean turns.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from gsencoder.core.runtime.threads import kernel
from gsencoder.fusion.coverage.sight import Sight
from gsencoder.fusion.feature_error import row_cosines
from gsencoder.types import FeatureMap

UNKNOWN_SCATTER = 1.0
"""ρ where no Gaussian of the sample is seen twice: whatever is not measured counts in full."""
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


def setting_weights(sight: Sight, side: int, stop: float, exact_stop: float) -> Float32[np.ndarray, "V n"]:
    """The blending weights of the sample with so many rays along a cell, which end at `stop`; side 0 = the exact
    rays."""
    weights = np.where(sight.remains > max(stop, exact_stop), sight.weights, 0)
    if side:
        exact, areas = sight.areas[0], sight.areas[side]
        weights = weights * np.divide(areas, exact, out=np.zeros_like(areas), where=exact > 0)
    return np.asarray(weights, np.float32)


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
        s, q, mixed = 0.0, 0.0, 0.0
        for k in range(len(order)):
            if total <= 0:
                out[k, g] = np.nan
                continue
            x = np.float64(setting[order[k], g])
            s += x
            q += x * x
            mixed += x * np.float64(exact[order[k], g])
            out[k, g] = 1.0
            if s > 0:
                c = q / (s * s) - 2 * mixed / (s * total) + squares / (total * total)
                out[k, g] = min(1.0, scatter * max(c, 0.0))


def predict_curve(
    sight: Sight,
    order: Int64[np.ndarray, " V"],
    *,
    side: int,
    stop: float,
    exact_stop: float,
    scatter: float,
) -> list[Predicted]:
    """The error with the first 1, 2, … views of an order.

    Single Gaussians tell which share no view sees, were there nothing in front of them; the groups, to which rays were
    followed, what that leaves out, and how the features of those that are seen differ.
    """
    exact, setting = setting_weights(sight, 0, exact_stop, exact_stop), setting_weights(sight, side, stop, exact_stop)
    errors = np.empty((len(order), exact.shape[1]), np.float32)
    _curve(order, setting, exact, scatter, errors)
    n = sight.singles
    single = np.where(np.isnan(errors[:, :n]), np.nan, errors[:, :n] >= 1) if n else errors[:, :0]
    alone = np.empty_like(errors[:, n:])
    area = sight.areas[0][:, n:]
    _curve(order, area if not side else sight.areas[side][:, n:], area, 0.0, alone)
    beyond = errors[:, n:] - alone
    numbers = sight.groups
    return [_mean(single[k], beyond[k], numbers, sight) for k in range(len(order))]


def _mean(single: np.ndarray, beyond: np.ndarray, numbers: np.ndarray, sight: Sight) -> Predicted:
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
    return Predicted(error=min(max(error, 0.0), 1.0), deviation=float(np.sqrt(variance)))


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
    for view, feature_map in maps.items():
        rays = sight.rays[view]
        found = rows_at(feature_map, rays.rows)
        weight = np.where(np.isfinite(found[:, 0]), rays.weights, 0).astype(np.float64)
        total = np.bincount(rays.owners, weight, m)
        sums = np.zeros((m, found.shape[1]))
        np.add.at(sums, rays.owners, np.where(weight[:, None] > 0, found, 0) * weight[:, None])
        vectors.append(sums / np.maximum(total, TINY)[:, None])
        weights.append(np.where(total > 0, sight.weights[view, sight.singles :], 0))
    return SampleFeatures(vectors=np.stack(vectors), weights=np.stack(weights).astype(np.float64))


def measure_scatter(features: SampleFeatures, mean: Float64[np.ndarray, " D"]) -> float:
    """ρ: over all Gaussians and views, how far the mean turns if the view is left out, per c."""
    count = len(features.weights)
    total, squares = features.weights.sum(axis=0), np.square(features.weights).sum(axis=0)
    whole, _ = features.fused()
    turned, geometry = 0.0, 0.0
    for view in range(count):
        w = features.weights[view]
        rest = total - w
        rows = np.flatnonzero((w > 0) & (rest > 1e-6 * total))
        if not len(rows):
            continue
        w, rest, all_ = w[rows], rest[rows], total[rows]
        without = (whole[rows] * all_[:, None] - w[:, None] * features.vectors[view, rows]) / rest[:, None]
        turned += float((1 - row_cosines(without - mean, whole[rows] - mean)).sum())
        others = squares[rows] - w * w
        geometry += float((np.square(w / all_) + others * np.square(1 / rest - 1 / all_)).sum())
    return turned / geometry if geometry > 0 else UNKNOWN_SCATTER
