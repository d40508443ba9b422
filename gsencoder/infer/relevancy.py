"""How well each Gaussian's feature answers a word: cosines in basis coordinates, contrast, and the probability that a
box holds what its word says. Q queries, M negative words, N Gaussians, R basis rank, D channels, S axes of features.

The probability is a logistic model over evidence from relevancy alone. For a cluster c of the word q, with centered
cosines cos and weights w normalized over the cluster:

    mean        Σ wᵢ cos(fᵢ, q), relative to the best that a name of the vocabulary reaches
    margin      mean − max over rivals r of Σ wᵢ cos(fᵢ, r): negative where another word of the vocabulary fits better
    prominence  log((best cosine in c − median) / spread), of the word's cosines over the scene
    size        log10 of the number of Gaussians
    share       of the cluster in the weight of all that was selected for the word

Words whose cosine with q is `SYNONYM` or more are no rivals: "couch" does not speak against "sofa". A phrase such as
"something to sit on" is less like any name than names are like themselves: its cosines are taken relative to the
largest that it has with a name of the vocabulary, and the names that come as near to it are no rivals.

An encoder calls what it was never trained on by the name of something known that looks alike: a sponge is a box. So a
rival speaks against a word that the encoder was trained on, and not against another one. Where the vocabulary states
which words the encoder was trained on, these and all others have coefficients of their own.

The coefficients were fitted by `bench/presence.py`; `docs/measurements.md` has the reliability of the probabilities.
"""

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import numpy as np
from jaxtyping import Float32, Float64, Int64

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.settings import CheckedConfig, option
from gsencoder.text.table import TextTable
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
        text: vectors of the queries; their length does not matter.
        negatives: vectors of negative words (there may be none of them), or None for plain cosines.
        temperature: t above; LERF's factor of 10 is 0.1.

    Returns:
        Relevancy, in [−1, 1] for cosines; NaN for Gaussians never seen.
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
    rows = np.arange(len(features.features)) if shared else np.flatnonzero(features.weights > 0)
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


