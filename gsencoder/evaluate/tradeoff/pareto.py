"""Pareto fronts: which points no other point beats, and the order in which points are given up."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64, Int64


def non_dominated_ranks(costs: Float64[np.ndarray, "n k"]) -> Int64[np.ndarray, " n"]:
    """The rank of each point: 0 for the front, 1 for the front of what is left without it, and so on.

    A point dominates another if it is no worse in every column and better in one. Less is better; NaN is worse than
    any number.
    """
    values = np.where(np.isnan(costs), np.inf, costs)
    no_worse = np.all(values[:, None] <= values[None], axis=2)
    better = np.any(values[:, None] < values[None], axis=2)
    dominates = np.asarray(no_worse & better)
    ranks = np.full(len(values), -1, np.int64)
    rank = 0
    while (ranks < 0).any():
        unranked = ranks < 0
        front = unranked & ~dominates[unranked].any(axis=0)
        ranks[front] = rank
        rank += 1
    return ranks


def crowding(costs: Float64[np.ndarray, "n k"]) -> Float64[np.ndarray, " n"]:
    """How alone each point stands among others (NSGA-II, Deb et al. 2002): the summed gaps to its neighbors in each
    column, as shares of the column's range; infinite at both ends."""
    distance = np.zeros(len(costs))
    for column in np.where(np.isfinite(costs), costs, np.nan).T:
        # Points that are alike in all columns must not all be taken for an end.
        order = np.argsort(column, kind="stable")
        ends = column[order]
        span = np.nanmax(ends, initial=-np.inf) - np.nanmin(ends, initial=np.inf)
        if not span > 0:
            continue
        distance[order[0]] = distance[order[-1]] = np.inf
        distance[order[1:-1]] += np.nan_to_num((ends[2:] - ends[:-2]) / span)
    return distance


def best_first(costs: Float64[np.ndarray, "n k"]) -> Int64[np.ndarray, " n"]:
    """Indices of points from the front backwards; within a front those that stand alone come first, and points that are
    alike in their order."""
    ranks = non_dominated_ranks(costs)
    spread = np.zeros(len(costs))
    for rank in range(int(ranks.max(initial=-1)) + 1):
        rows = np.flatnonzero(ranks == rank)
        spread[rows] = crowding(costs[rows])
    return np.lexsort((np.arange(len(costs)), -spread, ranks))


def on_front(costs: Sequence[Sequence[float]]) -> list[bool]:
    """Whether each point is on the front; less is better."""
    if not costs:
        return []
    return [bool(rank == 0) for rank in non_dominated_ranks(np.asarray(costs, np.float64))]
