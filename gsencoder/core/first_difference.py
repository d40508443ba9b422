"""The first setting in which two runs differ, for errors about files of a run with other settings."""

from collections.abc import Mapping
from typing import Any


def first_difference(saved: Mapping[str, Any], current: Mapping[str, Any], prefix: str = "") -> str:
    """Describes the first setting in which a saved run and the current one differ."""
    for key in sorted({*saved, *current}):
        old, new = saved.get(key), current.get(key)
        if isinstance(old, dict) and isinstance(new, dict) and old != new:
            return first_difference(old, new, f"{prefix}{key}.")
        if old != new:
            return f"{prefix}{key}={old}, and this run asks {prefix}{key}={new}"
    return "other settings"
