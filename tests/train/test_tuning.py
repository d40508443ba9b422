"""Tuning: it learns, it goes on after a stop, it does the same on several processes, and what it writes is peft's."""

import errno
import json
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file
from tiny_vlm import PATCH, SIDE
from training_scenes import losses, made, rows, stop_at
from tuning_pairs import SHORT, Pairs, make_pairs, sample, samples

from gsencoder.core.errors import InputError
from gsencoder.train.loop import TRAINING_CHECKPOINT_FILE
from gsencoder.train.tune import (
    IGNORED,
    TERM,
    AnswerObjective,
    PairSamples,
    TuneConfig,
    Tuned,
    TunedVlm,
    TuningBatch,
    TuningSample,
    answer_frame,
    join_pairs,
    open_tuned,
    save_tuned,
    tune,
)
from gsencoder.train.vlm import (
    AdapterConfig,
    TokenHook,
    link_served,
    load_adapted,
    load_processor,
    save_adapters,
    tower_layout,
)

peft = pytest.importorskip("peft")
transformers = pytest.importorskip("transformers")

pytestmark = [
    pytest.mark.slow,
    # peft asks models of transformers by an old name.
    pytest.mark.filterwarnings("ignore:`is_gradient_checkpointing`:FutureWarning"),
]


@pytest.fixture(scope="module")
def tuned(model: Path, pairs: Pairs, tmp_path_factory: pytest.TempPathFactory) -> tuple[Tuned, Path]:
    """A short run, and what it wrote."""
    folder = tmp_path_factory.mktemp("tuned")
    done = tune(*pairs, model, SHORT, work=made(folder / "work"))
    save_tuned(made(folder / "out"), done)
    return done, folder


def test_the_loss_on_twenty_pairs_falls_to_a_tenth(model: Path, pairs: Pairs, tmp_path: Path) -> None:
    lora = AdapterConfig(rank=16, alpha=32.0, dropout=0.0)
    train = replace(SHORT.train, steps=20, batch=20, learning_rate=0.01, warmup=5)
    tune(*pairs, model, TuneConfig(lora=lora, train=train), work=tmp_path)
    curve = losses(tmp_path)
    assert len(pairs[0]) == 20
    assert curve[-1] <= 0.1 * curve[0]


def test_a_run_that_was_cut_off_goes_on_as_if_nothing_had_happened(model: Path, pairs: Pairs, tmp_path: Path) -> None:
    config = replace(SHORT, lora=replace(SHORT.lora, dropout=0.2))
    tune(*pairs, model, config, work=made(tmp_path / "whole"))
    with pytest.raises(KeyboardInterrupt):
        tune(*pairs, model, config, work=made(tmp_path / "cut"), track=stop_at(5))
    assert len(losses(tmp_path / "cut")) == 5
    tune(*pairs, model, config, work=tmp_path / "cut")
    assert rows(tmp_path / "cut") == rows(tmp_path / "whole")
    whole, cut = (load_file(tmp_path / name / TRAINING_CHECKPOINT_FILE) for name in ("whole", "cut"))
    assert whole.keys() == cut.keys()
    for name, value in whole.items():
        np.testing.assert_array_equal(value, cut[name])
    # A checkpoint has the adapters alone.
    assert all("lora_" in name for name in whole)


def test_a_run_with_other_adapters_answers_or_model_is_not_continued(model: Path, pairs: Pairs, tmp_path: Path) -> None:
    short = replace(SHORT, train=replace(SHORT.train, steps=1))
    tune(*pairs, model, short, work=tmp_path)
    with pytest.raises(InputError, match=r"was made with lora\.rank=4, and this run asks lora\.rank=5"):
        tune(*pairs, model, replace(short, lora=replace(SHORT.lora, rank=5)), work=tmp_path)
    others = [replace(pairs[0][0], answers=("no",)), *pairs[0][1:]]
    with pytest.raises(InputError, match="was made with pairs="):
        tune(others, pairs[1], model, short, work=tmp_path)


