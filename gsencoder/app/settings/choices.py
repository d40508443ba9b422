"""The options and choices of a command, and which of them a key stands for."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from gsencoder.app.settings.config import CommonConfig
from gsencoder.app.settings.config_store import groups_of
from gsencoder.app.settings.options import Option, options_by_key, options_of
from gsencoder.core.errors import InputError


@dataclass(frozen=True, slots=True, kw_only=True)
class Choices:
    """The options and choices of a command.

    Attributes:
        options: by full key.
        members: for each key the members of a choice that have this option; empty if it always applies.
        groups: the names of each choice's members, by the choice's key.
        chosen: the default of each choice.
    """

    options: Mapping[str, Option]
    members: Mapping[str, tuple[str, ...]]
    groups: Mapping[str, tuple[str, ...]]
    chosen: Mapping[str, str]


def conf_folder() -> Path:
    """The folder of YAML files: inside an installed package, beside it in a source tree."""
    package = Path(__file__).resolve().parents[2]
    return package / "conf" if (package / "conf").is_dir() else package.parent / "conf"


def choices_of(cls: type[CommonConfig], conf: Path | None = None) -> Choices:
    """The options and choices of a command, including the members of choices that are YAML files in `conf`."""
    folder, groups, defaults = conf or conf_folder(), {}, {}
    for group in groups_of(cls):
        files = (path.stem for path in (folder / group.key).glob("*.yaml"))
        groups[group.key] = tuple(sorted({*group.members, *files}))
        defaults[group.key] = group.default
    members: dict[str, tuple[str, ...]] = {}
    for option in options_of(cls):
        members[option.key] = (*members.get(option.key, ()), option.member) if option.member else ()
    return Choices(options=options_by_key(cls), members=members, groups=groups, chosen=defaults)


def option_of_several(key: str, choices: Choices) -> Option | None:
    """The option that `teachers.NAME.OPTION` stands for, which is that of the choice `teacher`; None for other keys."""
    field, _, rest = key.partition(".")
    name, _, last = rest.partition(".")
    several = choices.options[field].several if field in choices.options else ""
    return choices.options.get(f"{several}.{last}") if several and name and last else None


def full_key(key: str, choices: Choices) -> str | None:
    """The option or choice that `key` stands for, or None."""
    keys = [*choices.options, *choices.groups]
    if key in keys or option_of_several(key, choices) is not None:
        return key
    ends = [name for name in keys if re.split(r"[./]", name)[-1] == key]
    # An option of a section within a section gives way to one that is less deep.
    depths = [len(re.split(r"[./]", name)) for name in ends]
    ends = [name for name, depth in zip(ends, depths, strict=True) if depth == min(depths)]
    if len(ends) > 1:
        raise InputError(f"{key}: stands for more than one option; write {' or '.join(f'{end}=' for end in ends)}")
    return ends[0] if ends else None
