"""Settings: options with their limits, knobs that trade cost for accuracy, and differences between settings."""

import operator
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cache
from math import isfinite
from typing import Any, Literal, TypeVar, get_args, get_origin

from gsencoder.core.errors import InputError

LIMITS: Mapping[str, tuple[Callable[[Any, Any], bool], str]] = {
    "ge": (operator.ge, "{} or more"),
    "gt": (operator.gt, "above {}"),
    "le": (operator.le, "at most {}"),
    "lt": (operator.lt, "below {}"),
}
"""Limits of a number, by their names in the metadata of a field."""


def option(default: Any, help: str, **metadata: Any) -> Any:
    """A field of settings with its meaning and its limits, which `check_limits` checks.

    Args:
        metadata: limits `ge`, `gt`, `le`, `lt` of a number, or of each number of a tuple; `one`, what a tuple holds at
            most one of; and what the command line knows (`gsencoder.app.options`).
    """
    return field(default=default, metadata={"help": help, **metadata})


class CheckedConfig:
    """Settings whose values `check_limits` checks when they are made."""

    __slots__ = ()

    def __post_init__(self) -> None:
        check_limits(self)


@cache
def _words(cls: type) -> Mapping[str, tuple[Any, ...]]:
    """The words that fields of a Literal type take."""
    hints = typing.get_type_hints(cls)
    return {name: get_args(hint) for name, hint in hints.items() if get_origin(hint) is Literal}


def check_limits(settings: Any) -> None:
    """Checks the values of a settings dataclass against the limits and words of its fields; None is within all."""
    for name, words in _words(type(settings)).items():  # type: ignore[arg-type]
        if (value := getattr(settings, name)) not in words:
            *others, last = map(str, words)
            raise InputError(f"{name}: expected {', '.join(others)}{' or ' if others else ''}{last}, got {value!r}")
    for item in fields(settings):
        value = getattr(settings, item.name)
        limits = {name: item.metadata[name] for name in LIMITS if name in item.metadata}
        if "one" in item.metadata and len(value) > 1:
            raise InputError(f"{item.name}: expected one {item.metadata['one']}, got {len(value)}")
        numbers = value if isinstance(value, tuple) else () if value is None else (value,)
        if limits and not all(
            isfinite(number) and all(LIMITS[name][0](number, limit) for name, limit in limits.items())
            for number in numbers
        ):
            expected = " and ".join(LIMITS[name][1].format(f"{limit:,}") for name, limit in limits.items())
            expected = expected.replace(" or more and at most ", " to ")
            got = list(value) if isinstance(value, tuple) else value
            raise InputError(f"{item.name}: expected {expected}, got {got}")


Settings = TypeVar("Settings")


@dataclass(frozen=True, slots=True, kw_only=True)
class Knob:
    """One knob of a stage.

    Attributes:
        name: short, unique within the stage; it stands in tables and options.
        key: where it lies in the stage's settings, with dots between sections ("blend.rays_per_patch").
        values: worth trying, in any order; the default need not be among them.
        exact: the value at which it costs no accuracy; None where there is no such value.
        needs: values of other knobs, by name, without which it has no effect; it is tried with these.
    """

    name: str
    key: str
    values: tuple[Any, ...]
    exact: Any = None
    needs: Mapping[str, Any] = field(default_factory=dict)


def value_at(settings: object, key: str) -> Any:
    """The value of a key with dots in nested settings."""
    for name in key.split("."):
        settings = getattr(settings, name)
    return settings


def with_values(settings: Settings, values: Mapping[str, Any]) -> Settings:
    """The settings with other values, by key with dots between sections; those of one section change together, so that
    it checks them together."""
    assert is_dataclass(settings)
    assert not isinstance(settings, type)
    names = {item.name for item in fields(settings)}
    sections: dict[str, dict[str, Any]] = {}
    direct: dict[str, Any] = {}
    for key, value in values.items():
        name, _, rest = key.partition(".")
        if name not in names:
            raise InputError(f"{key}: no such setting of {type(settings).__name__}; it has {', '.join(sorted(names))}")
        if rest:
            sections.setdefault(name, {})[rest] = value
        else:
            direct[name] = value
    for name, inner in sections.items():
        direct[name] = with_values(direct.get(name, getattr(settings, name)), inner)
    return typing.cast(Settings, replace(settings, **direct))


def with_knobs(settings: Settings, knobs: Sequence[Knob], values: Mapping[str, Any]) -> Settings:
    """The settings with values of knobs, by the knobs' names."""
    by_name = {knob.name: knob for knob in knobs}
    for name in values:
        if name not in by_name:
            raise InputError(f"{name}: no such knob; expected one of {', '.join(by_name)}")
    try:
        return with_values(settings, {by_name[name].key: value for name, value in values.items()})
    except InputError as error:
        raise InputError(f"{describe_values(values)}: {error}") from error


def exact_settings(settings: Settings, knobs: Sequence[Knob]) -> Settings:
    """The settings with every knob that has an exact value at it."""
    return with_values(settings, {knob.key: knob.exact for knob in knobs if knob.exact is not None})


def describe_values(values: Mapping[str, Any]) -> str:
    """Values of knobs as one line, such as `views=8, rays=16`; `defaults` where there are none."""
    return ", ".join(f"{name}={format_value(value)}" for name, value in values.items()) or "defaults"


def format_value(value: Any) -> str:
    """A value as it is written in tables and options."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return f"{value:.6g}"
    return str(value) if value not in ("", None) else "none"


def changed_knobs(base: object, knobs: Iterable[Knob], values: Mapping[str, Any]) -> dict[str, Any]:
    """The values that differ from those of the base settings, in the order of the knobs."""
    return {
        knob.name: values[knob.name]
        for knob in knobs
        if knob.name in values and values[knob.name] != value_at(base, knob.key)
    }


def read_value(settings: object, knob: Knob, text: str) -> Any:
    """A value of a knob from text, of the type that the settings declare."""
    *sections, name = knob.key.split(".")
    owner = value_at(settings, ".".join(sections)) if sections else settings
    annotation = typing.get_type_hints(type(owner))[name]
    kinds = [kind for kind in get_args(annotation) or (annotation,) if kind is not type(None)]
    if get_origin(annotation) is Literal:
        if text in get_args(annotation):
            return text
        raise InputError(f"{knob.name}: expected one of {', '.join(map(str, get_args(annotation)))}, got {text!r}")
    if bool in kinds and text in ("true", "false"):
        return text == "true"
    for kind in (int, float):
        if kind in kinds:
            try:
                return kind(text)
            except ValueError:
                continue
    if str in kinds:
        return "" if text == "none" else text
    names = {int: "a whole number", float: "a number", bool: "true or false"}
    expected = " or ".join(names.get(kind, str(kind)) for kind in kinds)
    raise InputError(f"{knob.name}: expected {expected}, got {text!r}")


def first_difference(saved: Mapping[str, Any], current: Mapping[str, Any], prefix: str = "") -> str:
    """Describes the first setting in which a saved run and the current one differ."""
    for key in sorted({*saved, *current}):
        old, new = saved.get(key), current.get(key)
        if isinstance(old, dict) and isinstance(new, dict) and old != new:
            return first_difference(old, new, f"{prefix}{key}.")
        if old != new:
            return f"{prefix}{key}={old}, and this run asks {prefix}{key}={new}"
    return "other settings"
