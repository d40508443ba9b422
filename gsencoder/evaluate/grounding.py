"""Grounding in pictures, as M3 measures it (sec. 4.1, table 2): Otsu's threshold on a phrase's map, IoU with a mask.

M3 prints the share of pairs whose IoU reaches 0.5 or 0.6 as AP50 and AP60. It is no average precision, and is called a
precision here.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32

from gsencoder.core.errors import InputError

BINS = 256
"""Bins of the histogram, as in scikit-image, which M3's released code calls."""
PRECISION_IOUS = (0.5, 0.6)
"""IoUs from which on a pair counts in the precision."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GroundedPair:
    """One phrase in one view.

    Attributes:
        view: name of the view.
        phrase: what was looked for.
        intersection: pixels of the mask that were found.
        union: pixels of the mask, and those that were found and are not of the mask.
        finite: whether the map was finite; nothing is found in one that was not.
    """

    view: str
    phrase: str
    intersection: int
    union: int
    finite: bool = True

    @property
    def iou(self) -> float:
        return self.intersection / self.union


@dataclass(frozen=True, slots=True, kw_only=True)
class GroundingScores:
    """Scores of pairs of a view and a phrase; NaN without pairs.

    Attributes:
        pairs: that were scored.
        not_finite: of them, those whose map was not finite. Their IoU is 0, so that no method gains by failing.
        miou: mean IoU of the pairs.
        ciou: sum of the intersections by the sum of the unions: each pixel counts the same, and large masks most.
        p50: share of the pairs with an IoU of 0.5 or more.
        p60: share of the pairs with an IoU of 0.6 or more.
    """

    pairs: int
    not_finite: int
    miou: float
    ciou: float
    p50: float
    p60: float


def otsu_threshold(values: Float32[np.ndarray, "*shape"]) -> float:
    """The threshold that separates two classes of values with the largest variance between them (Otsu 1979).

    Of the histogram of the values in 256 bins between their extremes, a split after bin k has the variance
    n₁(k) · n₂(k) · (m₁(k) − m₂(k))², with the numbers and mean values of both classes, where a bin stands for its
    center. The threshold is the center of bin k; of equal splits the first is taken.

    Args:
        values: finite, one or more.

    Returns:
        The threshold; values above it are the upper class. The value itself where all are equal, so that none is above.

    Raises:
        InputError: no values, or values that are not finite.
    """
    if not values.size or not np.isfinite(values).all():
        wrong = f"{int((~np.isfinite(values)).sum()):,} of {values.size:,} that are not" if values.size else "none"
        raise InputError(f"otsu_threshold: expected finite values, got {wrong}")
    # The bins of a narrow range of float32 values are distinct in float64 only.
    flat = values.ravel().astype(np.float64)
    if flat.min() == flat.max():
        return float(flat[0])
    counts, edges = np.histogram(flat, bins=BINS)
    centers = (edges[:-1] + edges[1:]) / 2
    lower, upper = np.cumsum(counts), np.cumsum(counts[::-1])[::-1]
    lower_mean = np.cumsum(counts * centers) / lower
    upper_mean = (np.cumsum((counts * centers)[::-1]) / np.cumsum(counts[::-1]))[::-1]
    between = lower[:-1].astype(np.float64) * upper[1:] * (lower_mean[:-1] - upper_mean[1:]) ** 2
    return float(centers[np.argmax(between)])


def ground(
    relevancy: Float32[np.ndarray, "H W"], truth: Bool[np.ndarray, "_h _w"], *, view: str, phrase: str
) -> GroundedPair:
    """Compares what lies above Otsu's threshold of a map with a mask.

    Args:
        relevancy: of the phrase. With a value that is not finite, nothing is found, and the pair says so.
        truth: pixels of what the phrase means, one or more.
        view: name of the view.
        phrase: that the map is of.

    Raises:
        InputError: sizes that differ, or a mask without pixels.
    """
    if relevancy.shape != truth.shape or not truth.any():
        raise InputError(
            f"grounding: {phrase!r} in view {view!r}: expected a mask with pixels of the map's size {relevancy.shape}, "
            f"got {int(truth.sum())} pixels of {truth.shape}"
        )
    finite = bool(np.isfinite(relevancy).all())
    above = relevancy > otsu_threshold(relevancy) if finite else np.zeros_like(truth)
    return GroundedPair(
        view=view,
        phrase=phrase,
        intersection=int((above & truth).sum()),
        union=int((above | truth).sum()),
        finite=finite,
    )


def grounding_scores(pairs: Sequence[GroundedPair]) -> GroundingScores:
    """The scores of pairs of any views and phrases."""
    ious = np.array([pair.iou for pair in pairs], np.float64)
    union = sum(pair.union for pair in pairs)
    half, more = (float((ious >= least).mean()) if pairs else math.nan for least in PRECISION_IOUS)
    return GroundingScores(
        pairs=len(pairs),
        not_finite=sum(not pair.finite for pair in pairs),
        miou=float(ious.mean()) if pairs else math.nan,
        ciou=sum(pair.intersection for pair in pairs) / union if pairs else math.nan,
        p50=half,
        p60=more,
    )
