"""Settings of the commands: frozen dataclasses, into which command lines and YAML files are parsed and validated.

Each command owns a `@dataclass(frozen=True, slots=True, kw_only=True)` whose fields carry `metadata={"help": …}`;
that text is what `gsencoder COMMAND --help` shows. Further metadata: `required=True` (the command cannot run without
it), `metavar` (the word that stands for the value in the help), `secret=True` (the value is never shown or written),
`names=True` (a list of names, around which brackets may stand) and `like_group=True` (a choice of other commands has
the option's name). A field whose type is a dataclass is a section, and its
options are written `section.name=value`. A field whose type is a union of dataclasses is a choice, written
`section=member`: every member has a field `name: Literal["…"]`. `preset="NAME"` in the metadata of a section makes it a
choice too, between its default, which has that name, and the presets in `conf/SECTION/*.yaml`. A mapping from names to
such a union, with `several="SECTION"`, takes several members of that choice: `sections=member,NAME:member`, whose
options are `sections.NAME.option=value`.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any, ClassVar, TypeVar, get_args, get_origin

from gsencoder.app.settings.options import (
    allows_none,
    field_types,
    kind_of,
    mapped_classes,
    member_name,
    near,
    options_by_key,
    options_of,
    section_classes,
    split_list,
    union_members,
    wrong_value,
)
from gsencoder.app.settings.presets import DEFAULT_PRESET, Preset
from gsencoder.core.errors import InputError
from gsencoder.core.settings import REMOVED_OPTIONS, check_removed_option

T = TypeVar("T")

NOT_FINITE = "nan is not a finite number"

HIDDEN = "(not shown)"
"""Shown and written in place of the value of a secret option."""


@dataclass(frozen=True, kw_only=True)
class CommonConfig:
    """The options of every command. Without slots, so that a command can also inherit the settings of its stage."""

    has_experiments: ClassVar[bool] = False
    """Whether `experiment=NAME` takes options of several sections from `conf/experiment/NAME.yaml`."""

    out: Path | None = field(default=None, metadata={"help": "where the results go", "metavar": "PATH"})
    overwrite: bool = field(default=False, metadata={"help": "replace what an earlier run wrote to out="})
    preset: Preset = field(
        default=DEFAULT_PRESET,
        metadata={
            "like_group": True,
            "help": "options that trade cost for accuracy, set together where settings are composed; the command line "
            "and experiments go over it",
        },
    )
    quiet: bool = field(default=False, metadata={"help": "print nothing but warnings and errors"})


def _strict(target: type, accepted: tuple[type, ...]) -> Any:
    """A dacite hook that converts values of the accepted types to `target`, and refuses all others."""
    from dacite.exceptions import WrongTypeError

    def convert(value: Any) -> Any:
        # NaN passes here, for `typed` to say what the class expects of it.
        if not isinstance(value, accepted) or isinstance(value, bool):
            raise WrongTypeError(field_type=target, value=value)
        return target(value)

    return convert


def _prepare(value: Any, annotation: Any) -> Any:
    """Splits text of lists, makes a list of a single value where one is expected, and None of an empty path."""
    if value is None:
        return None
    if isinstance(value, str) and kind_of(annotation) == "list":
        return split_list(value)
    members = union_members(annotation)
    if all(get_origin(member) is tuple for member in members) and not isinstance(value, (list, tuple, dict)):
        return (value,)
    return None if value == "" and Path in members and allows_none(annotation) else value


def _section(annotation: Any, value: Any, key: str) -> Any:
    if mapped_classes(annotation):
        if not isinstance(value, Mapping):
            raise InputError(f"{key}: expected settings by name ({key}.NAME.OPTION=…), got {value!r}")
        return {str(name): _section(get_args(annotation)[1], each, f"{key}.{name}") for name, each in value.items()}
    classes = section_classes(annotation)
    if not classes or (value is None and allows_none(annotation)):
        return value
    if not isinstance(value, Mapping):
        raise InputError(f"{key}: is a section with options of its own ({key}.NAME=…), got {value!r}")
    if len(classes) == 1:
        return typed(classes[0], value, key + ".")
    by_name = {member_name(section): section for section in classes}
    name = str(value.get("name"))
    if name not in by_name:
        raise InputError(f"{key}.name: expected one of {', '.join(by_name)}, got {name!r}{near(name, by_name)}")
    return typed(by_name[name], value, key + ".")


def typed(cls: type[T], data: Mapping[str, Any], prefix: str = "") -> T:
    """Builds settings from plain dicts, lists and scalars; missing options have their defaults.

    Numbers must be numbers, not text, and NaN is refused, with what the class says of its range.

    Raises:
        InputError: an unknown key, a wrong type, or a value that the class refuses; the full key is named.
    """
    import dacite
    from dacite.exceptions import DaciteFieldError

    types = field_types(cls)
    values: dict[str, Any] = {}
    for name, value in data.items():
        if name not in types and f"{prefix}{name}" in REMOVED_OPTIONS:
            check_removed_option(f"{prefix}{name}", value)
            continue
        if name not in types:
            options = [prefix + option for option in types]
            raise InputError(f"{prefix}{name}: no such option{near(f'{prefix}{name}', options)}")
        values[name] = _prepare(_section(types[name], value, prefix + name), types[name])
    hooks: dict[Any, Any] = {
        int: _strict(int, (int,)),
        float: _strict(float, (int, float)),
        Path: lambda value: Path(value) if isinstance(value, str) and value else value,
    }
    nan = next((name for name, value in values.items() if _has_nan(value)), "")
    try:
        built = dacite.from_dict(cls, values, dacite.Config(strict=True, cast=[tuple], type_hooks=hooks))
    except DaciteFieldError as error:
        name = str(error.field_path).partition(".")[0]
        raise InputError(wrong_value(options_by_key(cls, prefix)[prefix + name], data.get(name))) from error
    except InputError as error:
        unexplained = nan and str(error).startswith(f"{nan}:") and NOT_FINITE not in str(error)
        raise InputError(_named(str(error), prefix, types) + (f"; {NOT_FINITE}" if unexplained else "")) from error
    except (ValueError, OverflowError):
        # A class that counts with a number before it looks at it.
        if not nan:
            raise
    if nan:
        raise InputError(f"{wrong_value(options_by_key(cls, prefix)[prefix + nan], data[nan])}; {NOT_FINITE}")
    return built


def _has_nan(value: Any) -> bool:
    """Whether a value, or one of a list, is the number NaN."""
    if isinstance(value, (list, tuple)):
        return any(map(_has_nan, value))
    return isinstance(value, float) and value != value


def _named(message: str, prefix: str, names: Iterable[str]) -> str:
    """The message of an error of a settings class, with the name of the section before that of each field."""
    head, _, problem = message.partition(":")
    named = re.split(r"(, | and )", head)
    if not prefix or any(name.split("[")[0] not in names for name in named[::2]):
        return f"{prefix.rstrip('.')}: {message}" if prefix else message
    return f"{''.join(prefix + word if index % 2 == 0 else word for index, word in enumerate(named))}:{problem}"


def check_required(cls: type, config: object) -> None:
    """Raises an InputError about the first required option that is empty."""
    for option in options_of(cls):
        if option.required and not option.member:
            value: Any = config
            for name in option.key.split("."):
                value = getattr(value, name)
            if value is None or value == "" or value == ():
                if option.key == "paths":
                    raise InputError(f"{option.metavar or 'PATH'} is missing: {option.help}")
                raise InputError(f"{option.key}= is missing: {option.help}")


def settings(config: object) -> dict[str, Any]:
    """The settings as plain values for YAML and JSON; values of secret options are hidden."""

    def plain(value: Any) -> Any:
        if is_dataclass(value) and not isinstance(value, type):
            return {
                item.name: HIDDEN
                if item.metadata.get("secret") and getattr(value, item.name)
                else plain(getattr(value, item.name))
                for item in fields(value)
            }
        if isinstance(value, (list, tuple)):
            return [plain(item) for item in value]
        if isinstance(value, Mapping):
            return {str(key): plain(item) for key, item in value.items()}
        return str(value) if isinstance(value, Path) else value

    return plain(config)
