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
from gsencoder.core.settings import check_limits, option, shown_value, value_at

Kind = Literal["text", "list", "value"]
Function = TypeVar("Function", bound=Callable[..., Any])


def cached(function: Function) -> Function:
    """`functools.cache` that keeps the signature: mypy does not see that the class of a dataclass can be hashed."""
    return cast(Function, cache(function))


@dataclass(frozen=True, slots=True, kw_only=True)
class Option:
    """An option of a command, as declared by a dataclass.

    Attributes:
        key: its full name, with dots between sections.
        annotation: its type.
        default: its default.
        help: its meaning, one line.
        metavar: placeholder of its value in the help.
        required: whether the command can run without it.
        member: the member of a choice that it belongs to, such as "teacher=onnx"; empty if it always applies.
        kind: "text" and "list" (of text) are taken literally; "value" is parsed.
        secret: its value is never shown or written.
        several: the choice of which it takes several members, by name; empty for other options.
        names: it is a list of names, around which users of Hydra may write brackets.
        like_group: its name is that of a choice of other commands, for which Hydra would take it.
    """

    key: str
    annotation: Any
    default: Any
    help: str
    metavar: str
    required: bool
    member: str
    kind: Kind
    secret: bool = False
    several: str = ""
    names: bool = False
    like_group: bool = False

    @property
    def hydra_key(self) -> str:
        """Its name in the settings that Hydra composes."""
        return self.key + LIKE_GROUP if self.like_group else self.key


LIKE_GROUP = "__option"
"""What stands after the name of an option in Hydra's settings where a choice of other commands has that name."""
MAX_WORD = 200
"""Number of characters of a word of the command line that an error repeats."""


def without_value(word: str) -> str:
    """A word that is not an option, for an error message, without its value, which may be a misspelled option's
    secret."""
    key, equals, _ = word.partition("=")
    return key[:MAX_WORD] + ("=…" if equals else "")


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


def allows_none(annotation: Any) -> bool:
    """Whether a type is a union with None."""
    return get_origin(annotation) in (Union, types.UnionType) and type(None) in get_args(annotation)


def _is_word(annotation: Any) -> bool:
    return get_origin(annotation) is Literal and all(isinstance(value, str) for value in get_args(annotation))


def kind_of(annotation: Any) -> Kind:
    """Whether the value of an option is taken literally ("text", "list") or parsed by Hydra ("value")."""
    members = union_members(annotation)
    if all(member in (str, Path) for member in members):
        return "text"
    if get_origin(annotation) is Mapping:
        return "list"
    if len(members) == 1 and get_origin(members[0]) is tuple:
        items = get_args(members[0])
        if len(items) == 2 and items[1] is Ellipsis:
            return "list" if items[0] in (str, Path) or _is_word(items[0]) else "value"
    return "value"


def is_list_of_words(annotation: Any) -> bool:
    """Whether an option is a list of words from a closed set, without brackets, commas or blanks."""
    items = get_args(annotation)
    return get_origin(annotation) is tuple and len(items) == 2 and items[1] is Ellipsis and _is_word(items[0])


def describe(annotation: Any) -> str:
    """Describes a type for error messages."""
    names = {bool: "true or false", int: "a whole number", float: "a number", str: "text", Path: "a path"}
    members = union_members(annotation)
    words = []
    for member in members:
        items = get_args(member)
        if get_origin(member) is Literal:
            words.append(f"{'one of ' if len(items) > 1 else ''}{', '.join(map(str, items))}")
        elif get_origin(member) is tuple and len(items) == 2 and items[1] is Ellipsis:
            words.append(f"a list, each {describe(items[0])}")
        elif get_origin(member) is Mapping:
            words.append("a list of names")
        elif get_origin(member) is tuple:
            words.append(f"a list of {len(items)} ({', '.join(describe(item) for item in items)})")
        else:
            words.append(names.get(member, getattr(member, "__name__", str(member))))
    if allows_none(annotation):
        words.append("null")
    return " or ".join(words)


