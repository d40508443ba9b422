"""Writes docs/cli.md, the reference of the command line, from the settings classes and the YAML files of `conf`.

python docs/tooling/cli_page.py     # or: make cli

Sections that several commands have with the same options are written once, under "Sections of several commands".
"""

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any, get_args, get_origin

import yaml

from gsencoder.app.main import COMMANDS, FLAGS, SHORT, Command
from gsencoder.app.options import (
    PRESET,
    PRESETS,
    RULES,
    CommonConfig,
    Option,
    choices_of,
    conf_folder,
    describe,
    field_types,
    member_name,
    options_of,
    preset_values,
    section_classes,
    union_members,
)
from gsencoder.core.settings import format_value

PAGE = Path(__file__).resolve().parents[1] / "cli.md"
HEAD = """\
# Command line

Every command, and every option with its type, default and meaning. `make cli` writes this page from the code;
`gsencoder COMMAND --help` shows the same. The task pages say what the options are for, [scenes](tasks/scenes.md)
first.

```
gsencoder COMMAND [PATH…] [key=value …] [flags]
```
"""

REST = """\
### Exit codes

| code | means |
|---|---|
| 0 | success |
| 1 | a bug of gsencoder, with its traceback |
| 2 | wrong input, a missing file or a full disk: one line on standard error says what was wrong and what to do |
| 130, 143 | interrupted (Ctrl-C), terminated |
| 135, 137, 139 | ended by the system: a bus error, killed (often for memory), a segmentation fault |

Results go to standard output, warnings and errors to standard error.

### Environment variables

| variable | holds |
|---|---|
| `GSENCODER_MODELS` | the folder where models, text towers and tables are looked for by name, before those installed |
| `GSENCODER_CACHE` | the folder where vectors of phrases are cached, or `off`; by default one for each user |
| `GSENCODER_VLM_MODEL` | the model that `ask` requests, where `vlm.model` is empty |
| `OPENAI_BASE_URL`, `OPENAI_API_KEY` | the server that `ask` talks to, and its key |
"""


@dataclass(frozen=True, slots=True)
class Section:
    """Options that share the part of their name before the first dot.

    Attributes:
        name: that part; empty for the options of the command itself.
        member: the member of a choice that they belong to, such as "teacher=onnx"; empty if they always apply.
        meaning: the first line of the settings class.
        rows: a row of the table for each option.
    """

    name: str
    member: str
    meaning: str
    rows: tuple[str, ...]

    @property
    def title(self) -> str:
        return f"`{self.member}`" if self.member else f"`{self.name}.`"


def escaped(text: str) -> str:
    """Text for a cell of a table, with settings (`key=value`) as code."""
    text = text.replace("|", "\\|").replace("<", "&lt;").replace("*", "\\*")
    return re.sub(r"(?<![\w`/&])([a-z_][\w.]*=(?:[\w.\[\],/+-]*[\w\]])?)(?=$|[\s,;:.)])", r"`\1`", text)


def shown_default(option: Option) -> str:
    value = option.default
    if value is None or value == "" or value == () or value == {}:
        return "required" if option.required else "none" if value is None else "empty"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, (list, tuple)):
        return f"`[{','.join(map(str, value))}]`"
    return f"`{value}`"


def shown_type(annotation: Any) -> str:
    """The type in words; the values of a closed set as code."""
    text = describe(annotation)
    for member in union_members(annotation):
        for part in (member, *get_args(member)):
            words = [str(word) for word in get_args(part) if isinstance(word, str)]
            if words and get_origin(part) is not None:
                text = text.replace(", ".join(words), ", ".join(f"`{word}`" for word in words))
    return escaped(text)


def row(option: Option) -> str:
    cells = (f"`{option.key}`", shown_type(option.annotation), shown_default(option), escaped(option.help))
    return f"| {' | '.join(cells)} |"


COMMON = tuple(map(row, options_of(CommonConfig)))


def table(rows: Iterable[str]) -> list[str]:
    return ["| option | type | default | meaning |", "|---|---|---|---|", *rows, ""]


def meanings(cls: type) -> Iterator[tuple[str, str, str]]:
    """Name, member and first line of the docstring of every section of a command."""
    for name, annotation in field_types(cls).items():
        classes = section_classes(annotation)
        for section in classes:
            line = (section.__doc__ or "").strip().split("\n\n")[0].replace("\n", " ")
            yield name, f"{name}={member_name(section)}" if len(classes) > 1 else "", re.sub(r"\s+", " ", line)


@cache
def sections_of(cls: type[CommonConfig]) -> list[Section]:
    """The options of a command in sections, as declared, its own first; those of every command are left out."""
    lines = {(name, member): line for name, member, line in meanings(cls)}
    rows: dict[tuple[str, str], list[str]] = {("", ""): []}
    for option in options_of(cls):
        if option.key != "paths" and row(option) not in COMMON:
            name = option.key.split(".")[0] if "." in option.key else ""
            rows.setdefault((name, option.member), []).append(row(option))
    # A member of a choice may have no options of its own.
    for key in lines:
        if key[1]:
            rows.setdefault(key, [])
    return [Section(name, member, lines.get((name, member), ""), tuple(each)) for (name, member), each in rows.items()]


def anchor(section: Section) -> str:
    """The anchor of the heading of a section of several commands."""
    return f"choice-{section.name}" if section.member else f"section-{section.name}"


def presets(cls: type[CommonConfig]) -> list[str]:
    sets = []
    for name in PRESETS:
        changes = ", ".join(f"{key}={format_value(value)}" for key, value in preset_values(cls, name).items())
        sets += [f"`{PRESET}={name}` sets {escaped(changes)}"] if changes else []
    return [f"Presets: {'; '.join(sets)}.", ""] if sets else []


