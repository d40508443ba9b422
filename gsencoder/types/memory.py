"""Memory of a scene: principal scene components, and the queries of Gaussians that attend to them (M3, sec. 3.3)."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float32, Float64, Int32

from gsencoder.types.checks import check_array, check_finite, check_rows, fail
from gsencoder.types.features import FeatureBasis, FeatureSpace, GaussianFeatures

Scoring = Literal["centered", "cosine", "dot"]
"""How a query is compared with the components: by the cosine after the mean of the space has been subtracted from both,
by the cosine (M3's released code), or by the product (M3's Eq. 2)."""
EPS = 1e-6
"""Smallest length that a projected query is divided by, as in M3's released code."""
BLOCK_SCORES = 1 << 24
"""Scores of queries and components that are held at once, 64 MiB."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MemoryBank:
    """The principal scene components (PSC) of one teacher in one scene: some of the raw features of its maps.

    Attributes:
        components: raw features.
        sources: for each component the view, and the row and column of the map's cell, that it comes from.
        grid_from_image: for each component the affine of its map, as `FeatureMap` has it: from pixels of the view's
            image to cells of the map.
        mean: of the space; zero where cosines are not centered.
        threshold: θ, a cosine.
        coverage: share of the raw features that have a component within the threshold.
        cosine: mean over the raw features of the cosine with the nearest component.
        space: of the features.
    """

    components: Float32[np.ndarray, "M D"]
    sources: Int32[np.ndarray, "M 3"]
    grid_from_image: Float64[np.ndarray, "M 2 3"]
    mean: Float32[np.ndarray, " D"]
    threshold: float
    coverage: float
    cosine: float
    space: FeatureSpace

    def __post_init__(self) -> None:
        check_array("MemoryBank", "components", self.components, "float32", ("M", self.space.channels))
        check_array("MemoryBank", "sources", self.sources, "int32", (len(self.components), 3))
        check_array("MemoryBank", "grid_from_image", self.grid_from_image, "float64", (len(self.components), 2, 3))
        check_array("MemoryBank", "mean", self.mean, "float32", (self.space.channels,))
        check_finite("MemoryBank", "grid_from_image", self.grid_from_image)
        check_finite("MemoryBank", "components", self.components)
        check_finite("MemoryBank", "mean", self.mean)
        if not len(self.components):
            fail("MemoryBank", "components", "one component or more", "none")
        affine = self.grid_from_image
        diagonal = (affine[:, 0, 1] == 0) & (affine[:, 1, 0] == 0) & (affine[:, 0, 0] > 0) & (affine[:, 1, 1] > 0)
        check_rows("MemoryBank", "grid_from_image", diagonal, "resizes and crops (diagonal, positive)", affine)
        if not 0 < self.threshold <= 1:
            fail("MemoryBank", "threshold", "a cosine above 0 and up to 1", str(self.threshold))
        if not -1 <= self.cosine <= 1 + EPS or not 0 <= self.coverage <= 1:
            fail("MemoryBank", "coverage", "a share, and a cosine", f"{self.coverage} and {self.cosine}")

    def __len__(self) -> int:
        return len(self.components)

    @property
    def cells(self) -> Float64[np.ndarray, "M 4"]:
        """The rectangles that the components come from, in pixels of the images of their views: left, top, right and
        bottom edge. A rectangle may reach beyond its image where the map does."""
        scale, shift = self.grid_from_image[:, [0, 1], [0, 1]], self.grid_from_image[:, :, 2]
        first = self.sources[:, [2, 1]]
        return np.concatenate([(first - shift) / scale, (first + 1 - shift) / scale], axis=1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class QueryMemory:
    """Principal queries of Gaussians, and the bank that they attend to.

    A query q of s channels stands for the feature softmax(score(q W, PSC) / τ) PSC (Gaussian memory attention, Eq. 2).
    Queries blend as features do: those of a pixel are its row of B times `queries`, divided by its alpha.

    Attributes:
        queries: a row for each Gaussian; rows with weight 0 are zero and mean nothing.
        weights: how much each Gaussian was seen, in summed blending weight (pixels); 0 = never.
        projection: W_m, from query channels to the space.
        bank: the components.
        scoring: how queries are compared with components.
        temperature: τ; M3's equation has 1, its code 0.05 with cosines.
        mean: of the space, which centered cosines of decoded features remove.
        basis: in whose coordinates `features` decodes; None = in channels.
    """

    queries: Float32[np.ndarray, "N s"]
    weights: Float32[np.ndarray, " N"]
    projection: Float32[np.ndarray, "s D"]
    bank: MemoryBank
    scoring: Scoring
    temperature: float
    mean: Float32[np.ndarray, " D"]
    basis: FeatureBasis | None = None

    def __post_init__(self) -> None:
        channels = self.space.channels
        check_array("QueryMemory", "queries", self.queries, "float32", ("N", len(self.projection)))
        check_array("QueryMemory", "weights", self.weights, "float32", (len(self.queries),))
        check_array("QueryMemory", "projection", self.projection, "float32", ("s", channels))
        check_array("QueryMemory", "mean", self.mean, "float32", (channels,))
        for name in ("queries", "projection", "mean"):
            check_finite("QueryMemory", name, getattr(self, name))
        good = np.asarray((self.weights >= 0) & (self.weights < np.inf))
        check_rows("QueryMemory", "weights", good, "finite weights from 0", self.weights)
        if not 0 < self.temperature < np.inf:
            fail("QueryMemory", "temperature", "a positive number", str(self.temperature))
        if self.basis is not None and self.basis.space != self.space:
            fail("QueryMemory", "basis", self.space.describe(), self.basis.space.describe())

    @property
    def space(self) -> FeatureSpace:
        """What decoded features are."""
        return self.bank.space

    @property
    def channels(self) -> int:
        """Channels of a query, s."""
        return len(self.projection)

    def __len__(self) -> int:
        return len(self.queries)

    def attention(self, queries: Float32[np.ndarray, "n s"]) -> Float32[np.ndarray, "n M"]:
        """The weights of the components for queries; each row sums to 1."""
        return self._attention(queries, self._projected_keys())

    def _projected_keys(self) -> Float32[np.ndarray, "s M"]:
        """W_m PSCᵀ, which is the same for all queries."""
        return self.projection @ attention_keys(self.bank.components, self.mean, self.scoring).T

    def _attention(
        self, queries: Float32[np.ndarray, "n s"], keys: Float32[np.ndarray, "s M"]
    ) -> Float32[np.ndarray, "n M"]:
        scores = queries @ keys
        if self.scoring != "dot":
            gram = self.projection.astype(np.float64) @ self.projection.T
            lengths = np.sqrt(np.maximum(np.einsum("ns,st,nt->n", queries, gram, queries, dtype=np.float64), 0))
            scores = scores / np.maximum(lengths, EPS)[:, None].astype(np.float32)
        scores = scores / np.float32(self.temperature)
        weights = np.exp(scores - scores.max(axis=1, keepdims=True))
        return np.asarray(weights / weights.sum(axis=1, keepdims=True), np.float32)

    def attend(
        self, queries: Float32[np.ndarray, "n s"], values: Float32[np.ndarray, "M C"] | None = None
    ) -> Float32[np.ndarray, "n C"]:
        """The features that queries stand for, block by block.

        Args:
            queries: any, such as those rendered for pixels; their length does not matter with cosines.
            values: what is averaged; None = the components.
        """
        values = self.bank.components if values is None else values
        step, keys = max(1, BLOCK_SCORES // len(self.bank)), self._projected_keys()
        parts = [
            self._attention(queries[start : start + step], keys) @ values for start in range(0, len(queries), step)
        ]
        return np.concatenate(parts) if parts else np.zeros((0, values.shape[1]), np.float32)

    def features(self) -> GaussianFeatures:
        """The features of the Gaussians themselves, as fusion and encoders give them."""
        values = self.bank.components
        if self.basis is not None:
            # The weights of the components sum to 1, so that coordinates are averaged as vectors are.
            values = (values - self.basis.mean) @ self.basis.components.T
        decoded = np.zeros((len(self), values.shape[1]), np.float32)
        seen = np.flatnonzero(self.weights > 0)
        decoded[seen] = self.attend(self.queries[seen], np.ascontiguousarray(values, np.float32))
        return GaussianFeatures(
            features=decoded, weights=self.weights, mean=self.mean, space=self.space, basis=self.basis
        )


def attention_keys(
    components: Float32[np.ndarray, "M D"], mean: Float32[np.ndarray, " D"], scoring: Scoring
) -> Float32[np.ndarray, "M D"]:
    """What projected queries are multiplied with: the components, for cosines those of unit length, less the mean where
    cosines are centered."""
    if scoring == "dot":
        return components
    keys = (components - mean if scoring == "centered" else components).astype(np.float64)
    lengths = np.linalg.norm(keys, axis=1, keepdims=True)
    return np.asarray(keys / np.where(lengths > 0, lengths, 1), np.float32)
