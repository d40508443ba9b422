"""Low-rank adapters of a vision-language model on rendered features: samples, loss and training.

The prompt goes through the model's processor and chat template, as a server puts it together; the answer follows, and
the token that ends the model's turn. Labels are the answer's tokens alone, so that the prompt carries no loss.
"""

import inspect
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int64
from PIL import Image
from torch import Tensor, nn
from torch.utils.data import Dataset

from gsencoder.core.archive import open_archive, write_archive
from gsencoder.core.errors import InputError
from gsencoder.core.files import plain, warn_if_modified
from gsencoder.core.pretrained import load_pretrained
from gsencoder.core.process import ProcessRank, Track, untracked
from gsencoder.core.settings import option
from gsencoder.data.prompts import PromptStore, StoredPrompt
from gsencoder.train.distributed import check_agreement
from gsencoder.train.loop import Trainer, TrainerConfig, TrainingState
from gsencoder.train.vlm import (
    LABEL,
    SPLIT,
    AdapterConfig,
    TokenHook,
    TowerLayout,
    check_peft,
    load_adapted,
    load_processor,
    model_digest,
    quiet_peft,
    save_adapters,
    tower_layout,
)

IGNORED = -100
"""The label of tokens without a loss."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TuningPair:
    """A question of a store of prompts, and one or more right answers, of which an epoch takes one."""

    name: str
    prompt: StoredPrompt
    answers: tuple[str, ...]


class TuningSample(NamedTuple):
    """A pair as tensors: the model's inputs with one row each, where what has the shape of `input_ids` reaches to the
    answer's end; labels, which are `IGNORED` in the prompt; and rendered features of its pictures, or None."""

    name: str
    inputs: dict[str, Tensor]
    labels: Int64[Tensor, "T"]
    tokens: Float[Tensor, "V P D"] | None


class TuningBatch(NamedTuple):
    """Samples of the questions `names`, padded on the right; labels [B, T] are `IGNORED` in prompts and padding, and
    tokens [pictures, P, D] are those of all samples in their order."""

    names: tuple[str, ...]
    inputs: dict[str, Tensor]
    labels: Tensor
    tokens: Tensor | None


def chat(text: str, pictures: Sequence[Any], answer: str | None = None) -> list[dict[str, Any]]:
    """The messages of a prompt, pictures before words as `ask` sends them, and those of an answer."""
    content = [*({"type": "image", "image": each} for each in pictures), {"type": "text", "text": text}]
    messages: list[dict[str, Any]] = [{"role": "user", "content": content}]
    if answer is not None:
        messages.append({"role": "assistant", "content": [{"type": "text", "text": answer}]})
    return messages


def answer_frame(processor: Any) -> tuple[str, str]:
    """What stands before and after an answer in the model's turn: blanks, and the token that ends it."""
    tokenizer, probe = processor.tokenizer, "answer"
    prompt = processor.apply_chat_template(chat("question", []), add_generation_prompt=True, tokenize=False)
    dialog = processor.apply_chat_template(chat("question", [], probe), add_generation_prompt=False, tokenize=False)
    before, after = "", ""
    if dialog.startswith(prompt) and probe in (rest := dialog[len(prompt) :]):
        before, _, after = rest.partition(probe)
    if before.strip():
        before = ""
    for token in sorted(tokenizer.all_special_tokens, key=len, reverse=True):
        if after.startswith(token):
            return before, token
    if not tokenizer.eos_token:
        raise InputError(
            "tune: the model's chat template and tokenizer have no token that ends an answer; expected eos_token in "
            "tokenizer_config.json"
        )
    return before, tokenizer.eos_token


