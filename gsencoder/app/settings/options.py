"""The options of a command: names, types, defaults and help texts, from its settings class."""

import difflib
import types
import typing
from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, cast, get_args, get_origin

from gsencoder.core.settings import REMOVED_VALUES

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
    return get_origin(annotation) in (Union, types.UnionType) and type(None) in get_args(annotation)


def _is_text(annotation: Any) -> bool:
    return annotation in (str, Path)


def _is_word(annotation: Any) -> bool:
    return get_origin(annotation) is Literal and all(isinstance(value, str) for value in get_args(annotation))


def kind_of(annotation: Any) -> Kind:
    """Whether the value of an option is taken literally ("text", "list") or parsed by Hydra ("value")."""
    members = union_members(annotation)
    if all(_is_text(member) for member in members):
        return "text"
    if get_origin(annotation) is Mapping:
        return "list"
    if len(members) == 1 and get_origin(members[0]) is tuple:
        items = get_args(members[0])
        if len(items) == 2 and items[1] is Ellipsis:
            return "list" if _is_text(items[0]) or _is_word(items[0]) else "value"
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
        cls: the class.
        prefix: of the keys.
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
    for option in options_of(cls, prefix):
        options.setdefault(option.key, option)
    return options


def wrong_value(option: Option, value: Any) -> str:
    """The message for a value of the wrong type."""
    if isinstance(value, (list, tuple)) and option.kind == "list":
        value = join_list(map(str, value))
    allowed = [str(word) for word in _words(option.annotation)]
    removed = REMOVED_VALUES.get(f"{option.key}={value}")
    hint = f", which was removed: {removed}" if removed else near(str(value), allowed) if allowed else ""
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
