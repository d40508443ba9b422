"""Values out of range, of every option of every command: the first words of the message are the option's name."""

import math
from typing import Any

import pytest

from gsencoder.app.main import COMMANDS
from gsencoder.app.options import Option, options_of, typed, union_members
from gsencoder.core.errors import InputError


def written(option: Option, value: object) -> dict[str, Any]:
    """Settings with a value of one option, in the member of a choice that has it."""
    data: dict[str, Any] = {}

    def section(names: list[str]) -> dict[str, Any]:
        inner = data
        for name in names:
            inner = inner.setdefault(name, {})
        return inner

    *sections, last = option.key.split(".")
    section(sections)[last] = value
    choice, _, member = option.member.partition("=")
    if member:
        section(choice.split("/"))["name"] = member
    return data


@pytest.mark.parametrize("name", COMMANDS)
def test_a_number_that_is_not_finite_is_refused_by_name_with_what_is_expected(name: str) -> None:
    cls, _ = COMMANDS[name].load()
    # Without its protocol `score` looks at no option.
    beside = {"paths": ["captions"]} if name == "score" else {}
    for option in options_of(cls):
        if not {int, float} & {*union_members(option.annotation)}:
            continue
        for value in (math.nan, math.inf, -math.inf):
            with pytest.raises(InputError) as refused:
                typed(cls, written(option, value) | beside)
            message = str(refused.value)
            names, _, said = message.partition(": ")
            assert option.key in names.split(", "), message
            assert said.startswith("expected"), message
            assert not math.isnan(value) or "whole number" in said or "nan is not a finite" in said or "," in names
