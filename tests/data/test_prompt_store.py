"""Prompts on disk: what is written is read, pictures are shared, and what was cut off or changed is noticed."""

from pathlib import Path

import numpy as np
import pytest
from tuning_pairs import png

from gsencoder.core.errors import InputError
from gsencoder.data.prompt_store import PICTURES_FOLDER, PROMPTS_FILE, TOKENS_FOLDER, PromptStore


def test_what_is_written_is_read(tmp_path: Path) -> None:
    tokens = np.arange(24, dtype=np.float16).reshape(2, 3, 4)
    PromptStore(tmp_path).add("a", "Was ist das?\nGrün", [png(0), png(1)], tokens, "a space")
    prompt = PromptStore(tmp_path).prompts["a"]
    assert (prompt.text, prompt.space) == ("Was ist das?\nGrün", "a space")
    store = PromptStore(tmp_path)
    assert store.picture(prompt.pictures[0]).shape == (48, 64, 3)
    assert not np.array_equal(*(store.picture(name) for name in prompt.pictures))
    np.testing.assert_array_equal(store.tokens(prompt.tokens), tokens)


def test_questions_about_the_same_thing_share_their_pictures(tmp_path: Path) -> None:
    store = PromptStore(tmp_path)
    for key in "abc":
        store.add(key, key, [png(0), png(1)], np.zeros((2, 1, 1), np.float16))
    assert len(list((tmp_path / PICTURES_FOLDER).iterdir())) == 2
    assert len(list((tmp_path / TOKENS_FOLDER).iterdir())) == 1
    assert len(PromptStore(tmp_path).prompts) == 3


@pytest.mark.parametrize("kept", [0, 1])
def test_a_line_that_was_cut_off_is_written_again(tmp_path: Path, kept: int) -> None:
    store = PromptStore(tmp_path)
    for number in range(kept + 1):
        store.add(str(number), "text", [png(0)])
    path = tmp_path / PROMPTS_FILE
    path.write_bytes(path.read_bytes()[:-9])
    again = PromptStore(tmp_path)
    assert list(again.prompts) == [str(number) for number in range(kept)]
    again.add("next", "text", [png(0)])
    assert list(PromptStore(tmp_path).prompts) == [*(str(number) for number in range(kept)), "next"]


def test_a_changed_picture_is_refused(tmp_path: Path) -> None:
    store = PromptStore(tmp_path)
    (name,) = store.add("a", "text", [png(0)]).pictures
    (tmp_path / PICTURES_FOLDER / name).write_bytes(png(1))
    with pytest.raises(InputError, match="is damaged; remove"):
        store.picture(name)


@pytest.mark.parametrize(
    "line",
    [
        b"[]",
        b"nothing",
        b'{"key": "a", "text": "t", "pictures": [], "tokens": "", "space": ""}',
        b'{"key": "a", "text": "t", "pictures": ["../x.png"], "tokens": "", "space": ""}',
        b'{"key": "a", "text": 3, "pictures": ["x.png"], "tokens": "", "space": ""}',
    ],
)
def test_lines_that_no_store_wrote_are_refused(tmp_path: Path, line: bytes) -> None:
    (tmp_path / PROMPTS_FILE).write_bytes(line + b"\n")
    with pytest.raises(InputError, match="line 1 is no prompt"):
        PromptStore(tmp_path)