def test_peft_loads_what_was_written_and_answers_the_same(model: Path, pairs: Pairs, tuned: tuple[Tuned, Path]) -> None:
    done, folder = tuned
    out = folder / "out"
    assert {"adapter_model.safetensors", "adapter_config.json"} <= {path.name for path in out.iterdir()}
    inputs = sample(samples(pairs, model)).inputs
    base = transformers.AutoModelForImageTextToText.from_pretrained(model).eval()
    with torch.no_grad():
        own, plain = done.network(inputs), base(**inputs).logits
        loaded = peft.PeftModel.from_pretrained(base, out).eval()(**inputs).logits
        opened = open_tuned(out, model).network(inputs)
        by_folder = transformers.AutoModelForImageTextToText.from_pretrained(out).eval()(**inputs).logits
    assert not torch.allclose(own, plain, atol=1e-3)
    for other in (loaded, opened, by_folder):
        torch.testing.assert_close(other, own, rtol=0, atol=0)


def test_the_folder_for_servers_is_the_model_with_its_adapters(model, pairs, tuned, tmp_path):
    done, _ = tuned
    save_tuned(tmp_path, done)
    link_served(tmp_path, model)
    moved = tmp_path.rename(tmp_path.with_name("moved"))
    inputs = sample(samples(pairs, model)).inputs
    served = transformers.AutoModelForImageTextToText.from_pretrained(moved / "served").eval()
    with torch.no_grad():
        torch.testing.assert_close(served(**inputs).logits, done.network(inputs), rtol=0, atol=0)
    assert transformers.AutoProcessor.from_pretrained(moved / "served").chat_template
    assert transformers.AutoConfig.from_pretrained(moved / "served").model_type == "idefics3"


def test_weights_in_bfloat16_and_recomputed_activations_train_too(model: Path, pairs: Pairs, tmp_path: Path) -> None:
    train = replace(SHORT.train, steps=3)
    tune(*pairs, model, replace(SHORT, train=train), work=made(tmp_path / "plain"))
    tune(*pairs, model, replace(SHORT, train=train, recompute=True), work=made(tmp_path / "recompute"))
    np.testing.assert_allclose(losses(tmp_path / "recompute"), losses(tmp_path / "plain"), rtol=1e-5)
    half = replace(SHORT, train=replace(train, precision="bfloat16"), base="bfloat16")
    done = tune(*pairs, model, half, work=made(tmp_path / "half"))
    np.testing.assert_allclose(losses(tmp_path / "half"), losses(tmp_path / "plain"), rtol=0.05)
    types = {value.dtype: value.requires_grad for value in done.network.parameters()}
    assert types == {torch.bfloat16: False, torch.float32: True}


def joined(*members: TuningSample) -> TuningBatch:
    return join_pairs(members, padding=0)


def test_prompts_carry_no_loss(model: Path, pairs: Pairs) -> None:
    data = samples(pairs, model)
    one = sample(data, 3)
    processor = load_processor(model)[1]
    answer = one.labels[one.labels != IGNORED]
    assert processor.tokenizer.decode(answer) == f"{data.pairs[3].answers[0]}</s>"
    assert (one.labels[-len(answer) :] == answer).all()
    text = processor.tokenizer.decode(one.inputs["input_ids"][0][: -len(answer)])
    assert data.pairs[3].prompt.text in text
    assert text.endswith("assistant:")
    # The gradient of the loss by the logits is 0 wherever no token of the answer comes next.
    logits = torch.randn(1, len(one.labels), 328, requires_grad=True)

    class Fixed(torch.nn.Module):
        def forward(self, inputs: Any, tokens: Any, keep: torch.Tensor) -> torch.Tensor:
            return logits[:, keep]

    batch = joined(one)
    AnswerObjective(Fixed())(batch)[TERM].backward()
    touched = logits.grad[0].abs().sum(dim=1) > 0
    assert touched.nonzero()[:, 0].tolist() == list(range(len(one.labels) - len(answer) - 1, len(one.labels) - 1))
    assert AnswerObjective(Fixed()).divisors(batch) == {TERM: float(len(answer))}


