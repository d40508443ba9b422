"""The options of a command: a frozen dataclass, into which command lines and YAML files are parsed and validated.

A field is made by `option`, whose metadata hold its meaning and its limits. Further metadata: `required=True` (the
command cannot run without it), `metavar` (the word that stands for the value in the help), `secret=True` (the value is
never shown or written), `names=True` (a list of names, around which brackets may stand) and `like_group=True` (a choice
of other commands has the option's name).

A field whose type is a dataclass is a section, and its options are written `section.name=value`. A field whose type is
a union of dataclasses is a choice, written `section=member`: every member has a field `name: Literal["…"]`.
`preset="NAME"` in the metadata of a section makes it a choice too, between its default, which has that name, and the
files `conf/SECTION/*.yaml`. A mapping from names to such a union, with `several="SECTION"`, takes several members of
that choice: `sections=member,NAME:member`, whose options are `sections.NAME.option=value`.
"""

import difflib
import re
import types
import typing
from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, Literal, TypeVar, Union, cast, get_args, get_origin

from gsencoder.core.errors import InputError
from gsencoder.core.settings import CheckedConfig, option, value_at

Kind = Literal["text", "list", "value"]
Function = TypeVar("Function", bound=Callable[..., Any])


def cached(function: Function) -> Function:
    """`functools.cache` that keeps the signature: mypy does not see that the class of a dataclass can be hashed."""
    return cast(Function, cache(function))


@dataclass(frozen=True, slots=True, kw_only=True)
class Option:
    """An option of a command.

    Attributes:
        key: its full name, with dots between sections.
        member: the member of a choice that it belongs to, such as "teacher=onnx"; empty if it always applies.
        metadata: of its field; see the head of this module.
    """

    key: str
    annotation: Any
    default: Any
    member: str
    metadata: Mapping[str, Any]

    @property
    def help(self) -> str:
        return str(self.metadata.get("help", ""))

    @property
    def metavar(self) -> str:
        return str(self.metadata.get("metavar", ""))

    @property
    def secret(self) -> bool:
        return bool(self.metadata.get("secret"))

    @property
    def several(self) -> str:
        """The choice of which it takes several members, by name; empty for other options."""
        return str(self.metadata.get("several", ""))

    @property
    def names(self) -> bool:
        """Whether it is a list of words, around which users of Hydra may write brackets."""
        items = list_items(self.annotation)
        return bool(self.metadata.get("names")) or (len(items) == 1 and _is_word(items[0]))

    @property
    def kind(self) -> Kind:
        """Whether its value is taken literally ("text", "list" of text) or parsed by Hydra ("value")."""
        return kind_of(self.annotation)

    @property
    def hydra_key(self) -> str:
        """Its name in the settings that Hydra composes."""
        return self.key + LIKE_GROUP if self.metadata.get("like_group") else self.key


LIKE_GROUP = "__option"
"""What stands after the name of an option in Hydra's settings where a choice of other commands has that name."""


def without_value(word: str) -> str:
    """A word that is not an option, for an error message, without its value, which may be a misspelled option's
    secret."""
    key, equals, _ = word.partition("=")
    return key[:200] + ("=…" if equals else "")


def near(word: str, names: Iterable[str]) -> str:
    """`; did you mean …?` if the last component of a known name is close to that of `word`, else nothing."""

    def distance(name: str) -> float:
        return -difflib.SequenceMatcher(None, word.rpartition(".")[2], name.rpartition(".")[2]).ratio()

    close = sorted((distance(name), name) for name in set(names) if distance(name) <= -0.6)
    best = [name for score, name in close if score <= close[0][0] + 0.15][:3]
    return f"; did you mean {' or '.join(best)}?" if best else ""


def union_members(annotation: Any) -> tuple[Any, ...]:
    """The types of a union except None, or the one type."""
    if get_origin(annotation) in (Union, types.UnionType):
        return tuple(member for member in get_args(annotation) if member is not type(None))
    return (annotation,)


def _is_word(annotation: Any) -> bool:
    return get_origin(annotation) is Literal and all(isinstance(value, str) for value in get_args(annotation))


def list_items(annotation: Any) -> tuple[Any, ...]:
    """The type of the items of a list of any length, alone in a tuple; empty for other types."""
    items = get_args(annotation)
    return items[:1] if get_origin(annotation) is tuple and items[1:] == (Ellipsis,) else ()


def kind_of(annotation: Any) -> Kind:
    """The kind of an option of a type; see `Option.kind`."""
    members = union_members(annotation)
    if all(member in (str, Path) for member in members):
        return "text"
    items = list_items(members[0]) if len(members) == 1 else ()
    return (
        "list" if get_origin(annotation) is Mapping or any(i in (str, Path) or _is_word(i) for i in items) else "value"
    )


