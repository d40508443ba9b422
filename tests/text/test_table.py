"""Words of a table, and of a tower: what counts as the same word, and files that are whole, cut or hostile."""

import io
import tracemalloc
import zipfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from text_towers import WORDS, save_graph, save_tokenizer

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.text.models import OnnxTextConfig, OnnxTower, TransformersTextConfig
from gsencoder.text.table import (
    CACHE_VARIABLE,
    REFERENCE_NOUNS,
    TextTable,
    TowerRecord,
    cache_folder,
    cached_vectors,
    check_space,
    load_text_table,
    make_text_table,
    save_text_table,
    unit,
)
from gsencoder.text.vocabulary import OpenVocabulary, find_tower, make_vocabulary, vocabulary_of, words_of_table
from gsencoder.types import FeatureSpace

NAMES = ("mug", "coffee mug", "knife", "glass", "glasses", "cherry", "tennis ball", "golf ball", "box", "scissors")
NAMES += ("T-shirt",)


@pytest.fixture
def table(rng: np.random.Generator) -> TextTable:
    vectors = rng.normal(size=(len(NAMES), 16))
    return make_text_table(NAMES, vectors / np.linalg.norm(vectors, axis=1, keepdims=True), "toy")


def save_npz(path: Path, **arrays: np.ndarray) -> Path:
    np.savez(path, **arrays)
    return path


@pytest.mark.parametrize(
    ("word", "name"),
    [
        ("  MUG\t", "mug"),
        ("mugs", "mug"),
        ("a mug", "mug"),
        ("tennis-ball", "tennis ball"),
        ("knives", "knife"),
        ("boxes", "box"),
        ("glasses", "glasses"),
        ("scissor", "scissors"),
        ("t shirts", "T-shirt"),
        ("ｍｕｇ", "mug"),
    ],
)
def test_simple_variations_mean_the_same_word(table: TextTable, word: str, name: str) -> None:
    row = table.find(word)
    assert table.names[row] == name
    assert np.array_equal(table.encode([word])[0], table.embeddings[NAMES.index(name)])


@pytest.mark.parametrize(
    ("word", "near"), [("knive", "knife"), ("ball", "golf ball"), ("beer mug", "coffee mug"), ("scisors", "scissors")]
)
def test_an_unknown_word_is_an_error_that_names_near_ones(table: TextTable, word: str, near: str) -> None:
    with pytest.raises(InputError, match=f"not among the 11 words of toy: '{word}'.*{near}"):
        table.encode(["mug", word])
    for far, advice in (
        ("qqqq", "no name is near"),
        ("qq qq", "no name .*phrases need a sentence encoder, as in fuse"),
    ):
        with pytest.raises(InputError, match=advice):
            table.encode([far])


@given(st.text(max_size=40))
@settings(deadline=None, max_examples=30)
def test_any_text_is_a_word_of_the_table_or_an_error_of_one_line(word: str) -> None:
    table = make_text_table(("mug", "box"), np.eye(2), "toy")
    known = table.find(word)
    if known is not None:
        assert np.array_equal(table.encode([word])[0], table.embeddings[known])
    else:
        with pytest.raises(InputError, match="not among the 2 words of toy"):
            table.encode([word])