def test_the_loss_is_that_of_transformers_and_of_its_samples_one_by_one(model: Path, pairs: Pairs) -> None:
    adapted = load_adapted(model, SHORT.lora)
    network = TunedVlm(adapted).eval()
    objective, data = AnswerObjective(network), samples(pairs, model)
    three = [sample(data, number) for number in (0, 1, 13)]
    assert len({len(each.labels) for each in three}) > 1
    with torch.no_grad():
        alone = [objective(joined(each))[TERM].item() for each in three]
        together = objective(joined(*three))[TERM].item()
        first = adapted(**three[0].inputs, labels=three[0].labels[None]).loss.item()
    assert together == pytest.approx(sum(alone), rel=1e-5)
    assert alone[0] / objective.divisors(joined(three[0]))[TERM] == pytest.approx(first, rel=1e-5)


def test_adapters_begin_as_the_model_and_lie_in_the_language_model(model: Path, pairs: Pairs) -> None:
    inputs = sample(samples(pairs, model)).inputs
    base = transformers.AutoModelForImageTextToText.from_pretrained(model).eval()
    adapted = load_adapted(model, SHORT.lora)
    with torch.no_grad():
        torch.testing.assert_close(adapted(**inputs).logits, base(**inputs).logits, rtol=0, atol=0)
    trained = [name for name, value in adapted.named_parameters() if value.requires_grad]
    # Seven linear layers in each of two blocks, with A and B.
    assert len(trained) == 28
    assert all("text_model" in name and "lora_" in name for name in trained)


def test_an_epoch_goes_through_all_pairs_and_all_answers_come_up(model: Path, pairs: Pairs) -> None:
    data = samples(pairs, model)
    first, second = ([data[number].name for number in range(start, start + 20)] for start in (0, 20))
    assert sorted(first) == sorted(second) == sorted(pair.name for pair in pairs[0])
    assert first != second
    one = [replace(pairs[0][0], answers=("red", "green"))]
    data = samples((one, pairs[1]), model)
    assert {len(data[number].labels) for number in range(12)} == {
        len(data.sample(one[0], answer).labels) for answer in ("red", "green")
    }


@pytest.mark.parametrize(
    ("template", "frame"),
    [
        (
            "{% for m in messages %}{{ m['role'] }}: {{ m['content'][-1]['text'] }}</s>{% endfor %}"
            "{% if add_generation_prompt %}assistant:{% endif %}",
            (" ", "</s>"),
        ),
        (
            "{% for m in messages %}<s>{{ m['role'] }}\n{{ m['content'][-1]['text'] }}<pad>\n{% endfor %}"
            "{% if add_generation_prompt %}<s>assistant\n{% endif %}",
            ("", "<pad>"),
        ),
        ("{% for m in messages %}{{ m['content'][-1]['text'] }}{% endfor %} answer:", ("", "</s>")),
    ],
)
def test_answers_end_as_the_chat_template_ends_them(model: Path, template: str, frame: tuple[str, str]) -> None:
    _, processor = load_processor(model)
    processor.chat_template = template
    assert answer_frame(processor) == frame


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
        assert not torch.equal(first.weight, projection.weight)
    save_tuned(made(tmp_path / "out"), done)
    again = open_tuned(tmp_path / "out", model, with_tokens=True)
    one = sample(PairSamples(pairs[0], pairs[1], again.processor, longest=None, seed=0))
    with torch.no_grad():
        answer, other = again.network(one.inputs, one.tokens), again.network(one.inputs, one.tokens + 1)
        torch.testing.assert_close(answer, done.network(one.inputs, one.tokens), rtol=0, atol=0)
        assert not torch.equal(other, answer)


def test_prompts_that_are_longer_than_the_model_takes_are_refused(model: Path, pairs: Pairs) -> None:
    with pytest.raises(InputError, match="tokens with 1 pictures, and the model takes 20; give a smaller choose"):
        samples(pairs, model, longest=20)[0]


