"""Random features of Gaussians."""

import numpy as np

from gsencoder.types import FeatureBasis, FeatureSpace, GaussianFeatures

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
