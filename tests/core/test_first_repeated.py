"""The first value that is there twice."""

from collections import Counter

from hypothesis import given
from hypothesis import strategies as st

from gsencoder.core.arrays import first_repeated


def test_the_value_and_both_places_are_given() -> None:
    assert first_repeated(["a", "b", "c", "b", "a"]) == ("b", 1, 3)
    assert first_repeated([]) is first_repeated(["a"]) is None
    assert first_repeated(iter([None, 0, None])) == (None, 0, 2)


@given(st.lists(st.integers(0, 5)))
def test_there_is_one_exactly_where_a_value_is_counted_more_than_once(values: list[int]) -> None:
    repeated = first_repeated(values)
    assert (repeated is not None) == any(count > 1 for count in Counter(values).values())
    if repeated:
        value, first, second = repeated
        assert values[first] == values[second] == value
        assert len(set(values[:second])) == second
