"""Random memories."""

import numpy as np

from gsencoder.memory.attention import render_queries
from gsencoder.memory.bank import principal_queries
from gsencoder.render import Blend
from gsencoder.types import FeatureSpace, GaussianFeatures, MemoryBank, QueryMemory
from gsencoder.types.features import Scoring

TEMPERATURE = {"centered": 0.05, "cosine": 0.05, "dot": 1.0}


def make_bank(components: np.ndarray, mean: np.ndarray, space: FeatureSpace, cosine: float = 1.0) -> MemoryBank:
    """A bank whose components lie in the first cell of the first view."""
    count = len(components)
    return MemoryBank(
        components=components.astype(np.float32), sources=np.zeros((count, 3), np.int32),
        grid_from_image=np.tile(np.eye(2, 3), (count, 1, 1)), mean=mean, threshold=0.9, coverage=1.0,
        cosine=cosine, space=space,
    )  # fmt: skip


def make_memory(
    scoring: Scoring = "centered", *, components: int = 70, channels: int = 24, width: int = 6, gaussians: int = 200
) -> QueryMemory:
    rng = np.random.default_rng(components)
    space = FeatureSpace(name="s", channels=channels)
    mean = rng.normal(size=channels).astype(np.float32)
    raw = (rng.normal(size=(components, channels)) + mean).astype(np.float32)
    weights = rng.uniform(0.5, 2, gaussians).astype(np.float32)
    weights[::7] = 0
    queries = rng.normal(size=(gaussians, width)).astype(np.float32)
    queries[weights == 0] = 0
    bank = make_bank(raw, mean if scoring == "centered" else np.zeros_like(mean), space, cosine=0.95)
    return QueryMemory(
        queries=queries, weights=weights, projection=rng.normal(size=(width, channels)).astype(np.float32),
        bank=bank, scoring=scoring, temperature=TEMPERATURE[scoring], mean=mean,
    )  # fmt: skip


def memory_of_features(
    features: GaussianFeatures,
    bank: MemoryBank,
    *,
    channels: int = 16,
    scoring: Scoring = "centered",
    temperature: float = 0.05,
) -> QueryMemory:
    """The memory of features without any training."""
    queries, projection = principal_queries(features, bank, channels, scoring)
    return QueryMemory(
        queries=queries, weights=features.weights, projection=projection, bank=bank, scoring=scoring,
        temperature=temperature, mean=features.mean, basis=features.basis,
    )  # fmt: skip


def render_features(memory: QueryMemory, b: Blend) -> tuple[np.ndarray, np.ndarray]:
    """The features of the rows of B, and how opaque these rows are."""
    return memory.attend(render_queries(memory, b)[0]), b.alpha.numpy()