def command_text(name: str, command: Command, shared: set[Section]) -> list[str]:
    cls = command.load()[0]
    paths = next((option for option in options_of(cls) if option.key == "paths"), None)
    word = f" {paths.metavar or 'PATH'}…" if paths else ""
    lines = [f"### {name}", "", f"{command.help[0].upper()}{command.help[1:]}.", ""]
    lines += ["```", f"gsencoder {name}{word} [key=value …]", "```", ""]
    if paths:
        lines += [f"{paths.metavar or 'PATH'}: {escaped(paths.help)}.", ""]
    if command.several:
        lines += ["Several processes of one launcher (torchrun, SLURM) can run it together.", ""]
    choices = choices_of(cls)
    sections = sections_of(cls)
    own = [section for section in sections if section not in shared]
    for section in own:
        if section.rows or section.member:
            if section.name:
                lines += [f"**{section.title}** {escaped(section.meaning)}", ""]
            lines += table(section.rows) if section.rows else []
    for group, members in choices.groups.items():
        if group != PRESET:
            names = ", ".join(f"`{member}`" for member in members)
            help_ = next((str(each.metadata.get("help", "")) for each in fields(cls) if each.name == group), "")
            meaning = f": {escaped(help_)}" if help_ else ""
            lines += [f"Choice `{group}=` of {names}; default `{choices.chosen[group]}`{meaning}.", ""]
    elsewhere = dict.fromkeys(
        (section.title if not section.member else f"`{section.name}.`", anchor(section))
        for section in sections
        if section in shared
    )
    if elsewhere:
        links = ", ".join(f"[{title}](#{target})" for title, target in elsewhere)
        lines += [f"Sections of several commands: {links}.", ""]
    return lines + presets(cls)


def shared_sections() -> dict[Section, list[str]]:
    """The sections that more than one command has, with these commands."""
    commands: dict[Section, list[str]] = {}
    for name, command in COMMANDS.items():
        for section in sections_of(command.load()[0]):
            if section.name:
                commands.setdefault(section, []).append(name)
    return {section: names for section, names in commands.items() if len(names) > 1}


def shared_text(shared: dict[Section, list[str]]) -> list[str]:
    lines: list[str] = []
    headings = ""
    for section, names in sorted(shared.items(), key=lambda each: each[0].name):
        if anchor(section) != headings:
            headings = anchor(section)
            links = ", ".join(f"[{name}](#{name})" for name in names)
            lines += [f"### {'Choice' if section.member else 'Section'} {section.name}", "", f"Of {links}.", ""]
        if section.member:
            lines += [f"**{section.title}** {escaped(section.meaning)}", ""]
        elif section.meaning:
            lines += [escaped(section.meaning), ""]
        lines += table(section.rows) if section.rows else []
    return lines


def flat(node: dict[str, Any], prefix: str = "") -> Iterator[str]:
    for key, value in node.items():
        if isinstance(value, dict):
            yield from flat(value, f"{prefix}{key}.")
        else:
            text = f"[{','.join(map(str, value))}]" if isinstance(value, list) else str(value)
            yield f"`{prefix}{key}={text}`"


def yaml_text() -> list[str]:
    """The members of choices, and the experiments, that are YAML files."""
    lines: list[str] = []
    for folder in sorted(path for path in conf_folder().iterdir() if path.is_dir() and path.name != "experiment"):
        lines += [f"`{folder.name}=`", ""]
        for file in sorted(folder.glob("*.yaml")):
            text = file.read_text(encoding="utf-8")
            node = yaml.safe_load(text)
            base = next(each for each in node.pop("defaults") if each != "_self_")
            comment = " ".join(line[1:].strip() for line in text.splitlines() if line.startswith("#"))
            sets = ", ".join(flat(node, f"{folder.name}."))
            lines.append(f"- `{file.stem}` is `{base}` with {sets}. {escaped(comment)}".rstrip())
        lines.append("")
    for file in sorted((conf_folder() / "experiment").glob("*.yaml")):
        text = file.read_text(encoding="utf-8").strip()
        lines += [f"`experiment={file.stem}` of `train`:", "", "```yaml", text, "```", ""]
    return lines


def page() -> str:
    """The text of docs/cli.md."""
    shared = shared_sections()
    short = {long: f"`{long}`, `{each}`" for each, long in SHORT.items()}
    rules = RULES.replace("one of those above", "an option of the command")
    lines = [HEAD, "### Words", "", escaped(rules), ""]
    lines += ["### Flags", "", "| flag | does |", "|---|---|"]
    lines += [f"| {short.get(flag, f'`{flag}`')} | {re.sub(r' ?[(]-.[)]', '', text)} |" for flag, text in FLAGS.items()]
    lines += ["", "### Options of every command", "", *table(COMMON), REST]
    lines += ["## Commands", "", "| command | does |", "|---|---|"]
    lines += [f"| [{name}](#{name}) | {escaped(command.help)} |" for name, command in COMMANDS.items()]
    lines.append("")
    for name, command in COMMANDS.items():
        lines += command_text(name, command, set(shared))
    lines += ["## Sections of several commands", "", *shared_text(shared)]
    lines += ["## Named settings", "", "Members of choices, and experiments, that are files of `conf/`.", ""]
    lines += yaml_text()
    return "\n".join(lines).rstrip() + "\n"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    print(f"{PAGE}: {len(COMMANDS)} commands")