class GaussianProducts:
    """Products of words with the features of Gaussians, less the mean; the lengths of the features are kept."""

    def __init__(self, features: GaussianFeatures, mode: Mode = "centered") -> None:
        self.features, self.axes = features, feature_axes(features, mode)
        self._unseen = np.flatnonzero(~features.seen)
        rows = features.features
        self._lengths = np.zeros(len(rows), np.float32)
        step = max(1, CHUNK_BYTES // (8 * len(self.axes.offset)))
        for start in range(0, len(rows), step):
            local = self._local(rows[start : start + step], slice(None), np.float64)
            self._lengths[start : start + step] = np.sqrt((local**2).sum(axis=1) + self.axes.floor)

    def products(self, directions: Float64[np.ndarray, "Q D"]) -> Float32[np.ndarray, "N Q"]:
        """(f − mean)·t of each Gaussian and word; 0 for Gaussians never seen."""
        return self._of_gaussians(self._products_of_rows(directions), fill=0.0)

    def cosines(self, directions: Float64[np.ndarray, "Q D"]) -> Float32[np.ndarray, "Q N"]:
        """Cosines of words of length 1 with the features of Gaussians; NaN for Gaussians never seen."""
        cosines = self._products_of_rows(directions) / self._lengths[:, None]
        return self._of_gaussians(np.clip(cosines, -1, 1), fill=np.nan).T

    def along(self, axes: slice) -> Float32[np.ndarray, "N axes"]:
        """f − mean of each Gaussian along some of the axes; 0 for Gaussians never seen."""
        return self._of_gaussians(self._local(self.features.features, axes, np.float32), fill=0.0)

    def _local(self, stored: np.ndarray, axes: slice, dtype: type) -> np.ndarray:
        offset: np.ndarray = self.axes.offset[axes].astype(dtype)
        matrix = self.axes.matrix
        if matrix is None:
            return stored[:, axes].astype(dtype) + offset
        return stored.astype(dtype, copy=False) @ matrix[:, axes].astype(dtype) + offset

    def _products_of_rows(self, directions: np.ndarray) -> np.ndarray:
        targets = self.axes.project(directions)
        # The words are brought to the coordinates that are stored, which are many more.
        words = targets if self.axes.matrix is None else targets @ self.axes.matrix.T
        return self.features.features @ words.T.astype(np.float32) + (targets @ self.axes.offset).astype(np.float32)

    def _of_gaussians(self, of_rows: np.ndarray, fill: float) -> np.ndarray:
        if self.features.index is None:
            values = of_rows
        else:
            # The row behind the last one, where −1 leads, is that of Gaussians without a row.
            values = np.concatenate([of_rows, np.zeros((1, of_rows.shape[1]), of_rows.dtype)])[self.features.index]
        values[self._unseen] = fill
        return values


Kind = Literal["adaptive", "fixed", "relative", "otsu"]
NOISE = 2.0
"""kind=adaptive takes no Gaussian below the median relevancy of the word plus this many times its spread."""
NORMAL_MAD = 1.4826
"""Standard deviations in a median absolute deviation of a normal distribution."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ThresholdConfig(CheckedConfig):
    """Which relevancy a Gaussian needs to be taken, for each word on its own."""

    kind: Kind = option(
        "adaptive",
        "a share of the word's best, at most the fixed value and at least the noise of the scene (adaptive); or one of "
        "fixed value, share of the word's best, Otsu's split",
    )
    fixed: float = option(0.5, "relevancy for kind=fixed, and the most for kind=adaptive", ge=-1, le=1)
    relative: float = option(
        0.7, "share of the word's highest relevancy for kind=adaptive and kind=relative", gt=0, le=1
    )


def threshold(scores: Float32[np.ndarray, " N"], config: ThresholdConfig) -> float:
    """The relevancy from which on one word's Gaussians are taken; NaN where no Gaussian was seen.

    The adaptive one is min(fixed, max(relative · best, median + `NOISE` · spread)). A word that some Gaussians answer
    fully has the fixed threshold. Features of an encoder are shorter of what they stand for, most of all for kinds that
    it was not trained on: then the best Gaussians of the word set the threshold, as long as they stand out.
    """
    seen = scores[np.isfinite(scores)]
    if seen.size == 0:
        return math.nan
    if config.kind == "fixed":
        return config.fixed
    if config.kind == "otsu":
        return otsu(seen)
    share = config.relative * float(seen.max())
    if config.kind == "relative":
        return share
    if share >= config.fixed:
        return config.fixed
    median, spread = background(seen)
    return min(config.fixed, max(share, median + NOISE * spread))


def background(seen: Float32[np.ndarray, " n"]) -> tuple[float, float]:
    """Median of a word's finite relevancies over a scene, which is background for the most part, and their spread: the
    median absolute deviation, as the standard deviation of the normal distribution that has it."""
    median = np.median(seen)
    return float(median), NORMAL_MAD * float(np.median(np.abs(seen - median)))


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


SYNONYM = 0.77
"""Centered cosine of two words from which on they are no rivals. Names that are next to each other in the rooms of the
fit go up to 0.75 (dining table and table); couch and sofa have 0.82, tv and television 0.89."""
LEAST_ATTAINABLE = 0.3
"""A phrase whose best name has a smaller cosine than this is not understood, and not helped any further."""
SMALLEST_SPREAD = 1e-3
"""Spread of relevancy below which that of the background counts as this: a scene of one kind alone has none."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cluster:
    """A cluster of the Gaussians that were selected for a word.

    Attributes:
        rows: its Gaussians, ascending.
        score: mean relevancy, weighted by the Gaussians' weights, times a small power of `share`.
        share: of its weight in that of all that was selected for the word.
    """

    rows: Int64[np.ndarray, " n"]
    score: float
    weight: float
    share: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """What speaks for a cluster; see the module. Without a vocabulary there is no margin, and `trained`, whether the
    encoder of the features was trained on the word, is None where that is not known, as for fused features."""

    mean: float
    margin: float | None
    prominence: float
    size: float
    share: float
    trained: bool | None = None


WITH_RIVALS: Mapping[str, float] = MappingProxyType(
    {"intercept": -11.048, "mean": 12.38, "margin": 2.662, "prominence": -0.226, "size": 0.41, "share": 3.293}
)
"""Coefficients where the words come from a vocabulary, and nothing states what an encoder was trained on."""
WITHOUT_RIVALS: Mapping[str, float] = MappingProxyType(
    {"intercept": -13.295, "mean": 16.358, "prominence": -0.305, "size": 0.369, "share": 2.834}
)
"""Coefficients where nothing is known but the word itself."""

TRAINED: Mapping[str, float] = MappingProxyType(
    {"intercept": -5.838, "mean": -0.335, "margin": 9.149, "prominence": 0.65, "size": 0.619, "share": 2.122}
)
"""Coefficients of words that the encoder of the features was trained on. They were fitted to two encoders, whose right
boxes have a mean of 0.82 and of 0.53: it does not tell right from wrong for both."""
UNTRAINED: Mapping[str, float] = MappingProxyType(
    {"intercept": -7.858, "mean": 5.657, "margin": -1.032, "prominence": 0.507, "size": 0.747, "share": 1.083}
)
"""Coefficients of words that it was not trained on."""


def probability(evidence: Evidence) -> float:
    """The probability that the Gaussians of a cluster are what the word says, in [0, 1]."""
    if evidence.margin is None:
        coefficients = WITHOUT_RIVALS
    else:
        coefficients = {None: WITH_RIVALS, True: TRAINED, False: UNTRAINED}[evidence.trained]
    logit = 0.0
    for name, coefficient in coefficients.items():
        logit += coefficient * (1.0 if name == "intercept" else getattr(evidence, name))
    # The tanh form of the logistic function does not overflow.
    return 0.5 * (1 + math.tanh(logit / 2))


KNOWN = 0.5
"""Share of right names that an encoder must expect in a scene that it knows."""


def expected_share(features: GaussianFeatures, scene: str) -> float | None:
    """The share of Gaussians of a scene whose most probable names an encoder expects to be right, with a warning where
    it is below `KNOWN`; None for features without confidence."""
    if features.confidence is None or not features.seen.any():
        return None
    share = float(features.confidence[features.seen].mean(dtype=np.float64))
    if share < KNOWN:
        warnings.warn(
            f"scene {scene}: the encoder expects {share:.0%} of its names in this scene to be right, fewer than half: "
            "it looks like nothing that the encoder was trained on, unless another direction is up (data.up=) or its "
            "unit is another (data.metres_per_unit=); `gsencoder fuse` on the splat asks a segmenter, which looks at "
            "renders or photographs of it",
            SceneWarning,
            stacklevel=3,
        )
    return share


class Presence:
    """Collects evidence for clusters of one feature set; words of `vocabulary` may fit them better than those asked."""

    def __init__(
        self, features: GaussianFeatures, text_mean: Float32[np.ndarray, " D"], vocabulary: TextTable | None
    ) -> None:
        self._features, self._text_mean = features, text_mean
        self._axes: FeatureAxes = feature_axes(features)
        self._rivals: Float64[np.ndarray, "C D"] | None = None
        if vocabulary is not None:
            self._rivals = word_directions(vocabulary.embeddings, text_mean)
            self._rival_targets = self._axes.project(self._rivals)

    def evidence(
        self,
        word: Float32[np.ndarray, " D"],
        cosines: Float32[np.ndarray, " N"],
        clusters: Sequence[Cluster],
        *,
        trained: bool | None = None,
    ) -> list[Evidence]:
        """The evidence for each cluster of one word, given its centered cosines (NaN for Gaussians never seen)."""
        if not clusters:
            return []
        direction = word_directions(word[None], self._text_mean)
        target = self._axes.project(direction)[0]
        rivals, attainable = None, 1.0
        if self._rivals is not None:
            likeness = self._rivals @ direction[0]
            attainable = float(np.clip(likeness.max(), LEAST_ATTAINABLE, 1))
            rivals = self._rival_targets[likeness < SYNONYM * attainable]
        median, spread = background(cosines[np.isfinite(cosines)])
        listed = []
        for each in clusters:
            rows = each.rows
            weights = self._features.weights[rows].astype(np.float64)
            # Cosines are linear in the directions, so that those of a cluster's mean direction are the mean cosines.
            mean_direction = (weights / weights.sum()) @ self._axes.directions_of(self._features.stored(rows))
            mean = min(float(target @ mean_direction) / attainable, 1.0)
            margin = None
            if rivals is not None and len(rivals):
                margin = mean - float((rivals @ mean_direction).max())
            height = (float(cosines[rows].max()) - median) / max(spread, SMALLEST_SPREAD)
            listed.append(
                Evidence(
                    mean=mean,
                    margin=margin,
                    prominence=math.log(max(height, 1e-3)),
                    size=math.log10(len(rows)),
                    share=each.share,
                    trained=trained,
                )
            )
        return listed