class PairSamples(Dataset[TuningSample]):
    """Pairs by number of the sample; each epoch goes through all in a new order, and takes one answer of each."""

    def __init__(
        self, pairs: Sequence[TuningPair], store: PromptStore, processor: Any, *, longest: int | None, seed: int
    ) -> None:
        self.pairs, self._store, self._processor = tuple(pairs), store, processor
        self._longest, self._seed = longest, seed
        self._frame = answer_frame(processor)

    def __getitem__(self, number: int) -> TuningSample:
        epoch, position = divmod(number, len(self.pairs))
        chosen = int(np.random.default_rng([self._seed, 0, epoch]).permutation(len(self.pairs))[position])
        pair = self.pairs[chosen]
        answer = pair.answers[int(np.random.default_rng([self._seed, 1, number]).integers(len(pair.answers)))]
        return self.sample(pair, answer)

    def sample(self, pair: TuningPair, answer: str) -> TuningSample:
        """A pair as tensors."""
        prompt = pair.prompt
        pictures = [Image.fromarray(self._store.picture(name)) for name in prompt.pictures]
        try:
            inputs = dict(
                self._processor.apply_chat_template(
                    chat(prompt.text, pictures),
                    add_generation_prompt=True,
                    tokenize=True,
                    return_dict=True,
                    return_tensors="pt",
                )
            )
        except Exception as error:  # processors and templates raise whatever they like
            message = " ".join(str(error).split())[:160]
            raise InputError(f"{pair.name}: the model's processor refuses the prompt: {message}") from error
        before, end = self._frame
        target = self._processor.tokenizer(before + answer.strip() + end, add_special_tokens=False)["input_ids"]
        ids, added = inputs["input_ids"], torch.tensor(target)[None]
        total = ids.shape[1] + len(target)
        if self._longest is not None and total > self._longest:
            raise InputError(
                f"{pair.name}: {total:,} tokens with {len(pictures)} pictures, and the model takes {self._longest:,}; "
                "give a smaller choose.count="
            )
        for name, value in inputs.items():
            if value.shape == ids.shape:
                tail = added if name == "input_ids" else torch.full_like(added, int(name == "attention_mask"))
                inputs[name] = torch.cat((value, tail.to(value.dtype)), dim=1)
        labels = torch.cat((torch.full((ids.shape[1],), IGNORED), added[0]))
        tokens = torch.from_numpy(self._store.tokens(prompt.tokens).astype(np.float32)) if prompt.tokens else None
        return TuningSample(name=pair.name, inputs=inputs, labels=labels, tokens=tokens)


def join_pairs(samples: Sequence[TuningSample], *, padding: int) -> TuningBatch:
    """Joins samples to a batch; shorter ones are filled up with the token `padding`, masked and without a loss."""
    fills: Mapping[str, int] = {"input_ids": padding}
    inputs = {name: _stacked([each.inputs[name] for each in samples], fills.get(name, 0)) for name in samples[0].inputs}
    tokens = [each.tokens for each in samples if each.tokens is not None]
    return TuningBatch(
        names=tuple(each.name for each in samples),
        inputs=inputs,
        labels=_stacked([each.labels[None] for each in samples], IGNORED),
        tokens=torch.cat(tokens) if tokens else None,
    )


def _stacked(values: Sequence[Tensor], fill: int) -> Tensor:
    """Rows of several tensors, whose other axes are filled up at their ends to the longest."""
    sizes = [max(value.shape[axis] for value in values) for axis in range(1, values[0].ndim)]
    padded = []
    for value in values:
        missing = [size - have for size, have in zip(sizes, value.shape[1:], strict=True)]
        pads = [pad for size in reversed(missing) for pad in (0, size)]
        padded.append(torch.nn.functional.pad(value, pads, value=fill) if any(missing) else value)
    return torch.cat(padded)


TERM = "answer"


class TunedVlm(nn.Module):
    """A vision-language model under adapters, the `peft.PeftModel` `adapted`, with rendered features in the place of
    its tower's output or without. A projection leads from their channels to those of the tower where these differ."""

    def __init__(
        self, adapted: Any, layout: TowerLayout | None = None, channels: int | None = None, *, seed: int = 0
    ) -> None:
        """The `layout` is that of the tower's output, None where the model looks at pictures; `channels` those of
        features that are projected."""
        super().__init__()
        self.adapted = adapted
        self.projection: nn.Linear | None = None
        model = adapted.get_base_model()
        self._hook = None if layout is None else TokenHook(model.get_encoder("image"), layout)
        if layout is not None and channels is not None:
            torch.manual_seed(seed)
            self.projection = nn.Linear(channels, layout.channels)
        self._keeps = "logits_to_keep" in inspect.signature(model.forward).parameters

    def forward(
        self,
        inputs: dict[str, Tensor],
        tokens: Float[Tensor, "n P D"] | None = None,
        keep: Int64[Tensor, " K"] | None = None,
    ) -> Float[Tensor, "B K vocabulary"]:
        """Logits of the positions `keep`, or of all. `inputs` are as the model's processor gives them, and `tokens` are
        rendered features of the pictures, in their order."""
        options = {} if keep is None or not self._keeps else {"logits_to_keep": keep}
        if self._hook is not None and tokens is not None:
            self._hook.tokens = tokens if self.projection is None else self.projection(tokens)
        try:
            logits: Tensor = self.adapted(**inputs, use_cache=False, **options).logits
        finally:
            if self._hook is not None:
                self._hook.tokens = None
        return logits if keep is None or self._keeps else logits[:, keep]


