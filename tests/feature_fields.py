"""Features of Gaussians, boxes and answers that several test files stand on."""

from typing import Any

import numpy as np
from splats import front_camera, random_gaussians

from gsencoder.types import Box, FeatureBasis, FeatureSpace, GaussianFeatures, Localization, Scene, Views

SPACE = FeatureSpace(name="s", channels=12, teacher="test", text_encoder="words")


def make_features(
    n: int = 3000, rank: int = 6, magnitude: float = 1.0, basis: bool = True, kinds: int = 0
) -> GaussianFeatures:
    """Random directions with fewer and fewer energy, or a few kinds of vectors; every fifth row unseen."""
    rng = np.random.default_rng(n + rank)
    columns = rank if basis else 12
    values = rng.normal(size=(n, columns)) * 0.6 ** np.arange(columns)
    if kinds:
        values = values[rng.integers(0, kinds, n)]
    mean = rng.normal(size=12).astype(np.float32)
    weights = (10 ** rng.uniform(-3, 3, n)).astype(np.float32)
    if n > 4:
        weights[::5] = 0
    values = values * magnitude if basis else values * magnitude + mean
    values[weights == 0] = 0
    components = np.linalg.qr(rng.normal(size=(12, rank)))[0].T.astype(np.float32)
    return GaussianFeatures(
        features=values.astype(np.float32),
        weights=weights,
        mean=mean,
        space=SPACE,
        basis=FeatureBasis(mean=mean, components=components, energy_kept=0.9, space=SPACE) if basis else None,
    )


def make_scene(n: int, origin: Any = (0.0, 0.0, 0.0)) -> Scene:
    """Random Gaussians before one camera, half a metre a unit."""
    views = Views(cameras=front_camera(), names=("a",))
    world = {"origin": np.array(origin, np.float64), "metres_per_unit": 0.5, "up": np.array([0.0, 0, 1])}
    return Scene(name="room", gaussians=random_gaussians(n), views=views, **world)


def plain_features(
    values: np.ndarray,
    space: FeatureSpace,
    weights: np.ndarray | None = None,
    mean: np.ndarray | None = None,
    basis: FeatureBasis | None = None,
) -> GaussianFeatures:
    """These values: all seen and about a mean of zero unless weights and a mean are given."""
    return GaussianFeatures(
        features=values.astype(np.float32),
        weights=np.ones(len(values), np.float32) if weights is None else weights.astype(np.float32),
        mean=np.zeros(space.channels, np.float32) if mean is None else mean,
        space=space,
        basis=basis,
    )


def box_of(
    query: str, rank: int, rows: np.ndarray, low: Any = 0.0, high: Any = 1.0, *, score: float = 0.5, **more: float
) -> Box:
    """An upright box from a corner to the one across; one number stands for three."""
    low, high = (np.full(3, each, np.float64) for each in (low, high))
    middle = {"obb_center": (low + high) / 2, "obb_rotation": np.eye(3), "obb_size": high - low}
    found = {"query": query, "rank": rank, "score": score, "probability": 1.0, "rows": rows}
    return Box(aabb_min=low, aabb_max=high, **middle, **(found | more))


def answer_of(
    queries: tuple[str, ...], relevancy: np.ndarray, boxes: tuple[Box, ...] = (), threshold: float = 0.0
) -> Localization:
    """What words found, each of them for certain."""
    thresholds, probabilities = (np.full(len(queries), each, np.float32) for each in (threshold, 1.0))
    return Localization(
        queries=queries, relevancy=relevancy, thresholds=thresholds, probabilities=probabilities, boxes=boxes
    )
