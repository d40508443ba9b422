"""Text towers as ONNX files: the shared MiniLM, small graphs that are made here, and folders that do not fit."""

import json
import shutil
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import numpy_helper
from text_towers import CHANNELS, WORDS, save_graph, save_tokenizer
from tokenizers import Tokenizer

from gsencoder.core.errors import InputError
from gsencoder.text.models import OnnxTextConfig, OnnxTower


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "tower"
    made.mkdir()
    save_graph(made / "model.onnx")
    save_tokenizer(made / "tokenizer.json")
    return made


def table_of(folder: Path) -> np.ndarray:
    model = onnx.load(folder / "model.onnx")
    return numpy_helper.to_array(model.graph.initializer[0])


def unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


@pytest.mark.parametrize(("pooling", "rows"), [("mean", [2, 4, 5, 3]), ("cls", [2]), ("eos", [3])])
def test_each_pooling_takes_the_tokens_that_it_names(folder: Path, pooling: str, rows: list[int]) -> None:
    tower = OnnxTower(OnnxTextConfig(model=str(folder), pooling=pooling))
    np.testing.assert_allclose(tower.embed(["Red mug"])[0], unit(table_of(folder)[rows].mean(0)), atol=1e-6)
    assert tower.channels == CHANNELS


def test_a_graph_that_pools_itself_is_taken_at_its_word(folder: Path) -> None:
    save_graph(folder / "model.onnx", output="sentence_embedding")
    tower = OnnxTower(OnnxTextConfig(model=str(folder)))
    assert tower.pooling == "output"
    np.testing.assert_allclose(tower.embed(["red"])[0], unit(table_of(folder)[[2, 4, 3]].sum(0)), atol=1e-6)


@pytest.mark.parametrize(
    ("mask", "length", "padding"), [(False, "any", 7), (True, 12, 9), (False, 12, 9), (True, "any", 0)]
)
def test_phrases_are_padded_where_the_graph_is_of_one_length_or_cannot_tell(folder, mask, length, padding):
    """The tokenizer pads to ten tokens, and its graph adds up all of them."""
    save_graph(folder / "model.onnx", output="sentence_embedding", mask=mask, length=length)
    rows = [2, 4, 3] + [0] * padding
    tower = OnnxTower(OnnxTextConfig(model=str(folder)))
    np.testing.assert_allclose(tower.embed(["red"])[0], unit(table_of(folder)[rows].sum(0)), atol=1e-6)


def test_an_output_that_does_not_fit_the_pooling_is_refused_with_its_shape(folder: Path) -> None:
    with pytest.raises(InputError, match=r"shape \[1, 1, 6\], expected \[1, channels\] for pooling=output"):
        OnnxTower(OnnxTextConfig(model=str(folder), pooling="output"))
    save_graph(folder / "model.onnx", output="sentence_embedding")
    with pytest.raises(InputError, match=r"shape \[1, 6\], expected \[1, tokens, channels\] for pooling=mean"):
        OnnxTower(OnnxTextConfig(model=str(folder), pooling="mean"))


def test_the_pooling_is_read_from_the_files_of_sentence_transformers(folder: Path) -> None:
    with pytest.raises(InputError, match=r"1_Pooling/config.json.*give text.pooling=mean, cls or eos"):
        OnnxTower(OnnxTextConfig(model=str(folder)))
    (folder / "1_Pooling").mkdir()
    (folder / "1_Pooling" / "config.json").write_text('{"pooling_mode_cls_token": true, "word_embedding_dimension": 6}')
    assert OnnxTower(OnnxTextConfig(model=str(folder))).pooling == "cls"


def test_a_layer_behind_the_pooling_is_refused_by_name(folder: Path) -> None:
    kinds = ["Transformer", "Pooling", "Dense"]
    (folder / "modules.json").write_text(json.dumps([{"type": f"sentence_transformers.models.{k}"} for k in kinds]))
    with pytest.raises(InputError, match="'Dense', which is not supported"):
        OnnxTower(OnnxTextConfig(model=str(folder)))