class AnswerObjective:
    """The loss of answers: Σ −log p(token | all before it) over the answers' tokens, divided by their number in a step,
    so that a long answer counts for more than a short one, and padding for nothing."""

    advice = "the answers"
    lambdas = {TERM: 1.0}  # noqa: RUF012 - a constant of the protocol

    def __init__(self, network: nn.Module) -> None:
        self.network = network

    def divisors(self, batch: TuningBatch) -> dict[str, float]:
        """The number of the answers' tokens."""
        return {TERM: float((batch.labels[:, 1:] != IGNORED).sum())}

    def __call__(self, batch: TuningBatch) -> dict[str, Tensor]:
        """The sum over the answers' tokens."""
        # The logits of a position are of the token after it. Only those that are needed are computed, since a
        # vocabulary is large and prompts are long.
        next_labels = batch.labels[:, 1:]
        keep = (next_labels != IGNORED).any(dim=0).nonzero()[:, 0]
        logits = self.network(batch.inputs, batch.tokens, keep)
        with torch.autocast(logits.device.type, enabled=False):
            loss = nn.functional.cross_entropy(
                logits.float().flatten(0, 1), next_labels[:, keep].flatten(), ignore_index=IGNORED, reduction="sum"
            )
        return {TERM: loss}


PROJECTION_FILE = "projection.safetensors"


def tuning_training() -> TrainerConfig:
    """The training loop's settings for adapters."""
    return TrainerConfig(steps=1000, accumulate=8, learning_rate=2e-4, warmup=30, validate_every=0)


@dataclass(frozen=True, slots=True, kw_only=True)
class TuneConfig:
    """Settings of a tuning."""

    base: Literal["float32", "bfloat16"] = option(
        "float32", "type in which the model's own weights, which stay as they are, are kept"
    )
    recompute: bool = option(False, "recompute activations in the backward pass: less memory, more time")
    lora: AdapterConfig = field(default_factory=AdapterConfig)
    train: TrainerConfig = field(default_factory=tuning_training)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tuned:
    """The result of a tuning; the layout is that of the tower's output that features replace, None where the model
    looks at pictures."""

    network: TunedVlm
    processor: Any
    layout: TowerLayout | None
    state: TrainingState


def open_processor(model: Path, *, with_tokens: bool = False) -> tuple[Any, Any, TowerLayout | None]:
    """Configuration and processor of a model, and the layout of its tower's output where features replace that."""
    config, processor = load_processor(model)
    if not with_tokens:
        return config, processor, None
    layout = tower_layout(config, processor)
    if hasattr(processor.image_processor, SPLIT):
        # A part of a picture has no tokens of its own.
        setattr(processor.image_processor, SPLIT, False)
    return config, processor, layout


def tune(
    pairs: Sequence[TuningPair],
    store: PromptStore,
    model: Path,
    config: TuneConfig = TuneConfig(),
    *,
    work: Path,
    process: ProcessRank = ProcessRank(),
    device: torch.device = torch.device("cpu"),
    tensorboard: bool = False,
    track: Track = untracked,
) -> Tuned:
    """Trains adapters of a model of transformers on questions and answers. Interrupted, it is resumed by the next call
    with the same `work`, an existing folder."""
    check_pairs(pairs)
    first = pairs[0].prompt.tokens
    model_config, processor, layout = open_processor(model, with_tokens=bool(first))
    channels = store.tokens(first).shape[2] if first else None
    # Features replace the output of the model's tower; a linear layer leads to its channels where they are others.
    projected = None if layout is None or channels == layout.channels else channels
    digest = model_digest(model)
    check_agreement("the weights of the model", digest)
    seed = config.train.seed
    adapted = load_adapted(model, config.lora, base=config.base, seed=seed)
    if config.recompute:
        recompute_activations(adapted.get_base_model())
    network = TunedVlm(adapted, layout, projected, seed=seed)
    tokenizer = processor.tokenizer
    longest = getattr(model_config.get_text_config(), "max_position_embeddings", None)
    padding = tokenizer.pad_token_id if tokenizer.pad_token_id is not None else tokenizer.eos_token_id
    settings = {
        "lora": plain(config.lora),
        "base": config.base,
        "model": digest,
        "pairs": pairs_digest(pairs),
        "tokens": {"channels": channels, "projected": projected},
    }
    trainer = Trainer(
        network,
        PairSamples(pairs, store, processor, longest=longest, seed=seed),
        AnswerObjective,
        config.train,
        collate=partial(join_pairs, padding=padding or 0),
        folder=work,
        settings=settings,
        process=process,
        device=device,
        weight_decay=0.0,
        final_rate=0.0,
        tensorboard=tensorboard,
    )
    state = trainer.run(track)
    network.eval()
    return Tuned(network=network, processor=processor, layout=layout, state=state)


