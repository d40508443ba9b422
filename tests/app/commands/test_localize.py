"""Where the words of `localize` come from."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gsencoder.app.commands.localize import LocalizeCommandConfig
from gsencoder.app.scenes import MAX_QUERIES_BYTES, load_words, query_words
from gsencoder.core.errors import InputError
from gsencoder.fusion.folder import WORDS_FILE
from gsencoder.text.table import make_text_table, save_text_table
from gsencoder.text.vocabulary import closed_table


def words(**settings: object) -> list[str]:
    config = LocalizeCommandConfig(**settings)  # type: ignore[arg-type]
    return query_words(config.query, config.queries)


def test_words_of_query_and_file_are_asked_once_each_in_order(tmp_path: Path) -> None:
    (tmp_path / "q.txt").write_bytes("\ufeffmug\r\n\n  red ball \nmug\n".encode())
    assert words(query=(" ball", "mug"), queries=str(tmp_path / "q.txt")) == ["ball", "mug", "red ball"]


def test_a_file_of_queries_must_be_a_text_file_of_sensible_size(tmp_path: Path) -> None:
    (tmp_path / "q.txt").write_bytes(b"\n \n")
    with pytest.raises(InputError, match="query= is missing"):
        words(queries=str(tmp_path / "q.txt"))
    (tmp_path / "q.txt").write_bytes(bytes(range(256)))
    with pytest.raises(InputError, match="cannot be read as text"):
        words(queries=str(tmp_path / "q.txt"))
    (tmp_path / "q.txt").write_bytes(b"x" * (MAX_QUERIES_BYTES + 1))
    with pytest.raises(InputError, match="at most 1,048,576 are read"):
        words(queries=str(tmp_path / "q.txt"))


def test_words_that_are_given_are_those_trained_on_that_the_folder_of_the_features_states(tmp_path: Path) -> None:
    table = make_text_table(["mug", "ball"], np.eye(2, dtype=np.float32), "toy")
    words_table = make_text_table(["mug", "cup"], np.eye(2, dtype=np.float32), "toy")
    save_text_table(tmp_path / WORDS_FILE, table.trained_on(["mug", "ball"]))
    save_text_table(tmp_path / "given.safetensors", words_table)
    path = str(tmp_path / "given.safetensors")

    def trained(folder: Path) -> tuple[str, ...] | None:
        return closed_table(load_words(folder, table.space, path)).trained

    assert trained(tmp_path) == ("mug",)
    save_text_table(tmp_path / "given.safetensors", replace(words_table, trained=("cup",)))
    assert trained(tmp_path) == ("cup",)
    # Where the folder states none, or its table is lost or damaged, the words that are given are taken as they are.
    save_text_table(tmp_path / "given.safetensors", words_table)
    (tmp_path / "without").mkdir()
    assert trained(tmp_path / "without") is None
    (tmp_path / WORDS_FILE).write_bytes(b"damaged")
    assert trained(tmp_path) is None