def test_the_identity_follows_the_files_and_not_the_folder(folder: Path, tmp_path: Path) -> None:
    def identity(path: Path, pooling: str = "mean") -> str:
        return OnnxTower(OnnxTextConfig(model=str(path), pooling=pooling)).identity  # type: ignore[arg-type]

    moved = shutil.copytree(folder, tmp_path / "elsewhere")
    assert identity(folder) == identity(moved) != identity(folder, "cls")
    save_graph(moved / "model.onnx", scale=2.0)
    assert identity(folder) != identity(moved)


def test_a_tokenizer_with_more_tokens_than_the_graph_has_rows_is_refused(folder: Path) -> None:
    save_tokenizer(folder / "tokenizer.json", (*WORDS, "table"))
    with pytest.raises(InputError, match=r"does not run on tokens of tokenizer.json .* expected both of one model"):
        OnnxTower(OnnxTextConfig(model=str(folder), pooling="mean"))


@pytest.mark.parametrize("name", ["model.onnx", "tokenizer.json"])
def test_a_damaged_or_missing_file_is_one_line(folder: Path, name: str) -> None:
    (folder / name).write_bytes(b"{broken")
    with pytest.raises(InputError, match=name) as error:
        OnnxTower(OnnxTextConfig(model=str(folder), pooling="mean"))
    assert "\n" not in str(error.value)
    (folder / name).unlink()
    with pytest.raises(InputError, match=f"{name} is missing"):
        OnnxTower(OnnxTextConfig(model=str(folder), pooling="mean"))


def test_what_the_tokenizer_does_not_know_or_would_cut_is_refused(folder: Path) -> None:
    tower = OnnxTower(OnnxTextConfig(model=str(folder), pooling="mean"))
    with pytest.raises(InputError, match="'zebra': holds no word that its tokenizer knows"):
        tower.embed(["zebra"])
    with pytest.raises(InputError, match="'red zebra': its tokenizer does not know 1 of its 2 parts"):
        tower.embed(["red zebra"])
    # The name of a special token in a phrase is text.
    with pytest.raises(InputError, match="tokenizer"):
        tower.embed(["[SEP]"])
    with pytest.raises(InputError, match="has 14 tokens; the tower takes at most 10"):
        tower.embed(["red " * 12])


def test_the_shared_sentence_encoder_equals_a_direct_call(shared: Path) -> None:
    import onnxruntime

    path = shared / "models" / "minilm_l6"
    tower = OnnxTower(OnnxTextConfig(model=str(path), pooling="mean"))
    tokenizer = Tokenizer.from_file(str(path / "tokenizer.json"))
    tokenizer.no_padding()
    session = onnxruntime.InferenceSession(str(path / "model.onnx"), providers=["CPUExecutionProvider"])
    phrases = ["mug", "something to sit on"]
    for phrase, vector in zip(phrases, tower.embed(phrases), strict=True):
        encoded = tokenizer.encode(phrase)
        ids, mask = (np.array([values]) for values in (encoded.ids, encoded.attention_mask))
        tokens = session.run(None, {"input_ids": ids, "attention_mask": mask, "token_type_ids": np.zeros_like(ids)})[0]
        np.testing.assert_allclose(vector, unit(tokens[0].mean(0)), atol=1e-5)


def test_a_phrase_has_one_vector_whatever_stands_beside_it(shared: Path) -> None:
    tower = OnnxTower(OnnxTextConfig(model=str(shared / "models" / "minilm_l6"), pooling="mean"))
    together = tower.embed(["mug", "the long table by the window", "chair"])
    np.testing.assert_array_equal(together[0], tower.embed(["mug"])[0])


def test_a_tokenizer_that_breaks_on_a_phrase_is_one_line(folder: Path) -> None:
    state = json.loads((folder / "tokenizer.json").read_text())
    del state["model"]["vocab"]["[UNK]"]
    (folder / "tokenizer.json").write_text(json.dumps(state))
    tower = OnnxTower(OnnxTextConfig(model=str(folder), pooling="mean"))
    with pytest.raises(InputError, match=r"tokenizer.json cannot read 'zebra': .*UNK"):
        tower.embed(["zebra"])
