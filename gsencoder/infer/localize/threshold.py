"""From which relevancy on Gaussians are taken for a word."""

import math
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float32

from gsencoder.core.errors import InputError

Kind = Literal["adaptive", "fixed", "relative", "quantile", "otsu"]
NORMAL_MAD = 1.4826
"""Standard deviations in a median absolute deviation of a normal distribution."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ThresholdConfig:
    """Which relevancy a Gaussian needs to be taken, for each word on its own."""

    kind: Kind = field(
        default="adaptive",
        metadata={
            "help": "a share of the word's best, at most the fixed value and at least the noise of the scene "
            "(adaptive); or one of: fixed value, share of the word's best, quantile of the scene, Otsu's split"
        },
    )
    fixed: float = field(default=0.5, metadata={"help": "relevancy for kind=fixed, and the most for kind=adaptive"})
    relative: float = field(
        default=0.7, metadata={"help": "share of the word's highest relevancy for kind=adaptive and kind=relative"}
    )
    noise: float = field(
        default=2.0,
        metadata={
            "help": "kind=adaptive takes no Gaussian below the median relevancy of the word plus so many times its "
            "spread (median absolute deviation, as a standard deviation) over the scene"
        },
    )
    quantile: float = field(default=0.995, metadata={"help": "share of the seen Gaussians left out, kind=quantile"})

    def __post_init__(self) -> None:
        if self.kind not in get_args(Kind):
            raise InputError(f"kind: expected one of {', '.join(get_args(Kind))}, got {self.kind!r}")
        if not -1 <= self.fixed <= 1:
            raise InputError(f"fixed: expected a relevancy in [-1, 1], got {self.fixed}")
        if not 0 < self.relative <= 1:
            raise InputError(f"relative: expected a share in (0, 1], got {self.relative}")
        if not 0 <= self.noise < math.inf:
            raise InputError(f"noise: expected zero or a positive number, got {self.noise}")
        if not 0 <= self.quantile <= 1:
            raise InputError(f"quantile: expected a share in [0, 1], got {self.quantile}")


def threshold(scores: Float32[np.ndarray, " N"], config: ThresholdConfig) -> float:
    """The relevancy from which on one word's Gaussians are taken; NaN where no Gaussian was seen.

    The adaptive one is min(fixed, max(relative · best, median + noise · spread)). A word that some Gaussians answer
    fully has the fixed threshold. Features of an encoder are shorter of what they stand for, most of all for kinds that
    it was not trained on: then the best Gaussians of the word set the threshold, as long as they stand out.
    """
    seen = scores[np.isfinite(scores)]
    if seen.size == 0:
        return math.nan
    if config.kind == "fixed":
        return config.fixed
    if config.kind == "quantile":
        return float(np.quantile(seen, config.quantile))
    if config.kind == "otsu":
        return otsu(seen)
    share = config.relative * float(seen.max())
    if config.kind == "relative":
        return share
    if share >= config.fixed:
        return config.fixed
    median, spread = background(seen)
    return min(config.fixed, max(share, median + config.noise * spread))


def background(seen: Float32[np.ndarray, " n"]) -> tuple[float, float]:
    """Median and spread of a word's relevancy over a scene, which is background for the most part.

    The spread is the median absolute deviation, as the standard deviation of the normal distribution that has it.

    Args:
        seen: finite relevancies, at least one.
    """
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
