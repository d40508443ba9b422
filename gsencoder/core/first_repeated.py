"""The first value of a sequence that is there twice."""

from collections.abc import Hashable, Iterable
from typing import TypeVar

Value = TypeVar("Value", bound=Hashable)


def first_repeated(values: Iterable[Value]) -> tuple[Value, int, int] | None:
    """The first value that was there before, with the index where it was first and the index where it is again.

    None if each value is there once.
    """
    first: dict[Value, int] = {}
    for index, value in enumerate(values):
        if value in first:
            return value, first[value], index
        first[value] = index
    return None
