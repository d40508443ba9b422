"""How well each Gaussian's feature answers a word: cosines in basis coordinates, and contrast.

Q queries, M negative words, N Gaussians, R basis rank, D channels.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float32, Float64

from gsencoder.core.errors import InputError
from gsencoder.types import GaussianFeatures

Mode = Literal["centered", "raw"]
CHUNK_BYTES = 1 << 25
MIN_RELATIVE_NORM = 1e-3
"""Share of the mean's norm below which a centered feature is rounding, not direction (float16 files keep 5e-4)."""
EPS = 1e-60
"""Keeps the root of a squared norm above zero; float64 holds the squares of norms down to 1e-150."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FeatureAxes:
    """S axes in which norms and products of features, less a mean, are those of all D channels.

    With the stacked rows M = [components; basis mean − removed mean] = L·Q (Q orthonormal), the feature of coordinates
    z is [z, 1]·L in the axes Q, so that norms and products need R + 1 numbers and no decoding.

    Attributes:
        matrix: from stored rows to the axes; None where the rows are the vectors themselves.
        offset: added after it.
        axes: the axes as columns; None where they are the channels.
        floor: squared length that is added to that of a feature: one much shorter than the mean has no direction.
    """

    matrix: Float64[np.ndarray, "R S"] | None
    offset: Float64[np.ndarray, " S"]
    axes: Float64[np.ndarray, "D S"] | None
    floor: float

    def directions_of(self, stored: Float32[np.ndarray, "n channels"]) -> Float64[np.ndarray, "n S"]:
        """The directions of stored rows; of length 1, or less where a feature is hardly longer than rounding."""
        local = stored.astype(np.float64)
        local = (local if self.matrix is None else local @ self.matrix) + self.offset
        return local / np.sqrt((local**2).sum(axis=1, keepdims=True) + self.floor)

    def project(self, directions: Float64[np.ndarray, "Q D"]) -> Float64[np.ndarray, "Q S"]:
        """Directions of the space in these axes; what lies across them has no product with any feature."""
        return directions if self.axes is None else directions @ self.axes


def feature_axes(features: GaussianFeatures, mode: Mode = "centered") -> FeatureAxes:
    """The axes of features less their mean, or of raw ones."""
    centered = features.mean.astype(np.float64)
    removed = centered if mode == "centered" else np.zeros_like(centered)
    floor = EPS + MIN_RELATIVE_NORM**2 * float(removed @ removed)
    if features.basis is None:
        return FeatureAxes(matrix=None, offset=-removed, axes=None, floor=floor)
    basis = features.basis
    stacked = np.concatenate([basis.components.astype(np.float64), (basis.mean - removed)[None]])
    axes, triangle = np.linalg.qr(stacked.T)
    return FeatureAxes(matrix=triangle.T[:-1], offset=triangle.T[-1], axes=axes, floor=floor)


def word_directions(
    words: Float32[np.ndarray, "Q D"], text_mean: Float32[np.ndarray, " D"], mode: Mode = "centered"
) -> Float64[np.ndarray, "Q D"]:
    """Words as unit vectors, less the mean of the text side unless `mode` is "raw"."""
    directions = words.astype(np.float64) - (text_mean if mode == "centered" else 0.0)
    return np.asarray(directions / np.sqrt((directions**2).sum(axis=1, keepdims=True) + EPS))


def relevancy(
    features: GaussianFeatures,
    text: Float32[np.ndarray, "Q D"],
    text_mean: Float32[np.ndarray, " D"],
    *,
    negatives: Float32[np.ndarray, "M D"] | None = None,
    temperature: float = 0.1,
    mode: Mode = "centered",
) -> Float32[np.ndarray, "Q N"]:
    """Cosine of every Gaussian's feature with every word, or its contrast with negative words.

    The cosine is computed in the coordinates that are stored (see `FeatureAxes`), and rows stream in chunks. In the
    mode "centered" the features lose `features.mean` and the words `text_mean`; a centered feature shorter than 1e-3 of
    the mean counts as having no direction, and its cosine fades to 0.

    With `negatives`, the score is LERF's (Kerr et al. 2023, https://arxiv.org/abs/2303.09553, section 3.4): the
    smallest, over the negatives and the other queries, of exp(c/t) / (exp(c/t) + exp(c_negative/t)), which lies in
    [0, 1] and is 0.5 where the word and its strongest rival are even. Words with the same vector as the query are no
    rivals.

    Args:
        features: what the Gaussians have, in a basis or not.
        text: vectors of the queries; their length does not matter.
        text_mean: mean of the text side.
        negatives: vectors of negative words (there may be none of them), or None for plain cosines.
        temperature: t above; LERF's factor of 10 is 0.1.
        mode: "centered" or "raw" cosines.

    Returns:
        Relevancy, in [−1, 1] for cosines; NaN for Gaussians never seen.

    Raises:
        InputError: sizes that differ from the space's, values that are not finite, a temperature that is not positive.
    """
    words = text if negatives is None else np.concatenate([text, negatives])
    channels = features.space.channels
    if words.ndim != 2 or words.shape[1] != channels or text_mean.shape != (channels,):
        raise InputError(
            f"relevancy: expected words and their mean of {channels} channels ({features.space.name}), "
            f"got {words.shape} and {text_mean.shape}"
        )
    if not (np.isfinite(words).all() and np.isfinite(text_mean).all()):
        raise InputError("relevancy: expected finite word vectors and text mean, got NaN or Inf")
    if mode not in ("centered", "raw") or not 0 < temperature < math.inf:
        raise InputError(f"relevancy: expected mode centered or raw, temperature > 0, got {mode!r} and {temperature}")
    directions = word_directions(words, text_mean, mode)
    axes = feature_axes(features, mode)
    targets = axes.project(directions)
    shared = features.index is not None
    rows = np.arange(len(features.features)) if shared else np.flatnonzero(features.seen)
    scores = np.full((len(words), len(features.features) + shared), np.nan, np.float32)
    step = max(1, CHUNK_BYTES // (8 * (len(axes.offset) + len(words))))
    for start in range(0, len(rows), step):
        chunk = rows[start : start + step]
        scores[:, chunk] = np.clip(axes.directions_of(features.features[chunk]) @ targets.T, -1, 1).T
    if negatives is not None:
        scores = _contrast(scores, directions, len(text), temperature)
    # The score behind that of the last row of a table is what Gaussians without a row take.
    return scores if features.index is None else scores[:, features.index]


def _contrast(
    cosines: Float32[np.ndarray, "words N"],
    directions: Float64[np.ndarray, "words D"],
    num_queries: int,
    temperature: float,
) -> Float32[np.ndarray, "Q N"]:
    """The pairwise softmax falls as its rival grows, so the smallest is against the strongest rival."""
    same = directions @ directions.T > 1 - 1e-6
    scores = np.full((num_queries, cosines.shape[1]), np.nan, np.float32)
    for row in range(num_queries):
        rivals = np.flatnonzero(~same[row])
        if rivals.size == 0:
            raise InputError("relevancy: contrast needs a negative word, or two different asked words")
        strongest = cosines[rivals[0]].copy()
        for rival in rivals[1:]:
            np.maximum(strongest, cosines[rival], out=strongest)
        margin = (cosines[row] - strongest).astype(np.float64) / temperature
        # tanh form of the logistic function: no overflow at any temperature.
        scores[row] = 0.5 * (1 + np.tanh(margin / 2))
    return scores
