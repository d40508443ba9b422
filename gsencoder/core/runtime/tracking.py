"""What long loops show their progress through, and what stands in its place where nobody watches."""

from collections.abc import Callable, Iterable
from typing import Any

Track = Callable[[Iterable[Any], str], Iterable[Any]]
"""Gives the items of a loop one by one; the text says what the loop does."""


def untracked(items: Iterable[Any], label: str) -> Iterable[Any]:  # noqa: ARG001
    """The items, silently."""
    return items
