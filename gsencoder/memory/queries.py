"""Queries without training: the coordinates of features in the principal directions of a bank.

The features may be fused, which gives queries to start an optimization from, or predicted by an encoder, which gives
the memory of a scene that nothing was optimized for.
"""

import math

import numpy as np
from jaxtyping import Float32

from gsencoder.core.errors import InputError
from gsencoder.types import GaussianFeatures, MemoryBank, QueryMemory
from gsencoder.types.features import Scoring, attention_keys

BLOCK = 1 << 14
"""Rows that are taken at a time."""


def principal_queries(
    features: GaussianFeatures, bank: MemoryBank, channels: int, scoring: Scoring = "centered"
) -> tuple[Float32[np.ndarray, "N s"], Float32[np.ndarray, "s D"]]:
    """Queries and a projection W_m whose product is the features about their mean, in the s directions in which the
    components of the bank differ most.

    Each component counts once, by its direction about the mean: where many Gaussians are walls, the principal
    directions of the Gaussians' features would leave out those that tell a mug from a cup.

    A cosine that is not centered depends on the mean as well, whose coordinate, the first one, is 1 for every Gaussian.
    With cosines queries have unit variance and rows of the projection the length √D, so that one learning rate serves
    both; with products they are in the units of the space.

    Args:
        features: of the Gaussians; those never seen have queries of zero.
        bank: that the queries will attend to.
        channels: s. Where the components have fewer directions, further channels are zero.
        scoring: how queries will be compared with components.

    Raises:
        InputError: features and bank are of different spaces, or no Gaussian has features.
    """
    if features.space != bank.space:
        raise InputError(
            f"memory: the features are of ({features.space.describe()}), and the bank is of ({bank.space.describe()})"
        )
    seen = np.flatnonzero(features.seen)
    if not len(seen):
        raise InputError("memory: no Gaussian has features")
    basis, space = features.basis, features.space
    offset = features.mean if basis is None else np.zeros(basis.rank, np.float32)
    constant = int(scoring != "centered")
    keys = attention_keys(bank.components, features.mean, "centered").astype(np.float64)
    if basis is not None:
        keys = keys @ basis.components.T
    directions = np.linalg.eigh(keys.T @ keys)[1][:, ::-1][:, : max(0, channels - constant)].astype(np.float32)
    part = slice(constant, constant + directions.shape[1])
    queries = np.zeros((len(features), channels), np.float32)
    for start in range(0, len(seen), BLOCK):
        chunk = seen[start : start + BLOCK]
        queries[chunk, part] = (features.stored(chunk) - offset) @ directions
    projection = np.zeros((channels, space.channels), np.float32)
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
    queries, projection = principal_queries(features, bank, channels, scoring)
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