def split_list(text: str) -> tuple[str, ...]:
    """Splits a list of text: commas separate items, `\\,` is a comma, and a backslash elsewhere is literal.

    Before a comma, two backslashes are one (`\\\\,` is a backslash and a separator), so that every list can be written.
    Blanks belong to the items; the empty text is the empty list.
    """
    items, current, index = [], "", 0
    while index < len(text):
        run = len(text) - index - len(text[index:].lstrip("\\"))
        if text[index + run : index + run + 1] == ",":
            current += "\\" * (run // 2)
            if run % 2:
                current += ","
            else:
                items.append(current)
                current = ""
            index += run + 1
        else:
            step = max(run, 1)
            current += text[index : index + step]
            index += step
    return (*items, current) if text else ()


def join_list(items: Iterable[str]) -> str:
    """The text that `split_list` splits into these items (a single empty item cannot be written)."""
    parts = []
    for number, item in enumerate(items := tuple(items)):
        pieces = item.split(",")
        for index, piece in enumerate(pieces):
            if index < len(pieces) - 1 or number < len(items) - 1:
                piece += "\\" * (len(piece) - len(piece.rstrip("\\")))
            pieces[index] = piece
        parts.append("\\,".join(pieces))
    return ",".join(parts)


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
    """Every option of a settings class, sections included, in order of declaration.

    Args:
        member: the member of a choice that the class is.
        defaults: an instance whose values are the defaults, as those of a section are; None = those of the class.
    """
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
                Option(
                    key=key,
                    annotation=annotation,
                    default=default,
                    help=item.metadata.get("help", ""),
                    metavar=item.metadata.get("metavar", ""),
                    required=item.metadata.get("required", False),
                    member=member,
                    kind=kind_of(annotation),
                    secret=item.metadata.get("secret", False),
                    several=item.metadata.get("several", ""),
                    names=item.metadata.get("names", False) or is_list_of_words(annotation),
                    like_group=item.metadata.get("like_group", False),
                )
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
    allowed = [str(word) for word in _words(option.annotation)]
    hint = near(str(value), allowed) if allowed else ""
    is_list = any(get_origin(member) is tuple for member in union_members(option.annotation))
    if is_list and option.kind == "value" and isinstance(value, str) and "," in value:
        hint = f"; a list of numbers stands in brackets: {option.key}=[{value}]"
    meaning = f" ({option.help})" if option.help and not hint else ""
    return f"{option.key}: expected {describe(option.annotation)}, got {value!r}{hint}{meaning}"


def _words(annotation: Any) -> tuple[Any, ...]:
    words: tuple[Any, ...] = ()
    for member in union_members(annotation):
        if get_origin(member) is Literal:
            words += get_args(member)
        elif get_origin(member) is tuple:
            words += tuple(word for item in get_args(member) if item is not Ellipsis for word in _words(item))
    return words


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


def preset_node(cls: type, preset: str) -> dict[str, Any]:
    """The same as nested settings."""
    node: dict[str, Any] = {}
    for key, value in preset_values(cls, preset).items():
        *sections, name = key.split(".")
        inner = node
        for section in sections:
            inner = inner.setdefault(section, {})
        inner[name] = value
    return node


def describe_presets(cls: type) -> Mapping[str, str]:
    """What each preset changes in a command, in words."""
    changes = {
        preset: ", ".join(f"{key}={shown_value(value)}" for key, value in preset_values(cls, preset).items())
        for preset in PRESETS
    }
    return {name: text or "changes nothing in this command" for name, text in changes.items()} | {
        DEFAULT_PRESET: "the defaults"
    }


T = TypeVar("T")

NOT_FINITE = "nan is not a finite number"

HIDDEN = "(not shown)"
"""Shown and written in place of the value of a secret option."""


@dataclass(frozen=True, kw_only=True)
class CommonConfig:
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

    def __post_init__(self) -> None:
        check_limits(self)


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
    """
    import dacite
    from dacite.exceptions import DaciteFieldError

    types = field_types(cls)
    values: dict[str, Any] = {}
    for name, value in data.items():
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
    for each in options_of(cls):
        if each.required and not each.member and value_at(config, each.key) in (None, "", ()):
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
