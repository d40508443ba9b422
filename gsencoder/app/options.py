"""The options of a command, which are the fields of a frozen dataclass, and its choices; `--help` shows both.

A field is made by `option`, whose metadata hold its meaning and its limits. Further metadata: `required=True` (the
command cannot run without it), `metavar` (the word that stands for the value in the help), `secret=True` (the value is
never shown or written), `names=True` (a list of names, around which brackets may stand) and `like_group=True` (a choice
of other commands has the option's name).

A field whose type is a dataclass is a section, and its options are written `section.name=value`. A field whose type is
a union of dataclasses is a choice, written `section=member`: every member has a field `name: Literal["…"]`.
`preset="NAME"` in the metadata of a section makes it a choice too, between its default, which has that name, and the
files `conf/SECTION/*.yaml`. A mapping from names to such a union, with `several="SECTION"`, takes several members of
that choice: `sections=member,NAME:member`, whose options are `sections.NAME.option=value`.

The config groups of a command hold what can be chosen by name: the members of choices, presets of sections, `preset`,
and `experiment`. YAML files in the folder of a group are further members, which set only what differs from the member
that they build on.
"""

import difflib
import shutil
import textwrap
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, Literal, TypeVar, Union, cast, get_args, get_origin

from gsencoder.core.settings import CheckedConfig, format_value, option

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
        kind: whether its value is taken literally ("text", "list" of text) or parsed by Hydra ("value").
        names: whether it is a list of words, around which users of Hydra may write brackets.
        several: the choice of which it takes several members, by name; empty for other options.
        hydra_key: its name in the settings that Hydra composes.
    """

    key: str
    annotation: Any
    default: Any
    member: str
    kind: Kind
    help: str
    metavar: str
    required: bool
    secret: bool
    names: bool
    several: str
    hydra_key: str


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
    """The kind of an option of a type; see `Option`."""
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


@cached
def field_types(cls: type) -> Mapping[str, Any]:
    """The resolved types of a dataclass's fields."""
    hints = typing.get_type_hints(cls)
    return {item.name: hints[item.name] for item in fields(cls)}


def section_classes(annotation: Any) -> tuple[type, ...]:
    """The dataclasses of a section; empty for a plain option."""
    return tuple(member for member in union_members(annotation) if is_dataclass(member) and isinstance(member, type))


def member_name(member: type) -> str:
    """The name of a member of a choice: the literal of its field `name`."""
    return str(get_args(field_types(member)["name"])[0])


