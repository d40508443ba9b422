"""How well each Gaussian's feature answers a word: cosines in basis coordinates, contrast, thresholds.

Q queries, M negative words, N Gaussians, R basis rank, D channels.
"""

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float32, Float64

from gsencoder.core.errors import InputError
from gsencoder.types import GaussianFeatures

Mode = Literal["centred", "raw"]
CHUNK_BYTES = 1 << 25
MIN_RELATIVE_NORM = 1e-3
"""Share of the mean's norm below which a centered feature is rounding, not direction (float16 files keep 5e-4)."""
EPS = 1e-60
"""Keeps the root of a squared norm above zero; float64 holds the squares of norms down to 1e-150."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ThresholdConfig:
    """Which relevancy a Gaussian needs to be taken, for each word on its own."""

    kind: Literal["fixed", "relative", "quantile", "otsu"] = field(
        default="fixed",
        metadata={"help": "fixed value, share of the word's best, quantile of the scene, or Otsu's split"},
    )
    fixed: float = field(default=0.5, metadata={"help": "relevancy for kind=fixed"})
    relative: float = field(default=0.4, metadata={"help": "share of the word's highest relevancy for kind=relative"})
    quantile: float = field(default=0.995, metadata={"help": "share of the seen Gaussians left out, kind=quantile"})

    def __post_init__(self) -> None:
        if self.kind not in ("fixed", "relative", "quantile", "otsu"):
            raise InputError(f"kind: expected fixed, relative, quantile or otsu, got {self.kind!r}")
        if not -1 <= self.fixed <= 1:
            raise InputError(f"fixed: expected a relevancy in [-1, 1], got {self.fixed}")
        if not 0 < self.relative <= 1:
            raise InputError(f"relative: expected a share in (0, 1], got {self.relative}")
        if not 0 <= self.quantile <= 1:
            raise InputError(f"quantile: expected a share in [0, 1], got {self.quantile}")


def relevancy(
    features: GaussianFeatures,
    text: Float32[np.ndarray, "Q D"],
    text_mean: Float32[np.ndarray, " D"],
    *,
    negatives: Float32[np.ndarray, "M D"] | None = None,
    temperature: float = 0.1,
    mode: Mode = "centred",
) -> Float32[np.ndarray, "Q N"]:
    """Cosine of every Gaussian's feature with every word, or its contrast with negative words.

    The cosine is computed in the coordinates that are stored: with the stacked rows M = [components; basis mean −
    removed mean] = L·Q (Q orthonormal), the feature of z is [z, 1]·L in the axes Q, so norms and products need R + 1
    numbers and no decoding. Rows stream in chunks. In the mode "centered" the features lose `features.mean` and the
    words `text_mean`; a centered feature shorter than 1e-3 of the mean counts as having no direction, and its cosine
    fades to 0.

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
    if mode not in ("centred", "raw") or not 0 < temperature < math.inf:
        raise InputError(f"relevancy: expected mode centered or raw, temperature > 0, got {mode!r} and {temperature}")
    directions = words.astype(np.float64) - (text_mean if mode == "centred" else 0.0)
    directions /= np.sqrt((directions**2).sum(axis=1, keepdims=True) + EPS)
    removed = features.mean.astype(np.float64) if mode == "centred" else np.zeros(channels)
    scores = np.full((len(words), len(features)), np.nan, np.float32)
    rows = np.flatnonzero(features.seen)
    matrix, offset, targets = _fold(features, removed, directions)
    floor = EPS + MIN_RELATIVE_NORM**2 * float(removed @ removed)
    step = max(1, CHUNK_BYTES // (8 * (len(offset) + len(words))))
    for start in range(0, len(rows), step):
        chunk = rows[start : start + step]
        local = features.features[chunk].astype(np.float64)
        local = (local if matrix is None else local @ matrix) + offset
        norms = np.sqrt((local**2).sum(axis=1, keepdims=True) + floor)
        scores[:, chunk] = np.clip((local / norms) @ targets.T, -1, 1).T
    if negatives is None:
        return scores
    return _contrast(scores, directions, len(text), temperature)


def _fold(
    features: GaussianFeatures, removed: Float64[np.ndarray, " D"], directions: Float64[np.ndarray, "Q D"]
) -> tuple[Float64[np.ndarray, "R S"] | None, Float64[np.ndarray, " S"], Float64[np.ndarray, "Q S"]]:
    """Matrix and offset from stored rows to S axes in which norms and products are those of the centered vectors.

    The words in those axes come third. No matrix where the rows are the vectors themselves.
    """
    if features.basis is None:
        return None, -removed, directions
    basis = features.basis
    stacked = np.concatenate([basis.components.astype(np.float64), (basis.mean - removed)[None]])
    axes, triangle = np.linalg.qr(stacked.T)
    return triangle.T[:-1], triangle.T[-1], directions @ axes


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


def threshold(scores: Float32[np.ndarray, " N"], config: ThresholdConfig) -> float:
    """The relevancy from which on one word's Gaussians are taken; NaN where no Gaussian was seen."""
    seen = scores[np.isfinite(scores)]
    if seen.size == 0:
        return math.nan
    if config.kind == "fixed":
        return config.fixed
    if config.kind == "relative":
        return config.relative * float(seen.max())
    if config.kind == "quantile":
        return float(np.quantile(seen, config.quantile))
    return otsu(seen)


def otsu(values: Float32[np.ndarray, " n"], bins: int = 256) -> float:
    """Otsu's threshold (IEEE Trans. SMC 9, 1979) over the values above their median, on a histogram.

    An object is a small share of a scene. Over all values the split would fall between kinds of background, so the
    lower half, which is background in any scene that this is meant for, is left out. A constant is its own threshold.
    """
    upper = values[values >= np.median(values)].astype(np.float64)
    if upper.min() == upper.max():
        return float(upper.max())
    counts, edges = np.histogram(upper, bins)
    centers = (edges[1:] + edges[:-1]) / 2
    below = counts.cumsum()
    above = below[-1] - below
    moment = (counts * centers).cumsum()
    splits = np.flatnonzero((below > 0) & (above > 0))
    low = moment[splits] / below[splits]
    high = (moment[-1] - moment[splits]) / above[splits]
    between = below[splits] * above[splits] * (high - low) ** 2
    # Of equally good splits (an empty gap) the middle one, as far from both classes as can be.
    best = splits[between >= between.max() * (1 - 1e-12)]
    return float(edges[best[len(best) // 2] + 1])