def recompute_activations(model: Any) -> None:
    """Keeps the inputs of blocks alone for the backward pass, and computes what is in the blocks once more."""
    # The name before version 5.20 of transformers.
    enable = getattr(model, "activation_checkpointing_enable", None) or model.gradient_checkpointing_enable
    enable({"use_reentrant": False})


def check_pairs(pairs: Sequence[TuningPair]) -> None:
    """Checks that there is something to learn."""
    if not pairs:
        raise InputError("tune: there are no questions to train on")
    for pair in pairs:
        if not pair.answers or not all(answer.strip() for answer in pair.answers):
            raise InputError(
                f"{pair.name}: {'an answer is empty' if pair.answers else 'there is no answer'}; expected answers of "
                "one character or more; mend or remove the question"
            )
    spaces = sorted({pair.prompt.space for pair in pairs})
    if len(spaces) > 1:
        raise InputError(
            f"tokens: scenes have features of {len(spaces)} spaces ({spaces[0]}; {spaces[1]}); expected those of one"
        )


def pairs_digest(pairs: Sequence[TuningPair]) -> str:
    """A fingerprint of questions, pictures, tokens and answers, in their order."""
    rows = [[each.prompt.text, each.prompt.pictures, each.prompt.tokens, each.answers] for each in pairs]
    return sha256(json.dumps(rows).encode()).hexdigest()[:16]


def save_tuned(folder: Path, tuned: Tuned) -> None:
    """Writes adapters as peft does, the processor, and a projection where there is one."""
    save_adapters(folder, tuned.network.adapted, tuned.processor)
    if tuned.network.projection is not None:
        arrays = {name: value.detach().cpu().numpy() for name, value in tuned.network.projection.state_dict().items()}
        write_archive(folder / PROJECTION_FILE, arrays, {"what": "features to the channels of a vision tower"})


def open_tuned(folder: Path, model: Path, *, with_tokens: bool = False) -> Tuned:
    """The model with adapters that `save_tuned` wrote, for programs; servers read them through peft themselves. With
    `with_tokens` rendered features replace the tower's output, as in the training."""
    check_peft()
    import peft
    from transformers import AutoModelForImageTextToText

    _, processor, layout = open_processor(model, with_tokens=with_tokens)
    if not (folder / "adapter_model.safetensors").is_file():
        raise InputError(f"{LABEL}: {folder} has no adapter_model.safetensors; expected what tune wrote")
    for name in ("adapter_model.safetensors", "adapter_config.json"):
        warn_if_modified(folder / name)
    base = load_pretrained(AutoModelForImageTextToText, model.resolve(), LABEL)
    with quiet_peft():
        adapted = peft.PeftModel.from_pretrained(base, str(folder), use_safetensors=True)
    path = folder / PROJECTION_FILE
    projection = None
    if layout is not None and path.is_file():
        with open_archive(path) as file:
            weight = file.array("weight", "float32", (layout.channels, "D"))
            bias = file.array("bias", "float32", (layout.channels,))
            projection = {"weight": torch.from_numpy(weight), "bias": torch.from_numpy(bias)}
    network = TunedVlm(adapted, layout, None if projection is None else projection["weight"].shape[1])
    if network.projection is not None and projection is not None:
        network.projection.load_state_dict(projection)
    network.eval()
    return Tuned(network=network, processor=processor, layout=layout, state=TrainingState())
