"""Prompts on disk: what is written is read, pictures are shared, and what was cut off or changed is noticed."""

import json
from pathlib import Path

import numpy as np
import pytest
from tuning_pairs import png

from gsencoder.core.errors import InputError
from gsencoder.core.files import with_checksum
from gsencoder.data.prompts import PICTURES_FOLDER, PROMPTS_FILE, TOKENS_FOLDER, PromptStore


def test_what_is_written_is_read(tmp_path):
    tokens = np.arange(24, dtype=np.float16).reshape(2, 3, 4)
    PromptStore(tmp_path).add("a", "Was ist das?\nGrün", [png(0), png(1)], tokens, "a space")
    prompt = PromptStore(tmp_path).prompts["a"]
    assert (prompt.text, prompt.space) == ("Was ist das?\nGrün", "a space")
    store = PromptStore(tmp_path)
    assert store.picture(prompt.pictures[0]).shape == (48, 64, 3)
    assert not np.array_equal(*(store.picture(name) for name in prompt.pictures))
    np.testing.assert_array_equal(store.tokens(prompt.tokens), tokens)
    # People can read it too.
    assert "Grün" in (tmp_path / PROMPTS_FILE).read_text("utf-8")


def test_a_changed_picture_is_refused(tmp_path):
    store = PromptStore(tmp_path)
    (name,) = store.add("a", "text", [png(0)]).pictures
    (tmp_path / PICTURES_FOLDER / name).write_bytes(png(1))
    with pytest.raises(InputError, match="is damaged; remove"):
        store.picture(name)


def test_names_are_those_of_formats_and_tokens_of_other_shapes_are_others(tmp_path):
    store = PromptStore(tmp_path)
    jpeg = bytes([255, 216, 255, 224]) + b"no picture"
    values = np.arange(12, dtype=np.float16)
    first = store.add("a", "t", [jpeg, png(0)], values.reshape(2, 3, 2))
    second = store.add("b", "t", [png(0)], values.reshape(2, 2, 3))
    assert [name.rpartition(".")[2] for name in first.pictures] == ["jpg", "png"]
    assert {len(Path(name).stem) for name in (*first.pictures, first.tokens)} == {32}
    assert second.pictures == first.pictures[1:]
    # Of the same bytes.
    assert first.tokens != second.tokens
    assert store.tokens(first.tokens).shape == (2, 3, 2)
    assert store.tokens(second.tokens).shape == (2, 2, 3)
    again = PromptStore(tmp_path).prompts
    assert (again["a"], again["b"]) == (first, second)
    assert [len(list((tmp_path / folder).iterdir())) for folder in (PICTURES_FOLDER, TOKENS_FOLDER)] == [2, 2]


def test_a_prompt_that_is_written_again_replaces_the_one_before(tmp_path):
    store = PromptStore(tmp_path)
    store.add("a", "old", [png(0)])
    store.add("b", "other", [png(1)])
    store.add("a", "new", [png(0)])
    for each_store in (store, PromptStore(tmp_path)):
        assert {key: each.text for key, each in each_store.prompts.items()} == {"a": "new", "b": "other"}


@pytest.mark.parametrize(("length", "cut"), [(1, 9), (3, 1), (3, 40)])
def test_a_cut_line_of_any_length_is_dropped_and_whole_ones_stay(tmp_path, length, cut):
    store, keys = PromptStore(tmp_path), "abc"[:length]
    for key in keys:
        store.add(key, f"text {key}", [png(0)])
    path = tmp_path / PROMPTS_FILE
    whole = path.read_bytes()
    path.write_bytes(whole[:-cut])
    again = PromptStore(tmp_path)
    assert list(again.prompts) == list(keys[:-1])
    again.add(keys[-1], f"text {keys[-1]}", [png(0)])
    assert path.read_bytes() == whole
    # A line that ends stays, also where nothing was cut off.
    PromptStore(tmp_path).add("d", "text d", [png(0)])
    assert list(PromptStore(tmp_path).prompts) == [*keys, "d"]


def test_folders_of_pictures_are_there_once_and_damaged_files_are_named(tmp_path):
    store = PromptStore(tmp_path)
    prompt = store.add("a", "text", [png(0)], np.zeros((1, 2, 3), np.float16))
    (tmp_path / TOKENS_FOLDER / prompt.tokens).unlink()
    with pytest.raises(InputError, match=prompt.tokens):
        store.tokens(prompt.tokens)
    (tmp_path / PICTURES_FOLDER / prompt.pictures[0]).unlink()
    with pytest.raises(InputError, match="cannot be read; remove"):
        store.picture(prompt.pictures[0])
    # What is gone is written again.
    store.add("b", "text", [png(0)], np.zeros((1, 2, 3), np.float16))
    assert store.tokens(prompt.tokens).shape == (1, 2, 3)
    assert store.picture(prompt.pictures[0]).shape == (48, 64, 3)


@pytest.mark.parametrize(
    "changes",
    [{"tokens": "a/b"}, {"tokens": 3}, *({"pictures": names} for names in ([], [3], [".."], ["a/b.png"]))],
)
def test_names_that_leave_the_folder_are_no_prompt(tmp_path, changes):
    row = {"key": "a", "text": "t", "pictures": ["x.png"], "tokens": "", "space": ""}
    lines = [json.dumps(with_checksum(each)) for each in (row, row | changes)]
    (tmp_path / PROMPTS_FILE).write_text("\n".join(lines) + "\n")
    with pytest.raises(InputError, match="line 2 is no prompt, or damaged"):
        PromptStore(tmp_path)
    (tmp_path / PROMPTS_FILE).write_text("[]\n")
    with pytest.raises(InputError, match="line 1 is no prompt, or damaged"):
        PromptStore(tmp_path)
