"""The text of `gsencoder COMMAND --help`, from the settings classes and the names of the YAML files."""

import shutil
import textwrap
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from gsencoder.app.settings.choices import choices_of
from gsencoder.app.settings.config import CommonConfig
from gsencoder.app.settings.options import Option, describe, join_list, options_of
from gsencoder.app.settings.presets import DEFAULT_PRESET, PRESET, describe_presets

RULES = (
    "A word KEY=VALUE is a setting if KEY is one of those above (the part after the last dot is enough where only one, "
    "or one with fewer dots than the others, has it), else a path if such a file exists; every other word is a path, "
    "and so is every word after --. In lists of text commas separate and \\, is a comma."
)


def _shown(value: Any) -> str:
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (list, tuple)):
        return join_list(map(str, value)) if value else "none"
    return str(value) if value != "" else "empty"


def _entry(head: str, text: str, width: int) -> list[str]:
    body = textwrap.wrap(text, width - 6) or [""]
    return [f"  {head}", *(f"      {line}" for line in body)]


def _option(option: Option, width: int) -> list[str]:
    kind = option.metavar or describe(option.annotation)
    return _entry(f"{option.key}={kind}", f"{option.help} [{_shown(option.default)}]", width)


def choice_help(cls: type[CommonConfig], group: str) -> str:
    """What a command says of one of its choices; empty for most, whose members say it."""
    return str(next((each.metadata.get("help", "") for each in fields(cls) if each.name == group), ""))


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
            meaning = f"{choice_help(cls, group)} [{_shown(choices.chosen[group])}]".strip()
            lines += _entry(f"{group}={'|'.join(members)}", meaning, width)
    lines += ["", f"presets [{DEFAULT_PRESET}]:"]
    for preset, changes in describe_presets(cls).items():
        lines += _entry(f"{PRESET}={preset}", changes, width)
    lines += ["", "settings [default]:"]
    for option in options:
        if option.key != "paths" and not option.member and option.key not in choices.groups:
            lines += _option(option, width)
    for member in dict.fromkeys(option.member for option in options if option.member):
        lines += ["", f"settings with {member} [default]:"]
        for option in options:
            if option.member == member:
                lines += _option(option, width)
    lines += ["", "flags:", *(f"  {flag:<12}{text}" for flag, text in flags.items())]
    return "\n".join([*lines, "", *textwrap.wrap(RULES, width)])
