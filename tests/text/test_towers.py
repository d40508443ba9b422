"""Text towers of transformers beside direct calls of the library, as ONNX files, and folders that do not fit."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
import transformers
from onnx import numpy_helper
from text_towers import CHANNELS, WORDS, save_graph, save_tokenizer
from tokenizers import Tokenizer

from gsencoder.core.errors import InputError
from gsencoder.text.models import OnnxTextConfig, OnnxTower, TransformersTextConfig, TransformersTower, canonical

PHRASES = ("red mug", "a chair", "mug")
SMALL: dict[str, Any] = {"hidden_size": 16, "intermediate_size": 32, "num_hidden_layers": 2, "num_attention_heads": 2}
TEXT = {**SMALL, "vocab_size": len(WORDS), "max_position_embeddings": 12, "eos_token_id": 3, "bos_token_id": 2}
VISION = {**SMALL, "image_size": 8, "patch_size": 4}


def save_words(folder: Path) -> None:
    save_tokenizer(folder / "tokenizer.json")
    tokenizer = transformers.PreTrainedTokenizerFast(
        tokenizer_file=str(folder / "tokenizer.json"), pad_token="[PAD]", unk_token="[UNK]", model_max_length=12
    )
    tokenizer.save_pretrained(folder)


def save_letters(folder: Path) -> None:
    """The tokenizer of SigLIP2, with letters for tokens."""
    letters = ("<pad>", "<eos>", "<bos>", "<unk>", "<mask>", "▁", *"abcdefghijklmnopqrstuvwxyz")
    vocab = {letter: row for row, letter in enumerate(letters)}
    transformers.Siglip2Tokenizer(vocab=vocab, merges=[], model_max_length=12).save_pretrained(folder)


def clip() -> Any:
    config = transformers.CLIPConfig(text_config={**TEXT, "projection_dim": 8}, vision_config=VISION, projection_dim=8)
    return transformers.CLIPModel(config)


def siglip() -> Any:
    config = transformers.SiglipConfig(text_config={**TEXT, "projection_size": 8}, vision_config=VISION)
    return transformers.SiglipModel(config)


def siglip2() -> Any:
    text, vision = {**TEXT, "vocab_size": 32, "projection_size": 8}, {**SMALL, "num_patches": 4, "patch_size": 4}
    return transformers.Siglip2Model(transformers.Siglip2Config(text_config=text, vision_config=vision))


def bert() -> Any:
    return transformers.BertModel(transformers.BertConfig(**TEXT))


@pytest.fixture
def saved(tmp_path: Path) -> Callable[[Callable[[], Any]], tuple[Path, Any]]:
    def save(make: Callable[[], Any]) -> tuple[Path, Any]:
        torch.manual_seed(0)
        model = make().eval()
        model.save_pretrained(tmp_path)
        (save_letters if make is siglip2 else save_words)(tmp_path)
        return tmp_path, model

    return save


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


@pytest.mark.parametrize(("make", "pad"), [(clip, False), (siglip, True), (siglip2, True)])
def test_joint_models_equal_a_direct_call_of_the_library(saved: Any, make: Callable[[], Any], pad: bool) -> None:
    folder, model = saved(make)
    tokenizer = transformers.AutoTokenizer.from_pretrained(folder)
    padding = {"padding": "max_length", "max_length": 12} if pad else {}
    tower = TransformersTower(TransformersTextConfig(model=str(folder)))
    assert tower.channels == 8
    for phrase, vector in zip(PHRASES, tower.embed(PHRASES), strict=True):
        with torch.inference_mode():
            expected = model.get_text_features(**tokenizer(phrase, return_tensors="pt", **padding)).pooler_output[0]
        np.testing.assert_allclose(vector, unit(expected.numpy()), atol=1e-5)


@pytest.mark.parametrize("pooling", ["mean", "cls", "eos"])
def test_sentence_encoders_equal_a_direct_call_with_their_pooling(saved: Any, pooling: str) -> None:
    folder, model = saved(bert)
    tokenizer = transformers.AutoTokenizer.from_pretrained(folder)
    tower = TransformersTower(TransformersTextConfig(model=str(folder), pooling=pooling))  # type: ignore[arg-type]
    with torch.inference_mode():
        tokens = model(**tokenizer(PHRASES[0], return_tensors="pt")).last_hidden_state[0].numpy()
    expected = {"mean": tokens.mean(0), "cls": tokens[0], "eos": tokens[-1]}[pooling]
    np.testing.assert_allclose(tower.embed([PHRASES[0]])[0], unit(expected), atol=1e-5)


def test_a_sentence_encoder_needs_its_pooling_stated(saved: Any) -> None:
    folder, _ = saved(bert)
    with pytest.raises(InputError, match="how token vectors of a bert model become one"):
        TransformersTower(TransformersTextConfig(model=str(folder)))
    (folder / "1_Pooling").mkdir()
    (folder / "1_Pooling" / "config.json").write_text('{"pooling_mode_mean_tokens": true}')
    assert TransformersTower(TransformersTextConfig(model=str(folder))).pooling == "mean"


def test_siglip2_reads_captions_in_lower_case_and_without_punctuation(saved: Any) -> None:
    assert canonical("A red,  Mug!") == "a red mug"
    folder, _ = saved(siglip2)
    tower = TransformersTower(TransformersTextConfig(model=str(folder)))
    np.testing.assert_array_equal(tower.embed(["Red, mug!"]), tower.embed(["red mug"]))


def test_the_identity_follows_weights_and_tokenizer(saved: Any) -> None:
    folder, model = saved(clip)

    def identity() -> str:
        return TransformersTower(TransformersTextConfig(model=str(folder))).identity

    first = identity()
    with torch.no_grad():
        model.text_projection.weight[0, 0] += 1
    model.save_pretrained(folder)
    assert identity() != first


def test_folders_that_do_not_fit_are_one_line(saved: Any) -> None:
    folder, model = saved(clip)

    def problem() -> str:
        with pytest.raises(InputError) as error:
            TransformersTower(TransformersTextConfig(model=str(folder)))
        assert "\n" not in str(error.value)
        return str(error.value)

    save_tokenizer(folder / "tokenizer.json", (*WORDS, "table", "lamp"))
    assert "the tokenizer has 10 tokens and the model 8" in problem()
    for path in folder.glob("tokenizer*"):
        path.unlink()
    assert "the tokenizer is missing; expected tokenizer.json in it" in problem()
    save_words(folder)
    state = {name: value for name, value in model.state_dict().items() if "text_projection" not in name}
    model.save_pretrained(folder, state_dict=state)
    assert "1 are missing (text_projection.weight)" in problem()
    (folder / "model.safetensors").unlink()
    (folder / "pytorch_model.bin").write_bytes(b"pickle")
    assert "has no weights as safetensors, and files of pickles are not opened" in problem()
    (folder / "config.json").write_text('{"model_type": "mystery", "auto_map": {"AutoModel": "code.Model"}}')
    (folder / "code.py").write_text("raise SystemExit('the code of a folder was run')")
    assert "holds no model that transformers reads" in problem()


def test_a_phrase_that_would_be_cut_is_refused(saved: Any) -> None:
    folder, _ = saved(clip)
    tower = TransformersTower(TransformersTextConfig(model=str(folder)))
    with pytest.raises(InputError, match="tokens; the tower takes at most 12"):
        tower.embed(["mug " * 20])
    with pytest.raises(InputError, match="holds no word that its tokenizer knows"):
        tower.embed(["zebra"])


def test_a_model_with_code_of_its_own_is_refused_with_advice(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text('{"model_type": "mystery", "auto_map": {"AutoConfig": "code.Config"}}')
    (tmp_path / "code.py").write_text("raise SystemExit('the code of a folder was run')")
    with pytest.raises(InputError, match="needs Python code of its own, which is never run; give a model of a kind"):
        TransformersTower(TransformersTextConfig(model=str(tmp_path), pooling="mean"))


@pytest.fixture
def onnx_folder(tmp_path: Path) -> Path:
    made = tmp_path / "tower"
    made.mkdir()
    save_graph(made / "model.onnx")
    save_tokenizer(made / "tokenizer.json")
    return made


def table_of(folder: Path) -> np.ndarray:
    return numpy_helper.to_array(onnx.load(folder / "model.onnx").graph.initializer[0])


@pytest.mark.parametrize(("pooling", "rows"), [("mean", [2, 4, 5, 3]), ("cls", [2]), ("eos", [3])])
def test_each_pooling_takes_the_tokens_that_it_names(onnx_folder: Path, pooling: str, rows: list[int]) -> None:
    tower = OnnxTower(OnnxTextConfig(model=str(onnx_folder), pooling=pooling))
    np.testing.assert_allclose(tower.embed(["Red mug"])[0], unit(table_of(onnx_folder)[rows].mean(0)), atol=1e-6)
    assert tower.channels == CHANNELS


def test_a_graph_that_pools_itself_is_taken_at_its_word(onnx_folder: Path) -> None:
    save_graph(onnx_folder / "model.onnx", output="sentence_embedding")
    tower = OnnxTower(OnnxTextConfig(model=str(onnx_folder)))
    assert tower.pooling == "output"
    np.testing.assert_allclose(tower.embed(["red"])[0], unit(table_of(onnx_folder)[[2, 4, 3]].sum(0)), atol=1e-6)


@pytest.mark.parametrize(
    ("mask", "length", "padding"), [(False, "any", 7), (True, 12, 9), (False, 12, 9), (True, "any", 0)]
)
def test_phrases_are_padded_where_the_graph_is_of_one_length_or_cannot_tell(onnx_folder, mask, length, padding):
    """The tokenizer pads to ten tokens, and its graph adds up all of them."""
    save_graph(onnx_folder / "model.onnx", output="sentence_embedding", mask=mask, length=length)
    rows = [2, 4, 3] + [0] * padding
    tower = OnnxTower(OnnxTextConfig(model=str(onnx_folder)))
    np.testing.assert_allclose(tower.embed(["red"])[0], unit(table_of(onnx_folder)[rows].sum(0)), atol=1e-6)


def test_an_output_that_does_not_fit_the_pooling_is_refused_with_its_shape(onnx_folder: Path) -> None:
    with pytest.raises(InputError, match=r"shape \[1, 1, 6\], expected \[1, channels\] for pooling=output"):
        OnnxTower(OnnxTextConfig(model=str(onnx_folder), pooling="output"))
    save_graph(onnx_folder / "model.onnx", output="sentence_embedding")
    with pytest.raises(InputError, match=r"shape \[1, 6\], expected \[1, tokens, channels\] for pooling=mean"):
        OnnxTower(OnnxTextConfig(model=str(onnx_folder), pooling="mean"))


def test_the_pooling_is_read_from_the_files_of_sentence_transformers(onnx_folder: Path) -> None:
    with pytest.raises(InputError, match=r"1_Pooling/config.json.*give text.pooling=mean, cls or eos"):
        OnnxTower(OnnxTextConfig(model=str(onnx_folder)))
    (onnx_folder / "1_Pooling").mkdir()
    (onnx_folder / "1_Pooling" / "config.json").write_text('{"pooling_mode_cls_token": true}')
    assert OnnxTower(OnnxTextConfig(model=str(onnx_folder))).pooling == "cls"


def test_a_layer_behind_the_pooling_is_refused_by_name(onnx_folder: Path) -> None:
    kinds = [{"type": f"sentence_transformers.models.{kind}"} for kind in ("Transformer", "Pooling", "Dense")]
    (onnx_folder / "modules.json").write_text(json.dumps(kinds))
    with pytest.raises(InputError, match="'Dense', which is not supported"):
        OnnxTower(OnnxTextConfig(model=str(onnx_folder)))


def test_the_identity_follows_the_files_and_not_the_folder(onnx_folder: Path, tmp_path: Path) -> None:
    def identity(path: Path, pooling: str = "mean") -> str:
        return OnnxTower(OnnxTextConfig(model=str(path), pooling=pooling)).identity  # type: ignore[arg-type]

    moved = shutil.copytree(onnx_folder, tmp_path / "elsewhere")
    assert identity(onnx_folder) == identity(moved) != identity(onnx_folder, "cls")
    save_graph(moved / "model.onnx", scale=2.0)
    assert identity(onnx_folder) != identity(moved)


def test_a_tokenizer_with_more_tokens_than_the_graph_has_rows_is_refused(onnx_folder: Path) -> None:
    save_tokenizer(onnx_folder / "tokenizer.json", (*WORDS, "table"))
    with pytest.raises(InputError, match=r"does not run on tokens of tokenizer.json .* expected both of one model"):
        OnnxTower(OnnxTextConfig(model=str(onnx_folder), pooling="mean"))


@pytest.mark.parametrize("name", ["model.onnx", "tokenizer.json"])
def test_a_damaged_or_missing_file_is_one_line(onnx_folder: Path, name: str) -> None:
    (onnx_folder / name).write_bytes(b"{broken")
    with pytest.raises(InputError, match=name) as error:
        OnnxTower(OnnxTextConfig(model=str(onnx_folder), pooling="mean"))
    assert "\n" not in str(error.value)
    (onnx_folder / name).unlink()
    with pytest.raises(InputError, match=f"{name} is missing"):
        OnnxTower(OnnxTextConfig(model=str(onnx_folder), pooling="mean"))


def test_what_the_tokenizer_does_not_know_or_would_cut_is_refused(onnx_folder: Path) -> None:
    tower = OnnxTower(OnnxTextConfig(model=str(onnx_folder), pooling="mean"))
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


def test_a_tokenizer_that_breaks_on_a_phrase_is_one_line(onnx_folder: Path) -> None:
    state = json.loads((onnx_folder / "tokenizer.json").read_text())
    del state["model"]["vocab"]["[UNK]"]
    (onnx_folder / "tokenizer.json").write_text(json.dumps(state))
    tower = OnnxTower(OnnxTextConfig(model=str(onnx_folder), pooling="mean"))
    with pytest.raises(InputError, match=r"tokenizer.json cannot read 'zebra': .*UNK"):
        tower.embed(["zebra"])
