"""Captions: the best of a pool, and what models generate from their own towers' features, given from outside."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from tiny_vlm import PATCH, SIDE, save_tiny_vlm

from gsencoder.core.errors import InputError
from gsencoder.evaluate.feature_decoder import FeatureDecoder, generate_from_features, retrieve_captions

CAPTIONS = ["a mug", "a chair", "a red box"]
AXES = np.eye(3, 4, dtype=np.float32)


def test_the_best_captions_come_first() -> None:
    cells = np.array([[0.1, 0.9, 0, 0], [0.8, 0, 0, 0.6]], np.float32)
    best = retrieve_captions(cells, CAPTIONS, AXES, count=5)
    assert [caption for caption, _ in best] == ["a chair", "a mug", "a red box"]
    assert [score for _, score in best] == pytest.approx([0.9 / np.sqrt(0.82), 0.8, 0])
    # Of equal ones the first comes first.
    alike = retrieve_captions(np.array([[1, 1, 1, 0]], np.float32), CAPTIONS, AXES, count=2)
    assert [caption for caption, _ in alike] == CAPTIONS[:2]


def test_pools_and_features_that_do_not_fit_are_refused() -> None:
    cells = np.ones((2, 4), np.float32)
    with pytest.raises(InputError, match="got 3 and 2"):
        retrieve_captions(cells, CAPTIONS, AXES[:2])
    with pytest.raises(InputError, match="got 0 and 0"):
        retrieve_captions(cells, [], AXES[:0])
    with pytest.raises(InputError, match="expected finite features"):
        retrieve_captions(cells * np.float32(np.nan), CAPTIONS, AXES)


def enlarge(model: Any, factor: float = 6.0) -> Any:
    """Random weights are so small that models hardly look at what they are given; larger ones look."""
    with torch.no_grad():
        for name, value in model.named_parameters():
            if value.ndim > 1 and "embed_tokens" not in name:
                # Gemma 3 begins with a projection of zeros.
                value.normal_() if not value.any() else value.mul_(factor)
    return model.eval()


@pytest.fixture(scope="module")
def decoder(tmp_path_factory: pytest.TempPathFactory) -> FeatureDecoder:
    pytest.importorskip("transformers")
    folder = tmp_path_factory.mktemp("vlm")
    save_tiny_vlm(folder)
    made = FeatureDecoder(folder)
    enlarge(made.model)
    return made


def picture(seed: int) -> Image.Image:
    return Image.fromarray(np.random.default_rng(seed).integers(0, 256, (SIDE, SIDE, 3), np.uint8))


def tower_of(decoder: FeatureDecoder, inputs: dict[str, Any]) -> torch.Tensor:
    """The tower's own output for the picture of some inputs."""
    with torch.inference_mode():
        return decoder.model.model.vision_model(inputs["pixel_values"][0]).last_hidden_state


def own_answer(decoder: FeatureDecoder, inputs: dict[str, Any]) -> torch.Tensor:
    with torch.inference_mode():
        ids = decoder.model.generate(**inputs, max_new_tokens=12, do_sample=False)
    return ids[:, inputs["input_ids"].shape[1] :]


@pytest.mark.slow
def test_a_model_generates_from_its_towers_features_what_it_generates_from_the_picture(decoder: FeatureDecoder) -> None:
    assert decoder.grid == (SIDE // PATCH, SIDE // PATCH)
    prompt, answers = "what is this ?", []
    for seed in range(2):
        inputs = decoder.inputs(prompt, picture(seed))
        own, tokens = own_answer(decoder, inputs), tower_of(decoder, inputs)
        assert tokens.shape == (1, decoder.grid[0] * decoder.grid[1], 32)
        # Beside a white picture, which alone leads to other words, and beside another picture.
        for others in (decoder.inputs(prompt), decoder.inputs(prompt, picture(99))):
            assert torch.equal(generate_from_features(decoder.model, others, tokens, max_tokens=12), own)
            assert not torch.equal(own_answer(decoder, others), own)
        text = decoder.processor.tokenizer.decode(own[0], skip_special_tokens=True).strip()
        assert decoder.decode(tokens, prompt, max_tokens=12) == [text]
        answers.append(text)
    assert len(set(answers)) > 1


@pytest.mark.slow
def test_views_together_are_decoded_as_one_by_one_and_the_model_stays_as_it_was(decoder: FeatureDecoder) -> None:
    inputs = decoder.inputs("what is this ?", picture(0))
    before = own_answer(decoder, inputs)
    views = torch.cat([tower_of(decoder, decoder.inputs("a", picture(seed))) for seed in range(3)])
    together = decoder.decode(views, "what is this ?", max_tokens=8)
    assert together == [decoder.decode(view[None], "what is this ?", max_tokens=8)[0] for view in views]
    assert decoder.decode(views[:0]) == []
    assert torch.equal(own_answer(decoder, inputs), before)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["llava", "paligemma", "gemma3", "idefics3"])