def describe(annotation: Any) -> str:
    """Describes a type for error messages."""
    names = {bool: "true or false", int: "a whole number", float: "a number", str: "text", Path: "a path"}
    members = union_members(annotation)
    words = []
    for member in members:
        items = get_args(member)
        if get_origin(member) is Literal:
            words.append(f"{'one of ' if len(items) > 1 else ''}{', '.join(map(str, items))}")
        elif list_items(member):
            words.append(f"a list, each {describe(items[0])}")
        elif get_origin(member) is Mapping:
            words.append("a list of names")
        elif get_origin(member) is tuple:
            words.append(f"a list of {len(items)} ({', '.join(describe(item) for item in items)})")
        else:
            words.append(names.get(member, getattr(member, "__name__", str(member))))
    if type(None) in get_args(annotation):
        words.append("null")
    return " or ".join(words)


def split_list(text: str) -> tuple[str, ...]:
    """Splits a list of text: commas separate items, `\\,` is a comma; the empty text is the empty list."""
    return tuple(item.replace("\\,", ",") for item in re.split(r"(?<!\\),", text)) if text else ()


def join_list(items: Iterable[str]) -> str:
    """The text that `split_list` splits into these items."""
    return ",".join(item.replace(",", "\\,") for item in items)


@cached
def field_types(cls: type) -> Mapping[str, Any]:
    """The resolved types of a dataclass's fields."""
    hints = typing.get_type_hints(cls)
    return {item.name: hints[item.name] for item in fields(cls)}


def section_classes(annotation: Any) -> tuple[type, ...]:
    """The dataclasses of a section; empty for a plain option."""
    return tuple(member for member in union_members(annotation) if is_dataclass(member) and isinstance(member, type))


def mapped_classes(annotation: Any) -> tuple[type, ...]:
    """The dataclasses of the values of a mapping by name; empty for other options."""
    return section_classes(get_args(annotation)[1]) if get_origin(annotation) is Mapping else ()


def member_name(member: type) -> str:
    """The name of a member of a choice: the literal of its field `name`."""
    return str(get_args(field_types(member)["name"])[0])


def _default(item: Any) -> Any:
    if item.default is not MISSING:
        return item.default
    return item.default_factory() if item.default_factory is not MISSING else None


def options_of(cls: type, prefix: str = "", member: str = "", defaults: Any = None) -> list[Option]:
    """Every option of a settings class, sections included, in order of declaration; `defaults` is an instance whose
    values are the defaults."""
    options: list[Option] = []
    annotations = field_types(cls)
    for item in fields(cls):
        key, annotation = prefix + item.name, annotations[item.name]
        default = _default(item) if defaults is None else getattr(defaults, item.name)
        classes = section_classes(annotation)
        if classes:
            for section in classes:
                owner = f"{key.replace('.', '/')}={member_name(section)}" if len(classes) > 1 else member
                options += options_of(section, key + ".", owner, default if isinstance(default, section) else None)
        elif not (item.name == "name" and get_origin(annotation) is Literal and len(get_args(annotation)) == 1):
            options.append(
                Option(key=key, annotation=annotation, default=default, member=member, metadata=item.metadata)
            )
    return options


@cached
def options_by_key(cls: type, prefix: str = "") -> Mapping[str, Option]:
    """The options of a class by full key; where members of a choice share a key, the option of the first."""
    options: dict[str, Option] = {}
    for each in options_of(cls, prefix):
        options.setdefault(each.key, each)
    return options


def wrong_value(option: Option, value: Any) -> str:
    """The message for a value of the wrong type."""
    if isinstance(value, (list, tuple)) and option.kind == "list":
        value = join_list(map(str, value))
    members = union_members(option.annotation)
    words = [each for member in members for each in (member, *list_items(member)) if get_origin(each) is Literal]
    hint = near(str(value), [str(word) for each in words for word in get_args(each)])
    is_list = any(get_origin(member) is tuple for member in members)
    if is_list and option.kind == "value" and isinstance(value, str) and "," in value:
        hint = f"; a list of numbers stands in brackets: {option.key}=[{value}]"
    meaning = f" ({option.help})" if option.help and not hint else ""
    return f"{option.key}: expected {describe(option.annotation)}, got {value!r}{hint}{meaning}"


Preset = Literal["fast", "balanced", "exact"]
PRESET = "preset"
DEFAULT_PRESET: Preset = "balanced"
PRESETS: Mapping[str, Mapping[str, Any]] = {
    "fast": {
        "fusion.view_share": 0.5,
        "fusion.blend.stop_transmittance": 0.1,
        "encode.halo": 0.0,
        "choose.candidates": 16,
        "budget.minutes": 5.0,
    },
    "balanced": {},
    "exact": {
        "fusion.blend.rays_per_patch": 196,
        "fusion.blend.stop_transmittance": 1e-6,
        "fusion.energy": 1.0,
        "fusion.max_rank": 0,
        "prepare.fusion.blend.rays_per_patch": 196,
        "prepare.fusion.blend.stop_transmittance": 1e-6,
        "encode.precision": "float32",
        "encode.halo": 1.28,
        "choose.candidates": 64,
        "budget.minutes": 0.0,
        "optimize.steps": 3000,
    },
}
"""What `preset=` sets, by full key, in every command that has the option; experiments and the command line go over it.
The values are those of measurements ("Trade-off" in docs/measurements.md)."""


