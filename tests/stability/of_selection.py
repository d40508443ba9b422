"""From relevancy to objects: thresholds, clusters, and the probability that a box holds what its word says."""

import math

import numpy as np
import pytest
from stability import oracles
from stability.extremes import CHANNELS, Case
from stability.of_features import WORDS, features_of, wide_cosines
from stability.of_network import few
from stability.registry import routine

from gsencoder.infer import localize as clusters_module
from gsencoder.infer.localize import SHARE_POWER, cluster, score_clusters
from gsencoder.infer.relevancy import (
    NOISE,
    SMALLEST_SPREAD,
    WITHOUT_RIVALS,
    Cluster,
    Presence,
    ThresholdConfig,
    otsu,
    probability,
    relevancy,
    threshold,
)

Wide = oracles.Wide


def scores_of(case: Case) -> np.ndarray:
    """Two humps of scores, as far apart as the vectors are long."""
    return np.concatenate([case.vectors[:, 0], case.vectors[:, 1] + 3 * np.abs(case.vectors).max()])


@routine("Otsu's threshold", "vectors")
def otsu_error(case: Case) -> float:
    scores = scores_of(case)
    upper = np.sort(scores[scores >= np.median(scores)]).astype(Wide)
    if upper[0] == upper[-1]:
        return float(abs(otsu(scores) - upper[0]) / max(abs(upper[0]), Wide(1e-30)))

    def between(below: int) -> Wide:
        low, high = upper[:below], upper[below:]
        return len(low) * len(high) * (low.mean() - high.mean()) ** 2 if len(low) and len(high) else Wide(0)

    best = max(between(below) for below in range(1, len(upper)) if upper[below] > upper[below - 1])
    return float(1 - between(int((upper < otsu(scores)).sum())) / best)


@routine("adaptive threshold", "vectors")
def threshold_error(case: Case) -> float:
    scores = scores_of(case)
    config = ThresholdConfig()
    wide = scores.astype(Wide)
    median = np.sort(wide)[[(len(wide) - 1) // 2, len(wide) // 2]].mean()
    away = np.sort(np.abs(wide - median))
    spread = Wide("1.4826") * away[[(len(away) - 1) // 2, len(away) // 2]].mean()
    want = min(Wide(config.fixed), max(Wide(config.relative) * wide.max(), median + NOISE * spread))
    return float(abs(threshold(scores, config) - want) / np.abs(wide).max())


def cluster_errors(points: np.ndarray, labels: np.ndarray, eps: float, count: int, slack: float = 0.0) -> float:
    """Share of the points that are together, apart or noise against the rule, of those whose answer `slack` cannot
    change."""
    tight, loose = (oracles.dbscan(points, eps * (1 + sign * max(slack, 1e-9)), count) for sign in (-1, 1))
    core = oracles.close(points, eps * (1 - max(slack, 1e-9))).sum(axis=1) >= count
    wrong = (loose < 0) & (labels >= 0)
    wrong |= (tight >= 0) & (labels < 0)
    for label in range(tight.max(initial=-1) + 1):
        members = np.flatnonzero(core & (tight == label))
        wrong[members] |= labels[members] != labels[members[0]]
    for label in range(labels.max(initial=-1) + 1):
        members = np.flatnonzero(core & (labels == label))
        if len(members):
            wrong[members] |= loose[members] != loose[members[0]]
    return float(wrong.mean())


@routine("DBSCAN", "splat")
def dbscan_error(case: Case) -> float:
    points = few(case).gaussians.means
    errors = []
    rounding = 4 * float(np.spacing(np.abs(points).max(initial=0)))
    for eps in (3 * case.voxel, 1e-6 * case.voxel):
        errors.append(cluster_errors(points, cluster(points, eps, 4), eps, 4, slack=rounding / eps))
    return max(errors)


@routine("DBSCAN on a grid", "splat")
def grid_dbscan_error(case: Case) -> float:
    points, eps = few(case).gaussians.means, 3 * case.voxel
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(clusters_module, "MAX_NEIGHBORS", -1)
        return cluster_errors(points, cluster(points, eps, 4), eps, 4, slack=0.9)


@routine("scores of clusters", "vectors")
def cluster_scores_error(case: Case) -> float:
    scores = case.vectors[:, 0]
    weights = (10 ** np.random.default_rng(0).uniform(-6, 6, len(scores))).astype(np.float32)
    labels, rows = np.arange(len(scores)) % 3 - 1, np.arange(len(scores))
    errors = [0.0]
    for each in score_clusters(labels, rows, scores, weights):
        heft = weights[each.rows].astype(Wide)
        mean = (scores[each.rows] * heft).sum() / heft.sum()
        damping = (heft.sum() / weights.astype(Wide).sum()) ** Wide(str(SHARE_POWER))
        want = mean * damping if mean >= 0 else mean / damping
        errors.append(float(abs(each.score - want) / max(np.abs(scores).max(), abs(want))))
    return max(errors)


@routine("presence probability", "vectors")
def presence_error(case: Case) -> float:
    features, zero = features_of(case), np.zeros(CHANNELS, np.float32)
    cosines = relevancy(features, WORDS[:1], zero)[0]
    rows = np.arange(0, len(case.vectors), 3)
    weight = float(features.weights[rows].sum())
    one = Cluster(rows=rows, score=0.5, weight=weight, share=0.4)
    got = probability(Presence(features, zero, None).evidence(WORDS[0], cosines, [one])[0])
    heft = features.weights[rows].astype(Wide)
    wide = wide_cosines(features, features.mean, WORDS[:1])[:, 0]
    median = np.sort(wide)[[(len(wide) - 1) // 2, len(wide) // 2]].mean()
    away = np.sort(np.abs(wide - median))
    spread = Wide("1.4826") * away[[(len(away) - 1) // 2, len(away) // 2]].mean()
    height = (wide[rows].max() - median) / max(spread, Wide(SMALLEST_SPREAD))
    evidence = {
        "mean": (heft @ wide[rows]) / heft.sum(), "prominence": np.log(max(height, Wide(1e-3))),
        "size": Wide(math.log10(len(rows))), "share": Wide(0.4),
    }  # fmt: skip
    logit = WITHOUT_RIVALS["intercept"] + sum(WITHOUT_RIVALS[name] * value for name, value in evidence.items())
    return float(abs(got - 1 / (1 + np.exp(-logit))))
