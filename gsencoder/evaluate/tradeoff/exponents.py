"""Power laws of cost, cost = constant · size^exponent, by least squares of logarithms.

Costs that do not grow with a size, and what is constant, pull an exponent down at small sizes: it holds for the sizes
that were measured.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from gsencoder.core.errors import InputError


class Exponent(NamedTuple):
    """A power law fitted to costs.

    Attributes:
        value: the exponent.
        low, high: its 95 % confidence interval.
        constant: cost at size 1.
        points: how many costs it was fitted to.
    """

    value: float
    low: float
    high: float
    constant: float
    points: int


def fit_exponent(
    sizes: Float64[np.ndarray, " n"],
    costs: Float64[np.ndarray, " n"],
    groups: Int64[np.ndarray, " n"] | None = None,
    *,
    confidence: float = 0.95,
) -> Exponent:
    """Fits log cost = log constant + exponent · log size.

    Args:
        sizes: positive.
        costs: positive, one for each size.
        groups: a number for each pair; each group has a constant of its own, and all have the same exponent. None = one
            group.
        confidence: of the interval.

    Raises:
        InputError: fewer than three pairs more than there are constants, sizes that are all alike, or numbers that are
            not positive.
    """
    from scipy.stats import t

    x, y = sizes, costs
    if not ((x > 0) & (y > 0) & np.isfinite(x) & np.isfinite(y)).all():
        raise InputError("fit_exponent: expected positive sizes and costs")
    labels = np.zeros(len(x), np.int64) if groups is None else np.unique(groups, return_inverse=True)[1]
    free = len(x) - (int(labels.max(initial=0)) + 1) - 1
    log_x, log_y = np.log(x), np.log(y)
    centered_x, centered_y = _about_means(log_x, labels), _about_means(log_y, labels)
    moment = float((centered_x**2).sum())
    if free < 1 or not moment > 1e-12:
        raise InputError(f"fit_exponent: expected three different sizes or more, got {np.unique(sizes).tolist()}")
    value = float((centered_x * centered_y).sum() / moment)
    residuals = centered_y - value * centered_x
    half = float(t.ppf((1 + confidence) / 2, free)) * float(np.sqrt((residuals**2).sum() / free / moment))
    return Exponent(
        value=value,
        low=value - half,
        high=value + half,
        constant=float(np.exp(log_y.mean() - value * log_x.mean())),
        points=len(x),
    )


def _about_means(values: Float64[np.ndarray, " n"], labels: Int64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    sums = np.bincount(labels, values)
    return np.asarray(values - (sums / np.bincount(labels))[labels])