@pytest.mark.parametrize("suffix", [".npz", ".safetensors"])
def test_a_saved_table_reads_back_as_it_was(table: TextTable, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"table{suffix}"
    if suffix == ".npz":
        save_npz(path, names=np.array(NAMES), embeddings=table.embeddings, encoder=np.array("toy"))
    else:
        save_text_table(path, table)
    read = load_text_table(path)
    assert read.names == table.names
    assert read.space == table.space
    np.testing.assert_allclose(read.embeddings, table.embeddings, atol=2e-7)
    np.testing.assert_allclose(read.mean, table.mean, atol=2e-7)


def test_a_table_states_the_names_trained_on_and_so_does_its_file(table: TextTable, tmp_path: Path) -> None:
    assert table.is_trained(NAMES[0]) is None
    trained = replace(table, trained=NAMES[:2])
    save_text_table(tmp_path / "table.safetensors", trained)
    for each in (trained, load_text_table(tmp_path / "table.safetensors")):
        assert each.trained == tuple(NAMES[:2])
        assert [each.is_trained(word) for word in (f"the {NAMES[1]}", NAMES[2], "no such word")] == [True, False, False]
    assert table.trained_on(["the mugs", "mug", "zebra", "box"]).trained == ("mug", "box")
    assert replace(table, trained=()).is_trained(NAMES[0]) is False
    with pytest.raises(InputError, match="expected the names trained on among its .* names, got 'zebra'"):
        replace(table, trained=("zebra",))


def test_a_table_saved_in_half_precision_is_half_as_large_and_has_unit_rows(tmp_path: Path) -> None:
    vectors = np.random.default_rng(0).normal(size=(50, 64)).astype(np.float32)
    table = make_text_table([f"n{i}" for i in range(50)], vectors / np.linalg.norm(vectors, axis=1)[:, None], "toy")
    save_text_table(tmp_path / "full.safetensors", table)
    save_text_table(tmp_path / "half.safetensors", table, dtype="float16")
    assert (tmp_path / "half.safetensors").stat().st_size < 0.6 * (tmp_path / "full.safetensors").stat().st_size
    read = load_text_table(tmp_path / "half.safetensors")
    assert read.names == table.names
    np.testing.assert_allclose(np.linalg.norm(read.embeddings, axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(read.embeddings, table.embeddings, atol=5e-4)
    # An .npz without the name of an encoder is called like its file.
    path = save_npz(tmp_path / "toy_names.npz", names=np.array(table.names), embeddings=np.float16(table.embeddings))
    read = load_text_table(path)
    assert read.space.text_encoder == "toy"
    np.testing.assert_allclose(np.linalg.norm(read.embeddings, axis=1), 1, atol=1e-6)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"names": np.array(["a1"])}, "embeddings is missing"),
        ({"names": np.array(["a1"]), "embeddings": np.ones(3)}, "embeddings: expected 2 axes"),
        ({"names": np.array(["a1", "b1"]), "embeddings": np.eye(3)}, "expected embeddings of"),
        ({"names": np.array(["x", "X "]), "embeddings": np.eye(2)}, "'X ' in row 1 is repeated"),
        ({"names": np.array(["x", ""]), "embeddings": np.eye(2)}, "row 1 is empty"),
        ({"names": np.array(["x", "y"]), "embeddings": np.eye(2) * 3}, "'x' has norm 3"),
        ({"names": np.array(["x", "y"]), "embeddings": np.eye(2) * np.nan}, "finite unit vectors"),
        # Never unpickled.
        ({"names": np.array([{"a": 1}], dtype=object), "embeddings": np.eye(1)}, "names: expected 1 axis of text"),
    ],
)
def test_a_table_that_is_none_says_what_is_wrong(tmp_path, no_jaxtyping, arrays, message):
    path = save_npz(tmp_path / "bad.npz", **arrays)
    with pytest.raises(InputError, match=message) as caught:
        load_text_table(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def npy(shape: tuple[int, ...], data: bytes) -> bytes:
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": "<f4", "fortran_order": False, "shape": shape})
    return head.getvalue() + data


@pytest.mark.parametrize("shape", [(10**9, 10**9), (5, 2), (1, 1)])
def test_a_header_that_claims_another_size_is_refused_before_memory_is_taken(tmp_path, shape):
    path = tmp_path / "bad.npz"
    names = io.BytesIO()
    np.save(names, np.array(["x", "y"]))
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("names.npy", names.getvalue())
        archive.writestr("embeddings.npy", npy(shape, b"\0" * 16))
    with pytest.raises(InputError, match="header claims"):
        load_text_table(path)


@pytest.mark.shared
def test_the_real_table_knows_what_its_names_say(shared: Path) -> None:
    table = load_text_table(shared / "models" / "clip_vitb32_names.npz")
    assert len(table) == 1583
    assert table.space.text_encoder == "clip_vitb32"
    assert np.array_equal(table.encode(["Coffee_Cups"]), table.encode(["coffee cup"]))
    with pytest.raises(InputError, match=r"near: coffee cup.*mug"):
        table.encode(["coffee mug"])
    # Names of such a space all look alike until their mean is removed.
    raw = table.embeddings[:200] @ table.embeddings[:200].T
    centered = table.embeddings[:200] - table.mean
    centered /= np.linalg.norm(centered, axis=1, keepdims=True)
    assert np.median(raw) > 0.65
    assert abs(np.median(centered @ centered.T)) < 0.1


def test_names_longer_than_words_are_refused_before_memory_is_taken(tmp_path: Path) -> None:
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": "<U2000", "fortran_order": False, "shape": (4000,)})
    path = tmp_path / "long.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("names.npy", head.getvalue() + bytes(4000 * 8000))
        archive.writestr("embeddings.npy", npy((4000, 4), bytes(4000 * 16)))
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match="names: entries of 2,000 characters, expected at most 1,000"):
            load_text_table(path)
        assert tracemalloc.get_traced_memory()[1] < 4_000_000
    finally:
        tracemalloc.stop()


def space(encoder: str, channels: int = 4, teacher: str = "") -> FeatureSpace:
    return FeatureSpace(name=f"space-{encoder}", channels=channels, teacher=teacher, text_encoder=encoder)


@pytest.mark.parametrize("text", [space("siglip"), space("clip", channels=5), space("")])
def test_words_of_another_space_are_an_error_that_names_both(text: FeatureSpace) -> None:
    with pytest.raises(InputError) as caught:
        check_space(space("clip", teacher="labels"), text)
    assert "space-clip · 4 channels · labels · clip" in str(caught.value)
    assert text.describe() in str(caught.value)
    check_space(space("clip", teacher="labels"), space("clip"))
    with pytest.raises(InputError, match="it has no text encoder"):
        check_space(space(""), space(""))


def test_truncated_files_are_refused(table: TextTable, tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "t.npz", names=np.array(NAMES), embeddings=table.embeddings)
    save_text_table(tmp_path / "t.safetensors", table)
    for path in (tmp_path / "t.npz", tmp_path / "t.safetensors"):
        whole = path.read_bytes()
        for length in (0, 8, len(whole) // 2, len(whole) - 1):
            path.write_bytes(whole[:length])
            with pytest.raises(InputError):
                load_text_table(path)


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
    own = {"name": tmp_path.name, "identity": tower.identity, "pooling": "mean", "templates": config.templates}
    assert words.record == TowerRecord(kind="onnx", **own)
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
