"""Text towers of transformers: small random models of the true kinds, beside direct calls of the library."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import transformers
from text_towers import WORDS, save_tokenizer

from gsencoder.core.errors import InputError
from gsencoder.text.models import TransformersTextConfig, TransformersTower, canonical

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
    tokenizer = transformers.Siglip2Tokenizer(
        vocab={letter: row for row, letter in enumerate(letters)}, merges=[], model_max_length=12
    )
    tokenizer.save_pretrained(folder)


def clip() -> Any:
    config = transformers.CLIPConfig(text_config={**TEXT, "projection_dim": 8}, vision_config=VISION, projection_dim=8)
    return transformers.CLIPModel(config)


def siglip() -> Any:
    return transformers.SiglipModel(
        transformers.SiglipConfig(text_config={**TEXT, "projection_size": 8}, vision_config=VISION)
    )


def siglip2() -> Any:
    vision = {**SMALL, "num_patches": 4, "patch_size": 4}
    return transformers.Siglip2Model(
        transformers.Siglip2Config(text_config={**TEXT, "vocab_size": 32, "projection_size": 8}, vision_config=vision)
    )


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
