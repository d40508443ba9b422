"""Vocabularies without end: names of a table at once, any other phrase by the tower, and neither without it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from text_towers import WORDS, save_graph, save_tokenizer

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.text.models import OnnxTextConfig, OnnxTower, TransformersTextConfig
from gsencoder.text.table import (
    CACHE_VARIABLE,
    REFERENCE_NOUNS,
    TowerRecord,
    cache_folder,
    cached_vectors,
    load_text_table,
    make_text_table,
    save_text_table,
    unit,
)
from gsencoder.text.vocabulary import OpenVocabulary, find_tower, make_vocabulary, vocabulary_of, words_of_table


class HashTower:
    """A vector of normal noise for each phrase, drawn by its letters; counts what it is asked."""

    name, identity, pooling, channels = "hash", "onnx:0123456789abcdef", "mean", 16
    lower = False

    def __init__(self) -> None:
        self.asked: list[str] = []

    def embed(self, phrases: Sequence[str]) -> np.ndarray:
        self.asked += phrases
        seeds = [np.frombuffer(phrase.encode(), np.uint8).astype(np.uint32) for phrase in phrases]
        return unit(np.stack([np.random.default_rng(seed).normal(size=self.channels) for seed in seeds]))


@pytest.fixture(autouse=True)
def no_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, "off")


@pytest.fixture
def tower() -> HashTower:
    return HashTower()


def vocabulary(tower: HashTower, *names: str, templates: tuple[str, ...] = ("{}",)) -> OpenVocabulary:
    return make_vocabulary(tower, "onnx", names, templates=templates)


def test_names_come_from_the_table_and_phrases_from_the_tower(tower: HashTower) -> None:
    words = vocabulary(tower, "zebra crossing")
    tower.asked.clear()
    vectors = words.encode(["Mugs", "zebra crossing", "something to sit on"])
    assert tower.asked == ["something to sit on"]
    expected = HashTower().embed(["mug", "zebra crossing", "something to sit on"])
    np.testing.assert_allclose(vectors, expected, atol=1e-6)


def test_the_mean_does_not_depend_on_further_names(tower: HashTower) -> None:
    np.testing.assert_array_equal(vocabulary(tower).mean, vocabulary(tower, "zebra", "okapi").mean)
    expected = HashTower().embed(REFERENCE_NOUNS).mean(0)
    np.testing.assert_allclose(vocabulary(tower).mean, expected, atol=1e-6)


def test_a_table_comes_back_from_its_file_with_the_record_of_its_tower(tower: HashTower, tmp_path: Path) -> None:
    words = vocabulary(tower, templates=("a {}", "the {}"))
    save_text_table(tmp_path / "words.safetensors", words.table)
    table = load_text_table(tmp_path / "words.safetensors")
    assert table.tower == words.record
    assert table.tower.templates == ("a {}", "the {}")


def test_without_the_tower_its_words_work_and_an_error_says_what_to_get(tower, monkeypatch):
    monkeypatch.delenv("GSENCODER_MODELS", raising=False)
    words = words_of_table(vocabulary(tower).table)
    assert words.encode(["mug"]).shape == (1, 16)
    with pytest.raises(InputError) as error:
        words.encode(["mug", "mug with a handle"])
    message = str(error.value)
    assert f"'mug with a handle': not among the {len(REFERENCE_NOUNS)} words stored with these features" in message
    assert "'hash' (onnx:0123456789abcdef); put its folder into GSENCODER_MODELS or give text=onnx" in message
    assert "known without it: handle, mug, …" in message


def test_the_record_of_a_tower_has_a_known_kind_and_short_texts(no_jaxtyping: None) -> None:
    good: dict[str, Any] = {"kind": "onnx", "name": "n", "identity": "i", "pooling": "p" * 1000}
    TowerRecord(**good)
    for wrong in ({"name": ""}, {"identity": 5}, {"pooling": "p" * 1001}, {"kind": "table"}):
        with pytest.raises(InputError, match="expected a kind among onnx, transformers, a name"):
            TowerRecord(**{**good, **wrong})


@pytest.mark.parametrize("config", [OnnxTextConfig, TransformersTextConfig])
def test_a_template_needs_one_place_for_the_phrase(config: type) -> None:
    for wrong in ((), ("a photo",), ("{} and {}",)):
        with pytest.raises(InputError, match="templates: expected"):
            config(templates=wrong)


def test_a_tower_is_recognized_by_its_files_in_a_folder_of_another_name(tmp_path, monkeypatch):
    for name, scale in (("another", 2.0), ("renamed", 1.0)):
        (tmp_path / name).mkdir()
        save_graph(tmp_path / name / "model.onnx", scale=scale)
        save_tokenizer(tmp_path / name / "tokenizer.json")
    (tmp_path / "of_something_else").mkdir()
    original = OnnxTower(OnnxTextConfig(model=str(tmp_path / "renamed"), pooling="mean"))
    record = TowerRecord(kind="onnx", name="original", identity=original.identity, pooling=original.pooling)
    monkeypatch.setenv("GSENCODER_MODELS", str(tmp_path))
    assert find_tower(record).name == "renamed"


def test_a_tower_that_did_not_make_the_words_is_refused(tower: HashTower, tmp_path: Path) -> None:
    save_graph(tmp_path / "model.onnx")
    save_tokenizer(tmp_path / "tokenizer.json")
    config = OnnxTextConfig(model=str(tmp_path), pooling="mean")
    with pytest.raises(InputError, match=r"were made by 'hash' \(onnx:0123456789abcdef\), and this is"):
        words_of_table(vocabulary(tower).table, config)
    with pytest.raises(InputError, match="were made by 'onnx:0123456789abcdef'"):
        words_of_table(make_text_table(("mug",), np.eye(1, 16), tower.identity), config)


@pytest.mark.parametrize(
    ("phrase", "problem"),
    [
        (" \t\n", "is empty"),
        ("🙂🙂", "holds no letter and no digit"),
        ("?!", "holds no letter and no digit"),
        ("x" * 100_000, "has 100,000 characters; expected at most 1,000"),
    ],
)
def test_what_is_no_phrase_is_refused(tower: HashTower, phrase: str, problem: str) -> None:
    with pytest.raises(InputError, match=problem) as error:
        vocabulary(tower).encode([phrase])
    assert len(str(error.value)) < 300


def test_vectors_that_are_not_finite_are_refused(tower: HashTower, monkeypatch: pytest.MonkeyPatch) -> None:
    words = vocabulary(tower)
    monkeypatch.setattr(tower, "embed", lambda phrases: np.full((len(phrases), 16), np.nan, np.float32))
    with pytest.raises(InputError, match=r"hash: its vectors are not finite"):
        words.encode(["something new"])


def test_the_cache_answers_what_was_asked_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    tower = HashTower()

    def ask(*phrases: str) -> np.ndarray:
        return cached_vectors("identity", ("{}",), phrases, tower.embed)

    first = ask("mug", "chair", "mug")
    second = ask("chair", "table", "mug")
    assert tower.asked == ["mug", "chair", "table"]
    np.testing.assert_array_equal(first[[1, 2]], second[[0, 2]])
    cached_vectors("other identity", ("{}",), ["mug"], tower.embed)
    cached_vectors("identity", ("a {}",), ["mug"], tower.embed)
    assert tower.asked[3:] == ["mug", "mug"]


def test_the_cache_lies_where_the_user_says_or_among_the_caches_of_the_user(tmp_path, monkeypatch):
    assert cache_folder() is None
    monkeypatch.chdir(tmp_path)
    cached_vectors("identity", ("{}",), ["mug"], HashTower().embed)
    assert not list(tmp_path.iterdir())
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "mine"))
    assert cache_folder() == tmp_path / "mine" / "text"
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.delenv(CACHE_VARIABLE)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    assert cache_folder() == tmp_path / "home" / ".cache" / "gsencoder" / "text"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "caches"))
    assert cache_folder() == tmp_path / "caches" / "gsencoder" / "text"


def test_a_cache_that_cannot_be_written_is_a_warning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "file"))
    with pytest.warns(SceneWarning, match=f"text vectors are not cached: .*{CACHE_VARIABLE}=off turns the cache off"):
        made = cached_vectors("identity", ("{}",), ["mug"], HashTower().embed)
    np.testing.assert_array_equal(made, HashTower().embed(["mug"]))


def test_a_vocabulary_is_made_of_the_tower_and_the_templates_of_its_settings(tmp_path: Path) -> None:
    save_tokenizer(tmp_path / "tokenizer.json", (*WORDS[:4], "the", *sorted(set(" ".join(REFERENCE_NOUNS).split()))))
    save_graph(tmp_path / "model.onnx", rows=1000)
    config = OnnxTextConfig(model=str(tmp_path), pooling="mean", templates=("{} door", "the {}"))
    words, tower = vocabulary_of(config, ["lamp chair"]), OnnxTower(config)
    assert words.record == TowerRecord(
        kind="onnx", name=tmp_path.name, identity=tower.identity, pooling="mean", templates=config.templates
    )
    assert words.table.names == (*REFERENCE_NOUNS, "lamp chair")
    expected = unit(tower.embed(["lamp chair door"]) + tower.embed(["the lamp chair"]))
    np.testing.assert_allclose(words.table.embeddings[-1:], expected, atol=1e-6)


def test_a_damaged_cache_is_replaced_with_a_warning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    tower = HashTower()
    made = cached_vectors("identity", ("{}",), ["mug"], tower.embed)
    (file,) = (tmp_path / "text").iterdir()
    damaged = bytearray(file.read_bytes())
    damaged[-1] ^= 1
    file.write_bytes(damaged)
    with pytest.warns(SceneWarning, match="cached text vectors are computed again"):
        again = cached_vectors("identity", ("{}",), ["mug"], tower.embed)
    np.testing.assert_array_equal(made, again)
    assert cached_vectors("identity", ("{}",), ["mug"], lambda missing: pytest.fail("asked")).shape == (1, 16)