def test_a_picture_that_is_gone_ends_the_run_in_a_sentence(model: Path, tmp_path: Path) -> None:
    pairs = make_pairs(tmp_path / "prompts", 2)
    for path in (tmp_path / "prompts" / "pictures").iterdir():
        path.unlink()
    with pytest.raises(InputError, match=r"\.png: cannot be read; remove .*prompts to prepare it again"):
        tune(*pairs, model, SHORT, work=made(tmp_path / "work"))


def copied(model: Path, folder: Path, *without: str) -> Path:
    made(folder)
    for path in model.iterdir():
        if path.name not in without:
            (folder / path.name).write_bytes(path.read_bytes())
    return folder


def test_models_that_cannot_be_used_are_refused_in_a_line(model: Path, tmp_path: Path) -> None:
    from transformers import LlamaConfig, LlamaForCausalLM

    pickled = copied(model, tmp_path / "pickled", "model.safetensors")
    (pickled / "pytorch_model.bin").write_bytes(b"\x80\x04.")
    bare = copied(model, tmp_path / "bare", "processor_config.json")
    silent = copied(model, tmp_path / "silent", "chat_template.jinja")
    cut = copied(model, tmp_path / "cut", "chat_template.jinja")
    template = (model / "chat_template.jinja").read_text()
    (cut / "chat_template.jinja").write_text(template[: len(template) // 2])
    text = tmp_path / "text"
    shape = {"hidden_size": 16, "intermediate_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2}
    LlamaForCausalLM(LlamaConfig(vocab_size=32, **shape)).save_pretrained(text)
    coded = copied(model, tmp_path / "coded", "config.json")
    own = {"model_type": "unheard_of", "auto_map": {"AutoConfig": "code.C"}}
    (coded / "config.json").write_text(json.dumps(own))
    for folder, message in (
        (pickled, "has no weights as safetensors, and files of pickles are not opened"),
        (bare, "processor"),
        (silent, "no chat template"),
        (cut, "its chat template cannot be used"),
        (text, "a model of the kind llama takes no pictures with its text"),
        (coded, "Python code of its own"),
    ):
        with pytest.raises(InputError, match=message) as refused:
            load_processor(folder)
        assert "\n" not in str(refused.value)
        assert str(folder) in str(refused.value)


def test_without_peft_a_sentence_says_so(model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "peft", None)
    with pytest.raises(InputError, match=r"needs the package peft \(pip install 'gsencoder\[tune\]'\)"):
        load_adapted(model, SHORT.lora)


class Broken:
    """Something whose files cannot be written."""

    peft_config: ClassVar[dict[str, Any]] = {}

    def __init__(self, error: Exception) -> None:
        self.error = error

    def save_pretrained(self, folder: str) -> None:
        raise self.error


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (OSError(errno.EACCES, "Permission denied", "x/a.json"), "x/a.json: cannot write: Permission denied"),
        (Exception("Input/output error (os error 5)"), r"adapters: cannot write: Input/output error \(os error 5\)$"),
    ],
)
def test_adapters_that_cannot_be_written_are_a_named_error(tmp_path: Path, error: Exception, message: str) -> None:
    with pytest.raises(InputError, match=message):
        save_adapters(tmp_path / "adapters", Broken(error), Broken(error))


def test_layers_are_written_in_order_whatever_the_hashes_of_a_process_are(tmp_path: Path) -> None:
    # Peft holds them as a set.
    names = {f"layers.{number}.{part}_proj" for number in range(8) for part in "qkvo"}
    settings = SimpleNamespace(target_modules=names)
    written: list[list[str]] = []
    save = lambda _: written.append([*settings.target_modules])  # noqa: E731
    adapted = SimpleNamespace(peft_config={"default": settings}, save_pretrained=save)
    save_adapters(tmp_path, adapted, SimpleNamespace(save_pretrained=lambda _: None))
    assert written == [sorted(names)]
