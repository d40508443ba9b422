"""Removed options: their former default is accepted, another value is refused with the reason."""

import pytest

from gsencoder.core.errors import InputError
from gsencoder.core.settings import (
    REMOVED_OPTIONS,
    check_removed_option,
    removed_option,
    without_removed_options,
)

OPTIONS = ("localize.threshold.fixed", "localize.eps", "out")


def test_a_removed_option_is_recognized_with_and_without_its_section() -> None:
    assert removed_option("localize.margin", OPTIONS) == "localize.margin"
    assert removed_option("margin", OPTIONS) == "localize.margin"
    assert removed_option("localize.margins", OPTIONS) is None


def test_a_command_without_the_section_never_had_the_option() -> None:
    assert removed_option("margin", ("fusion.lift", "out")) is None


@pytest.mark.parametrize("name", list(REMOVED_OPTIONS))
def test_the_former_default_is_accepted_as_text_and_as_a_value(name: str) -> None:
    check_removed_option(name, REMOVED_OPTIONS[name].default)
    check_removed_option(name, str(REMOVED_OPTIONS[name].default))


@pytest.mark.parametrize("value", ["0.1", 0.1, "", "nan", None, [0.0]])
def test_another_value_is_refused_with_the_reason(value: object) -> None:
    with pytest.raises(InputError, match=r"localize.margin: this option was removed \(margins made boxes worse"):
        check_removed_option("localize.margin", value)


def test_saved_settings_lose_removed_options_that_have_their_former_default() -> None:
    saved = {"dense": {"alike": 0.6, "agree": 0.05, "size": 200}, "alike": 0.6, "steps": 3}
    assert without_removed_options(saved) == {"dense": {"agree": 0.05, "size": 200}, "alike": 0.6, "steps": 3}
