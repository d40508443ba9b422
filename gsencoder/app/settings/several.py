"""Choices of which a run may have several members: `teachers=[labels,dino:onnx] teachers.dino.OPTION=…`."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

from gsencoder.app.settings.choices import Choices
from gsencoder.app.settings.config_store import EXPERIMENT
from gsencoder.app.settings.options import near
from gsencoder.core.errors import InputError


def check_options_of_one(texts: Mapping[str, str], choices: Choices) -> None:
    """Checks that with several members of a choice no options are given for the only one.

    Raises:
        InputError: there are such options, or no members.
    """
    for key, value in texts.items():
        several = choices.options[key].several if key in choices.options else ""
        unused = [name for name in texts if name == several or name.startswith(f"{several}.")] if several else []
        if unused:
            option = unused[0].partition(".")[2]
            hint = f"{key}.NAME.{option}=… is that of one of them" if option else f"leave out {several}= or {key}="
            raise InputError(f"{unused[0]}: is for a single {several}, and {key}={value} gives several; {hint}")
        if several and not value.strip("[] "):
            raise InputError(f"{key}: expected one or more of {', '.join(choices.groups[several])}, got {value!r}")


def members_of(key: str, value: str, group: str, members: Sequence[str]) -> list[str]:
    """Overrides that add several members of a choice, each below a name of its own.

    Raises:
        InputError: an unknown member, or a name that is given twice.
    """
    pairs = named_members(value)
    names = [name for name, _ in pairs]
    for name, member in pairs:
        if member not in members:
            raise InputError(f"{key}: expected some of {', '.join(members)}, got {member!r}{near(member, members)}")
        if names.count(name) > 1:
            raise InputError(f"{key}: {name} is given twice; give other names, such as {name}_2:{member}")
        if not re.fullmatch(r"\w+", name, re.ASCII):
            raise InputError(f"{key}: expected names of letters, digits and _, got {name!r}")
    return [f"+{group}@{key}.{name}={member}" for name, member in pairs]


def named_members(value: str) -> list[tuple[str, str]]:
    """The names and members of a list such as [labels,dino:onnx]; a member without a name has its own."""
    words = [word.strip() for word in value.removeprefix("[").removesuffix("]").split(",") if word.strip()]
    return [(word.partition(":")[0], word.partition(":")[2] or word) for word in words]


def check_single(data: Mapping[str, Any], texts: Mapping[str, str], choices: Choices) -> None:
    """Checks that nothing was given for a single member of a choice of which an experiment gives several.

    Raises:
        InputError: it was.
    """
    for key, option in choices.options.items():
        single = option.several
        unused = [name for name in texts if single and (name == single or name.startswith(f"{single}."))]
        if unused and data.get(key):
            raise InputError(
                f"{unused[0]}: is for a single {single}, and {EXPERIMENT}={texts.get(EXPERIMENT, '')} gives several, "
                f"{', '.join(data[key])}; options of one of them are {key}.NAME.OPTION=…, others need another "
                f"{EXPERIMENT}="
            )