def preset_values(cls: type, preset: str) -> dict[str, Any]:
    """What a preset sets in a command, by full key."""
    return {key: value for key, value in PRESETS[preset].items() if key in options_by_key(cls)}


T = TypeVar("T")

HIDDEN = "(not shown)"
"""Shown and written in place of the value of a secret option."""


@dataclass(frozen=True, kw_only=True)
class CommonConfig(CheckedConfig):
    """The options of every command. Without slots, so that a command can also inherit the settings of its stage."""

    has_experiments: ClassVar[bool] = False
    """Whether `experiment=NAME` takes options of several sections from `conf/experiment/NAME.yaml`."""

    out: Path | None = option(None, "where the results go", metavar="PATH")
    overwrite: bool = option(False, "replace what an earlier run wrote to out=")
    preset: Preset = option(
        DEFAULT_PRESET,
        "options that trade cost for accuracy, set together where settings are composed; the command line "
        "and experiments go over it",
        like_group=True,
    )
    quiet: bool = option(False, "print nothing but warnings and errors")


@dataclass(frozen=True, kw_only=True)
class SharedScenesConfig(CommonConfig):
    """The options of commands whose scenes several processes may share."""

    worker: int = option(
        0, "number of this process among several that share the scenes: -m worker=0,1,2 starts three", ge=0
    )


@dataclass(frozen=True, kw_only=True)
class FolderConfig(CommonConfig):
    """The options of commands that read one folder of features."""

    paths: tuple[str, ...] = option(
        (),
        "a folder written by fuse, encode, pack or memory",
        metavar="FEATURES",
        required=True,
        one="folder of features",
    )
    space: str = option("", "name of the feature space, if the folder holds several")


@dataclass(frozen=True, kw_only=True)
class FeaturesConfig(FolderConfig):
    """The options of commands that compare features with words."""

    words: str = option("", "text table; empty = the one in the folder of the features")
    head: str = option(
        "",
        "adapter head whose outputs are compared with the words of text=, such as siglip; empty = the features "
        "themselves are",
    )


@dataclass(frozen=True, kw_only=True)
class QueriesConfig(FeaturesConfig):
    """The options of commands that look words up in features."""

    query: tuple[str, ...] = option((), "one or several words, separated by commas")
    queries: str = option("", "a text file with one query a line")


def _number(target: type, accepted: tuple[type, ...]) -> Any:
    """A dacite hook that converts numbers of the accepted types to `target`, and refuses all else, and NaN."""
    from dacite.exceptions import WrongTypeError

    def convert(value: Any) -> Any:
        if not isinstance(value, accepted) or isinstance(value, bool) or value != value:
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
    return None if value == "" and Path in members and type(None) in get_args(annotation) else value


def _section(annotation: Any, value: Any, key: str) -> Any:
    if mapped_classes(annotation):
        if not isinstance(value, Mapping):
            raise InputError(f"{key}: expected settings by name ({key}.NAME.OPTION=…), got {value!r}")
        return {str(name): _section(get_args(annotation)[1], each, f"{key}.{name}") for name, each in value.items()}
    classes = section_classes(annotation)
    if not classes or (value is None and type(None) in get_args(annotation)):
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
    """Builds settings from plain dicts, lists and scalars; missing options have their defaults."""
    import dacite
    from dacite.exceptions import DaciteFieldError

    types = field_types(cls)
    values: dict[str, Any] = {}
    for name, value in data.items():
        if name not in types:
            raise InputError(f"{prefix}{name}: no such option{near(prefix + name, [prefix + each for each in types])}")
        values[name] = _prepare(_section(types[name], value, prefix + name), types[name])
    hooks: dict[Any, Any] = {
        int: _number(int, (int,)),
        float: _number(float, (int, float)),
        Path: lambda value: Path(value) if isinstance(value, str) and value else value,
    }
    try:
        return dacite.from_dict(cls, values, dacite.Config(strict=True, cast=[tuple], type_hooks=hooks))
    except DaciteFieldError as error:
        name = str(error.field_path).partition(".")[0]
        raise InputError(wrong_value(options_by_key(cls, prefix)[prefix + name], data.get(name))) from error
    except InputError as error:
        raise InputError(_named(str(error), prefix, types)) from error


def _named(message: str, prefix: str, names: Iterable[str]) -> str:
    """The message of an error of a settings class, with the name of the section before that of each field."""
    head, _, problem = message.partition(":")
    named = re.split(r"(, | and )", head)
    if not prefix or any(name.split("[")[0] not in names for name in named[::2]):
        return f"{prefix.rstrip('.')}: {message}" if prefix else message
    return f"{''.join(prefix + word if index % 2 == 0 else word for index, word in enumerate(named))}:{problem}"


def check_required(cls: type, config: object) -> None:
    """Raises an InputError about the first required option that is empty."""
    for each in options_of(cls):
        if each.metadata.get("required") and not each.member and value_at(config, each.key) in (None, "", ()):
            name = f"{each.metavar or 'PATH'}" if each.key == "paths" else f"{each.key}="
            raise InputError(f"{name} is missing: {each.help}")


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
