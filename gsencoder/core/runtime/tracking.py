"""The type of functions that show the progress of a loop, and one that shows nothing."""

from collections.abc import Callable, Iterable
from typing import Any

Track = Callable[[Iterable[Any], str], Iterable[Any]]
"""Yields the items of a loop and shows its progress; the text says what the loop does."""


def untracked(items: Iterable[Any], label: str) -> Iterable[Any]:  # noqa: ARG001
    """Yields the items and shows nothing."""
    return items