def options_of(cls: type, prefix: str = "", member: str = "", defaults: Any = None) -> list[Option]:
    """Every option of a settings class, sections included, in order of declaration; `defaults` is an instance whose
    values are the defaults, None = `cls()`."""
    options: list[Option] = []
    annotations = field_types(cls)
    defaults = cls() if defaults is None else defaults
    for item in fields(cls):
        key, annotation = prefix + item.name, annotations[item.name]
        default, classes = getattr(defaults, item.name), section_classes(annotation)
        if classes:
            for section in classes:
                owner = f"{key.replace('.', '/')}={member_name(section)}" if len(classes) > 1 else member
                options += options_of(section, key + ".", owner, default if isinstance(default, section) else None)
        elif not (item.name == "name" and get_origin(annotation) is Literal and len(get_args(annotation)) == 1):
            metadata, items = item.metadata, list_items(annotation)
            options.append(
                Option(
                    key=key,
                    annotation=annotation,
                    default=default,
                    member=member,
                    kind=kind_of(annotation),
                    help=metadata.get("help", ""),
                    metavar=metadata.get("metavar", ""),
                    required=metadata.get("required", False),
                    secret=metadata.get("secret", False),
                    names=metadata.get("names", False) or (len(items) == 1 and _is_word(items[0])),
                    several=metadata.get("several", ""),
                    hydra_key=key + LIKE_GROUP if metadata.get("like_group") else key,
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


EXPERIMENT = "experiment"
"""The group whose members set options of several sections; they are merged last, after the command's own defaults and
presets."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Group:
    """A config group: named settings of one section, of which a command line chooses one, `KEY=MEMBER`.

    Attributes:
        key: the section, with a slash before a nested one; also the name of the folder of YAML files.
        members: the settings of the members that the dataclasses define.
    """

    key: str
    default: str
    members: Mapping[str, dict[str, Any]]


@cached
def groups_of(cls: type[CommonConfig]) -> tuple[Group, ...]:
    """The config groups of a command, in order of declaration, presets and experiments last."""
    groups = list(_section_groups(cls()))
    groups.append(Group(key=PRESET, default=DEFAULT_PRESET, members={name: _preset(cls, name) for name in PRESETS}))
    if cls.has_experiments:
        groups.append(Group(key=EXPERIMENT, default="none", members={"none": {}}))
    return tuple(groups)


def _preset(cls: type[CommonConfig], name: str) -> dict[str, Any]:
    node: dict[str, Any] = {PRESET + LIKE_GROUP: name}
    for key, value in preset_values(cls, name).items():
        *sections, last = key.split(".")
        section = node
        for each in sections:
            section = section.setdefault(each, {})
        section[last] = value
    return node


def _section_groups(config: Any, prefix: str = "") -> Iterator[Group]:
    annotations = field_types(type(config))
    for item in fields(config):
        key, default = prefix + item.name, getattr(config, item.name)
        classes = section_classes(annotations[item.name])
        if len(classes) > 1:
            configs = [default if type(default) is section else section() for section in classes]
            members = {member_name(type(each)): settings(each) for each in configs}
            yield Group(key=key, default=member_name(type(default)), members=members)
        elif "preset" in item.metadata:
            name = item.metadata["preset"]
            yield Group(key=key, default=name, members={name: settings(default)})
        elif classes:
            yield from _section_groups(default, key + "/")


@dataclass(frozen=True, slots=True, kw_only=True)
class Choices:
    """The options of a command by full key, and its choices.

    Attributes:
        members: for each key the members of a choice that have this option; empty if it always applies.
        groups: the names of each choice's members.
    """

    options: Mapping[str, Option]
    members: Mapping[str, tuple[str, ...]]
    groups: Mapping[str, tuple[str, ...]]
    chosen: Mapping[str, str]


def conf_folder() -> Path:
    """The folder of YAML files: inside an installed package, next to it in a source tree."""
    package = Path(__file__).resolve().parents[1]
    return package / "conf" if (package / "conf").is_dir() else package.parent / "conf"


def choices_of(cls: type[CommonConfig], conf: Path | None = None) -> Choices:
    """The options and choices of a command, including the members of choices that are YAML files in `conf`."""
    folder, groups, defaults = conf or conf_folder(), {}, {}
    for group in groups_of(cls):
        files = (path.stem for path in (folder / group.key).glob("*.yaml"))
        groups[group.key] = tuple(sorted({*group.members, *files}))
        defaults[group.key] = group.default
    members: dict[str, tuple[str, ...]] = {}
    for each in options_of(cls):
        members[each.key] = (*members.get(each.key, ()), each.member) if each.member else ()
    return Choices(options=options_by_key(cls), members=members, groups=groups, chosen=defaults)


RULES = (
    "A word KEY=VALUE is a setting if KEY is one of those above (the part after the last dot is enough where only one, "
    "or one with fewer dots than the others, has it), else a path if such a file exists; every other word is a path, "
    "and so is every word after --. In lists of text commas separate and \\, is a comma."
)


def _format_default(value: Any) -> str:
    if value == "":
        return "empty"
    if isinstance(value, tuple):
        return ",".join(map(str, value)) or "none"
    return str(value).lower() if isinstance(value, bool) or value is None else str(value)


def _entry(head: str, text: str, width: int) -> list[str]:
    body = textwrap.wrap(text, width - 6) or [""]
    return [f"  {head}", *(f"      {line}" for line in body)]


def _option(option: Option, width: int) -> list[str]:
    kind = option.metavar or describe(option.annotation)
    return _entry(f"{option.key}={kind}", f"{option.help} [{_format_default(option.default)}]", width)


def command_help(
    name: str, summary: str, cls: type[CommonConfig], flags: Mapping[str, str], conf: Path | None = None
) -> str:
    """The help of one command: usage, paths, settings with type, meaning and default, choices, flags."""
    width = min(shutil.get_terminal_size((100, 24)).columns, 110)
    # The options of the command first, then those of its sections.
    options = sorted(options_of(cls), key=lambda option: "." in option.key)
    choices = choices_of(cls, conf)
    paths = next((option for option in options if option.key == "paths"), None)
    word = f" {paths.metavar or 'PATH'}…" if paths else ""
    lines = [f"usage: gsencoder {name}{word} [key=value …]", "", *textwrap.wrap(summary, width)]
    if paths:
        lines += ["", "paths:", *_entry(paths.metavar or "PATH", paths.help, width)]
    groups = {group: members for group, members in choices.groups.items() if group != PRESET}
    if groups:
        lines += ["", "choices:"]
        for group, members in groups.items():
            text = next((str(each.metadata.get("help", "")) for each in fields(cls) if each.name == group), "")
            meaning = f"{text} [{_format_default(choices.chosen[group])}]".strip()
            lines += _entry(f"{group}={'|'.join(members)}", meaning, width)
    lines += ["", f"presets [{DEFAULT_PRESET}]:"]
    for preset in PRESETS:
        changes = ", ".join(f"{key}={format_value(value)}" for key, value in preset_values(cls, preset).items())
        nothing = "the defaults" if preset == DEFAULT_PRESET else "changes nothing in this command"
        lines += _entry(f"{PRESET}={preset}", changes or nothing, width)
    lines += ["", "settings [default]:"]
    for each in options:
        if each.key != "paths" and not each.member and each.key not in choices.groups:
            lines += _option(each, width)
    for member in dict.fromkeys(each.member for each in options if each.member):
        lines += ["", f"settings with {member} [default]:"]
        for each in options:
            if each.member == member:
                lines += _option(each, width)
    lines += ["", "flags:", *(f"  {flag:<12}{text}" for flag, text in flags.items())]
    return "\n".join([*lines, "", *textwrap.wrap(RULES, width)])
