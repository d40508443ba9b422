"""Queries without training: the coordinates of features in their principal directions.

The features may be fused, which gives queries to start an optimization from, or predicted by an encoder, which gives
the memory of a scene that nothing was optimized for.
"""

import math

import numpy as np
from jaxtyping import Float32

from gsencoder.core.errors import InputError
from gsencoder.types import GaussianFeatures, MemoryBank, QueryMemory
from gsencoder.types.memory import Scoring

BLOCK = 1 << 14
"""Rows that are taken at a time."""


def principal_queries(
    features: GaussianFeatures, channels: int, scoring: Scoring = "centered"
) -> tuple[Float32[np.ndarray, "N s"], Float32[np.ndarray, "s D"]]:
    """Queries and a projection W_m whose product is nearest to features about their mean, in least squares.

    A cosine that is not centered depends on the mean as well, whose coordinate, the first one, is 1 for every Gaussian.
    With cosines queries have unit variance and rows of the projection the length √D, so that one learning rate serves
    both; with products they are in the units of the space.

    Args:
        features: of the Gaussians; those never seen have queries of zero.
        channels: s. Where the features have fewer directions, further channels are zero.
        scoring: how queries will be compared with components.

    Raises:
        InputError: no Gaussian has features.
    """
    seen = np.flatnonzero(features.seen)
    if not len(seen):
        raise InputError("memory: no Gaussian has features")
    basis, space = features.basis, features.space
    width = features.features.shape[1]
    offset = features.mean if basis is None else np.zeros(width, np.float32)
    moment = np.zeros((width, width))
    for start in range(0, len(seen), BLOCK):
        rows = features.stored(seen[start : start + BLOCK]) - offset
        moment += rows.T @ rows
    constant = int(scoring != "centered")
    rank = max(0, min(channels - constant, width))
    directions = np.linalg.eigh(moment)[1][:, ::-1][:, :rank].astype(np.float32)
    queries = np.zeros((len(features), channels), np.float32)
    projection = np.zeros((channels, space.channels), np.float32)
    part = slice(constant, constant + rank)
    for start in range(0, len(seen), BLOCK):
        chunk = seen[start : start + BLOCK]
        queries[chunk, part] = (features.stored(chunk) - offset) @ directions
    projection[part] = directions.T if basis is None else directions.T @ basis.components
    if constant:
        queries[seen, 0], projection[0] = 1, features.mean
    if scoring == "dot":
        return queries, projection
    spread = np.float32(float(queries[seen].std()) or 1.0)
    return queries / spread, projection * np.float32(math.sqrt(space.channels))


def memory_of_features(
    features: GaussianFeatures,
    bank: MemoryBank,
    *,
    channels: int = 16,
    scoring: Scoring = "centered",
    temperature: float = 0.05,
) -> QueryMemory:
    """The memory of features without any training.

    Args:
        features: of the Gaussians, fused or predicted by an encoder.
        bank: of the scene's own views, or of other scenes.
        channels: of a query.
        scoring: how queries are compared with components.
        temperature: of the attention.

    Raises:
        InputError: features and bank are of different spaces, or no Gaussian has features.
    """
    if features.space != bank.space:
        raise InputError(
            f"memory: the features are of ({features.space.describe()}), and the bank is of ({bank.space.describe()})"
        )
    queries, projection = principal_queries(features, channels, scoring)
    return QueryMemory(
        queries=queries,
        weights=features.weights,
        projection=projection,
        bank=bank,
        scoring=scoring,
        temperature=temperature,
        mean=features.mean,
        basis=features.basis,
    )
