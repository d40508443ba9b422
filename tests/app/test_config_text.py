"""Text reaches the dataclass as it was typed."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from toy_settings import LabelsConfig, toy

from gsencoder.app.options import join_list, split_list

HOSTILE = [
    "mug,banana",
    "What's red?",
    "(red)",
    "日本語 🥄",
    "/run=3",
    "1e-3",
    "null",
    "nan",
    "  x ",
    "${oc.env:HOME}",
    "$\\{a}",
    "${",
    "",
    "a\\nb",
    "a\r\nb",
    "'a'",
    '\\"',
    "a\\",
    "[a,b]",
    "{a: 1}",
    "~x",
    "???",
    "choice(a,b)",
    "a=b",
    "a#b",
    "%s %(x)s {0}",
    "--help",
    "${text:x41}",
    "\u2028",
    "\x7f\x1b[31m",
    "\udcff",
]


def test_text_arrives_as_it_was_typed(conf: Path) -> None:
    for text in HOSTILE:
        config = toy(conf, f"question={text}", f"query={text}", f"teacher.table={text}")
        assert config.question == text
        assert config.query == split_list(text)
        assert isinstance(config.teacher, LabelsConfig)
        assert config.teacher.table == (Path(text) if text else None)


@given(
    st.text(st.characters(exclude_characters="\0"), max_size=30),
    st.lists(st.text(st.characters(exclude_characters="\\\0"), max_size=8), max_size=12),
)
@hypothesis_settings(max_examples=12, deadline=None)
@pytest.mark.slow
def test_any_text_arrives_as_it_was_typed(conf_for_hypothesis: Path, text: str, words: list[str]) -> None:
    words = [word for word in words if word]
    config = toy(conf_for_hypothesis, f"question={text}", f"query={join_list(words)}", "--", *words)
    assert config.question == text
    assert config.query == tuple(words)
    assert config.paths == tuple(words)


@pytest.fixture(scope="module")
def conf_for_hypothesis(conf: Path) -> Path:
    return conf


@given(st.lists(st.text(st.sampled_from("a, "), max_size=6), max_size=5))
def test_a_list_of_text_can_be_written_whatever_its_items_hold(items: list[str]) -> None:
    if items != [""]:
        assert split_list(join_list(items)) == tuple(items)


def test_a_backslash_matters_only_before_a_comma() -> None:
    written = {"": (), "mug,red cup": ("mug", "red cup"), "a\\,b": ("a,b",), "a\\nb": ("a\\nb",), ",": ("", "")}
    for text, items in written.items():
        assert split_list(text) == items


@pytest.mark.parametrize("value", ["depth,render", "[depth,render]", "[ depth , render ]"])
def test_a_list_of_words_may_have_brackets(conf: Path, value: str) -> None:
    assert toy(conf, f"fusion.against={value}").fusion.against == ("depth", "render")


def test_brackets_around_a_list_of_text_are_text(conf: Path) -> None:
    assert toy(conf, "query=[red],mug").query == ("[red]", "mug")