def test_other_models_take_their_towers_features_too(kind: str) -> None:
    pytest.importorskip("transformers")
    from vision_towers import MAKERS, SIDE

    torch.manual_seed(4)
    made = MAKERS[kind]()
    if kind == "paligemma":
        # Its projector is as wide as that of the published models, unless it is told otherwise.
        made.config.vision_config.projection_dim = made.config.text_config.hidden_size
        made = type(made)(made.config)
    model = enlarge(made)
    pixels = 3 * torch.randn(6, 1, 3, 1, 1) + torch.randn(6, 1, 3, SIDE, SIDE)
    if kind != "idefics3":
        pixels = pixels[:, 0]
    with torch.inference_mode():
        inner = model.model
        tower = inner.vision_tower if hasattr(inner, "vision_tower") else inner.vision_model
        flat = pixels[0] if pixels.ndim == 5 else pixels[:1]
        outputs = tower(flat, output_hidden_states=kind == "llava")
        # LLaVA reads the layer before the last one, without the token of the class.
        tokens = outputs.hidden_states[-2][:, 1:] if kind == "llava" else outputs.last_hidden_state
        ids = torch.tensor([[7, *[3] * model_tokens(model, flat), 8, 9]])
        token_inputs = {"input_ids": ids, "attention_mask": torch.ones_like(ids)}
        if kind in ("paligemma", "gemma3"):
            token_inputs["token_type_ids"] = (ids == 3).long()
        said = (
            model.generate(**token_inputs, pixel_values=each[None], max_new_tokens=10, do_sample=False)
            for each in pixels
        )
        own, *others = (each[:, ids.shape[1] :] for each in said)
    # A picture to which the model says something else.
    different = next(number for number, other in enumerate(others, 1) if not torch.equal(other, own))
    inputs = {**token_inputs, "pixel_values": pixels[different][None]}
    assert torch.equal(generate_from_features(model, inputs, tokens, max_tokens=10), own)


def model_tokens(model: Any, pixels: torch.Tensor) -> int:
    """How many tokens of the language model a picture is."""
    several = pixels[None] if hasattr(model.model, "connector") else pixels
    features = model.get_image_features(several, return_dict=True).pooler_output
    return int(torch.cat([each.reshape(-1, each.shape[-1]) for each in features]).shape[0])


@pytest.mark.slow
def test_features_and_models_that_do_not_fit_are_refused(decoder: FeatureDecoder) -> None:
    for shape in ((1, 15, 32), (1, 16, 31), (2, 16, 32)):
        with pytest.raises(InputError, match=r"takes features \[pictures, patches, channels\] of \(1, 16, 32\)"):
            generate_from_features(decoder.model, decoder.inputs("a"), torch.zeros(shape))
    with pytest.raises(InputError, match="expected finite features"):
        decoder.decode(torch.full((1, 16, 32), torch.nan))
    inputs = {name: value for name, value in decoder.inputs("a").items() if name in ("input_ids", "attention_mask")}
    with pytest.raises(InputError, match="read its tower 0 times"):
        generate_from_features(decoder.model, inputs, torch.zeros(1, 16, 32), max_tokens=2)
    with pytest.raises(InputError, match="got Linear with 0"):
        generate_from_features(torch.nn.Linear(2, 2), {}, torch.zeros(1, 1, 1))


def test_a_missing_library_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(InputError, match=r"needs the package transformers \(pip install 'gsencoder\[teachers\]'\)"):
        FeatureDecoder(tmp_path)
