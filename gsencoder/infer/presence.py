"""The probability that what a box holds is what its word says: a logistic model over evidence from relevancy alone.

The evidence of a cluster c of the word q, with centered cosines cos and weights w normalized over the cluster:

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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from jaxtyping import Float32, Float64

from gsencoder.infer.boxes import Cluster
from gsencoder.infer.relevancy import FeatureAxes, background, feature_axes, word_directions
from gsencoder.text.table import TextTable
from gsencoder.types import GaussianFeatures

SYNONYM = 0.77
"""Centered cosine of two words from which on they are no rivals. Names that are beside each other in the rooms of the
fit go up to 0.75 (dining table and table); couch and sofa have 0.82, tv and television 0.89."""
LEAST_ATTAINABLE = 0.3
"""A phrase whose best name has a smaller cosine than this is not understood, and not helped any further."""
SMALLEST_SPREAD = 1e-3
"""Spread of relevancy below which that of the background counts as this: a scene of one kind alone has none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """What speaks for a cluster; see the module.

    Attributes:
        mean, margin, prominence, size, share: as there; margin is None without a vocabulary.
        trained: whether the encoder of the features was trained on the word; None where that is not stated, as for
            fused features.
    """

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
    {"intercept": -15.794, "mean": 15.848, "margin": 3.697, "prominence": 0.122, "size": 1.159, "share": 1.238}
)
"""Coefficients of words that the encoder of the features was trained on."""
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
    logit = coefficients["intercept"]
    for name, coefficient in coefficients.items():
        if name != "intercept":
            logit += coefficient * getattr(evidence, name)
    # The tanh form of the logistic function does not overflow.
    return 0.5 * (1 + math.tanh(logit / 2))


class Presence:
    """Collects evidence for clusters of one feature set."""

    def __init__(
        self,
        features: GaussianFeatures,
        text_mean: Float32[np.ndarray, " D"],
        vocabulary: TextTable | None,
    ) -> None:
        """Args:
        text_mean: mean of the text side.
        vocabulary: words of the features' space that may fit better than the one asked; None where there are none."""
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
        """The evidence for each cluster of one word.

        Args:
            cosines: its centered cosine with every Gaussian, NaN where that was never seen.
            trained: whether the encoder of the features was trained on the word; None where that is not stated.
        """
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
