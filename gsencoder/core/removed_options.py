"""Options and values that earlier versions had: old command lines and unfinished runs are read through this table."""

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from gsencoder.core.errors import InputError


class Removed(NamedTuple):
    """A removed option.

    Attributes:
        default: its former default, which still describes what the code does.
        reason: why it was removed.
    """

    default: Any
    reason: str


REMOVED_OPTIONS: Mapping[str, Removed] = {
    "localize.margin": Removed(0.0, "margins made boxes worse: a tenth of a spacing costs 0.04 of mean IoU"),
    "dense.alike": Removed(0.6, "no measurement supports another correlation"),
    "dense.agree": Removed(0.02, "no measurement supports another tolerance of depths"),
    "dense.color": Removed(0.06, "no measurement supports another tolerance of colors"),
}
"""Removed options by their full name on the command line."""

REMOVED_VALUES: Mapping[str, str] = {
    "precision=int8_static": "it was slower and less accurate than int8_dynamic, which needs no scenes to calibrate on",
    "localize.mode=centred": "it is written centered",
}
"""Removed values of options that exist, as they were written on the command line, with the reason."""


def removed_option(key: str, options: Iterable[str]) -> str | None:
    """The full name of a removed option that `key` stands for, with or without its section; None if there is none.

    Args:
        key: as it was written.
        options: full names of the options of the command; only its sections are searched.
    """
    sections = {name.rpartition(".")[0] for name in options}
    for name in REMOVED_OPTIONS:
        section, _, last = name.rpartition(".")
        if section in sections and key in (name, last):
            return name
    return None


def check_removed_option(name: str, value: Any) -> None:
    """Accepts the former default of a removed option, since that is what the code does.

    Args:
        name: its full name.
        value: as a number, or as it was written.

    Raises:
        InputError: another value.
    """
    default, reason = REMOVED_OPTIONS[name]
    try:
        same = float(value) == default
    except (TypeError, ValueError):
        same = value == default
    if not same:
        raise InputError(f"{name}: this option was removed ({reason}); leave it out. The value is always {default}")


def without_removed_options(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Saved settings of an earlier version without the removed options that have their former default.

    Args:
        settings: nested dicts of JSON values.
        prefix: the section that they are.
    """
    current: dict[str, Any] = {}
    for key, value in settings.items():
        removed = REMOVED_OPTIONS.get(f"{prefix}{key}")
        if removed is None or value != removed.default:
            current[key] = without_removed_options(value, f"{key}.") if isinstance(value, dict) else value
    return current
