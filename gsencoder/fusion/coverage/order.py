"""An order of views, in which each lowers a predicted error most once those before it are taken."""

from collections.abc import Sequence
from typing import no_type_check

import numpy as np
from jaxtyping import Float32, Int64

from gsencoder.core.process import kernel


def view_order(
    weights: Float32[np.ndarray, "V n"], singles: int, scatter: float, first: Sequence[int] = ()
) -> Int64[np.ndarray, " V"]:
    """All views, each the one that lowers the predicted error most once those before it are taken.

    Args:
        weights: of the exact settings.
        singles: how many Gaussians at first are single ones; those and the groups count as much as each other.
        scatter: ρ.
        first: views that are taken before any other.
    """
    n = weights.shape[1]
    importance = np.full(n, 1 / max(singles, 1))
    importance[singles:] = 1 / max(n - singles, 1)
    return np.asarray(_greedy(weights, importance, scatter, np.asarray(first, np.int64)))


@kernel
@no_type_check
def _gain(w, importance, scatter, all_sum, all_squares, chosen_sum, chosen_squares):
    gain = 0.0
    for g in range(len(w)):
        if w[g] <= 0:
            continue
        x = np.float64(w[g])
        total, squares = all_sum[g], all_squares[g]
        s, q = chosen_sum[g], chosen_squares[g]
        before = 1.0
        if s > 0:
            before = min(1.0, scatter * max(q * (1 / (s * s) - 2 / (s * total)) + squares / (total * total), 0.0))
        s, q = s + x, q + x * x
        after = min(1.0, scatter * max(q * (1 / (s * s) - 2 / (s * total)) + squares / (total * total), 0.0))
        gain += importance[g] * (before - after)
    return gain


@kernel
@no_type_check
def _greedy(weights, importance, scatter, first):
    count, n = weights.shape
    all_sum, all_squares = np.zeros(n), np.zeros(n)
    for v in range(count):
        for g in range(n):
            x = np.float64(weights[v, g])
            all_sum[g] += x
            all_squares[g] += x * x
    chosen_sum, chosen_squares = np.zeros(n), np.zeros(n)
    order, is_chosen, bounds = np.empty(count, np.int64), np.zeros(count, np.bool_), np.full(count, np.inf)
    for step in range(count):
        best = -1
        if step < len(first):
            best = first[step]
        else:
            fresh = np.zeros(count, np.bool_)
            while True:
                # Gains shrink as views are taken, so that an old one is a bound.
                best = -1
                for v in range(count):
                    if not is_chosen[v] and (best < 0 or bounds[v] > bounds[best]):
                        best = v
                if fresh[best]:
                    break
                bounds[best] = _gain(
                    weights[best], importance, scatter, all_sum, all_squares, chosen_sum, chosen_squares
                )
                fresh[best] = True
        order[step], is_chosen[best] = best, True
        for g in range(n):
            x = np.float64(weights[best, g])
            chosen_sum[g] += x
            chosen_squares[g] += x * x
    return order
