"""Tuning on tokens in the stead of pictures: they replace what the tower gives, and are projected to its channels."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tiny_vlm import PATCH, SIDE
from tuning_pairs import SHORT, make_pairs
from tuning_runs import losses, made, sample, samples

from gsencoder.core.errors import InputError
from gsencoder.train.tune import PairSamples, TunedVlm, open_tuned, save_tuned, tune
from gsencoder.train.vlm import TokenHook, load_adapted, load_processor, tower_layout

pytest.importorskip("peft")
transformers = pytest.importorskip("transformers")

pytestmark = [
    pytest.mark.slow,
    # peft asks models of transformers by an old name.
    pytest.mark.filterwarnings("ignore:`is_gradient_checkpointing`:FutureWarning"),
]

CELLS = SIDE // PATCH


def llava(folder: Path) -> Path:
    """A tiny LLaVA, whose tower has a summary token and is read before its last layer."""
    from tiny_vlm import tokenizer
    from transformers import CLIPImageProcessor, LlavaConfig, LlavaForConditionalGeneration, LlavaProcessor

    words = tokenizer()
    processor = LlavaProcessor(
        image_processor=CLIPImageProcessor(size={"shortest_edge": SIDE}, crop_size={"height": SIDE, "width": SIDE}),
        tokenizer=words,
        patch_size=PATCH,
        vision_feature_select_strategy="default",
        num_additional_image_tokens=1,
        chat_template="{% for m in messages %}{{ m['role'] }}: {% for part in m['content'] %}{% if part['type'] == "
        "'image' %}<image>{% else %}{{ part['text'] }}{% endif %}{% endfor %}</s>{% endfor %}"
        "{% if add_generation_prompt %}assistant:{% endif %}",
    )
    words = processor.tokenizer
    words.add_special_tokens({"additional_special_tokens": ["<image>"]})
    torch.manual_seed(0)
    tower = {"hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 3, "num_attention_heads": 2}
    text = {"hidden_size": 64, "intermediate_size": 128, "num_hidden_layers": 2, "num_attention_heads": 4}
    config = LlavaConfig(
        vision_config={"model_type": "clip_vision_model", "image_size": SIDE, "patch_size": PATCH, **tower},
        text_config={"model_type": "llama", "vocab_size": len(words), "max_position_embeddings": 512, **text},
        image_token_id=words.convert_tokens_to_ids("<image>"),
        vision_feature_layer=-2,
    )
    LlavaForConditionalGeneration(config).eval().save_pretrained(folder)
    processor.save_pretrained(folder)
    return folder


@pytest.mark.parametrize("kind", ["idefics3", "llava"])
def test_tokens_replace_what_the_model_takes_from_its_tower(model: Path, tmp_path: Path, kind: str) -> None:
    """A model that is given its own tower's output on its own grid answers bit for bit as before."""
    folder = model if kind == "idefics3" else llava(tmp_path / "llava")
    config, processor = load_processor(folder)
    layout = tower_layout(config, processor)
    assert layout.grid == (CELLS, CELLS)
    assert layout.channels == 32
    vlm = transformers.AutoModelForImageTextToText.from_pretrained(folder).eval()
    inputs = sample(samples(make_pairs(tmp_path / "prompts", 1, pictures=2), folder)).inputs
    hook = TokenHook(vlm.get_encoder("image"), layout)
    outputs: list[Any] = []
    vlm.get_encoder("image").register_forward_hook(lambda tower, args, output: outputs.append(output))
    with torch.no_grad():
        own = vlm(**inputs).logits
        states = outputs[0].last_hidden_state if layout.layer is None else outputs[0].hidden_states[layout.layer]
        patches = states[:, layout.skipped :]
        assert patches.shape == (2, CELLS**2, 32)
        hook.tokens = patches.clone()
        torch.testing.assert_close(vlm(**inputs).logits, own, rtol=0, atol=0)
        # One other cell changes the answer, and pictures no longer count.
        hook.tokens[0, 5] += 1
        other = vlm(**inputs).logits
        assert not torch.equal(other, own)
        blank = {**inputs, "pixel_values": torch.full_like(inputs["pixel_values"], 0.5)}
        if kind == "idefics3":
            torch.testing.assert_close(vlm(**blank).logits, other, rtol=0, atol=0)
        hook.tokens = patches[:1]
        with pytest.raises(InputError, match="2 pictures of 16 patches with 32 channels"):
            vlm(**inputs)


@pytest.mark.parametrize("channels", [32, 7])
def test_tokens_are_trained_on_and_projected_where_channels_differ(model: Path, tmp_path: Path, channels: int) -> None:
    tokens = np.random.default_rng(0).normal(size=(1, CELLS**2, channels))
    pairs = make_pairs(tmp_path / "prompts", 4, tokens=tokens)
    done = tune(*pairs, model, replace(SHORT, train=replace(SHORT.train, steps=12)), work=made(tmp_path / "work"))
    projection = done.network.projection
    assert (projection is None) == (channels == 32)
    curve = losses(tmp_path / "work")
    assert np.mean(curve[-2:]) < 0.9 * np.mean(curve[:2])
    if projection is not None:
        first = TunedVlm(load_adapted(model, SHORT.lora), done.layout, channels).projection
        assert first is not None
        assert not torch.equal(first.weight, projection.weight)
    save_tuned(made(tmp_path / "out"), done)
    again = open_tuned(tmp_path / "out", model, with_tokens=True)
    one = sample(PairSamples(pairs[0], pairs[1], again.processor, longest=None, seed=0))
    with torch.no_grad():
        torch.testing.assert_close(
            again.network(one.inputs, one.tokens), done.network(one.inputs, one.tokens), rtol=0, atol=0
        )
        other = again.network(one.inputs, None if one.tokens is None else one.tokens + 1)
        assert not torch.equal(other, again.network(one.inputs, one.tokens))
