"""Laws of Pareto fronts, by their definition and on all small sets of points."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsencoder.evaluate.tradeoff.sweep import best_first, crowding, non_dominated_ranks, on_front

points = st.integers(1, 12).flatmap(
    lambda n: st.lists(st.tuples(st.integers(0, 4), st.integers(0, 4)), min_size=n, max_size=n)
)


def dominates(a: tuple[int, ...], b: tuple[int, ...]) -> bool:
    return all(x <= y for x, y in zip(a, b, strict=True)) and a != b


@given(points)
@settings(deadline=None, max_examples=60)
def test_a_rank_is_the_longest_chain_of_points_that_dominate_each_other(given: list[tuple[int, int]]) -> None:
    ranks = non_dominated_ranks(np.array(given, np.float64))

    def chain(index: int) -> int:
        above = [other for other in range(len(given)) if dominates(given[other], given[index])]
        return 1 + max(map(chain, above)) if above else 0

    assert ranks.tolist() == [chain(index) for index in range(len(given))]
    assert on_front([tuple(map(float, each)) for each in given]) == [
        not any(dominates(other, each) for other in given) for each in given
    ]


@given(points)
@settings(deadline=None, max_examples=60)
def test_the_order_follows_the_ranks_and_does_not_depend_on_units(given: list[tuple[int, int]]) -> None:
    costs = np.array(given, np.float64)
    order = best_first(costs)
    assert sorted(order) == list(range(len(given)))
    assert (np.diff(non_dominated_ranks(costs)[order]) >= 0).all()
    assert best_first(costs * [1e-3, 64.0]).tolist() == order.tolist()


def test_points_that_are_alike_stand_or_fall_together() -> None:
    for count in range(1, 5):
        assert on_front([(1.0, 2.0)] * count) == [True] * count
    assert on_front([]) == []


def test_what_was_not_measured_is_worse_than_anything_that_was() -> None:
    assert on_front([(1.0, np.nan), (1.0, 5.0)]) == [False, True]
    assert on_front([(0.5, np.nan), (1.0, 5.0)]) == [True, True]


def test_the_ends_of_a_front_stand_alone_and_a_crowd_does_not() -> None:
    line = np.array([(0, 10), (1, 9), (1.1, 8.9), (1.2, 8.8), (10, 0)], np.float64)
    alone = crowding(line)
    assert np.isinf(alone[[0, 4]]).all()
    assert alone[2] == min(alone)
    assert set(best_first(line)[:2].tolist()) == {0, 4}


@pytest.mark.parametrize("columns", [1, 2, 3])
def test_of_all_corners_of_a_cube_the_origin_alone_is_on_the_front(columns: int) -> None:
    corners = list(itertools.product((0, 1), repeat=columns))
    assert non_dominated_ranks(np.array(corners, np.float64)).tolist() == [sum(corner) for corner in corners]
