"""Fine-tuning of a vision-language model on questions about scenes (SplatDistill table 8)."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal

import torch

from gsencoder.core.archive import open_archive, write_archive
from gsencoder.core.errors import InputError
from gsencoder.core.files import check_written, plain
from gsencoder.core.pretrained import load_pretrained
from gsencoder.core.process import ProcessRank, Track, untracked
from gsencoder.data.prompts import PromptStore
from gsencoder.train.checkpoint import TrainingState
from gsencoder.train.distributed import check_agreement
from gsencoder.train.trainer import Trainer
from gsencoder.train.trainer_config import CHANGEABLE_ON_RESUME, TrainerConfig
from gsencoder.train.tuning.network import AnswerObjective, TunedVlm
from gsencoder.train.tuning.samples import PairSamples, TuningPair, join_pairs
from gsencoder.train.tuning.towers import SPLIT, TowerLayout, tower_layout
from gsencoder.train.tuning.vlm import (
    WHAT,
    AdapterConfig,
    check_peft,
    load_adapted,
    load_processor,
    model_digest,
    quiet_peft,
    save_adapters,
)

PROJECTION_FILE = "projection.safetensors"


def tuning_training() -> TrainerConfig:
    """The training loop's settings for adapters."""
    return TrainerConfig(
        steps=1000, accumulate=8, learning_rate=2e-4, final_rate=0.0, warmup=30, weight_decay=0.0, validate_every=0
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class TuneConfig:
    """Settings of a tuning."""

    base: Literal["float32", "bfloat16"] = field(
        default="float32", metadata={"help": "type in which the model's own weights, which stay as they are, are kept"}
    )
    recompute: bool = field(
        default=False, metadata={"help": "recompute activations in the backward pass: less memory, more time"}
    )
    lora: AdapterConfig = field(default_factory=AdapterConfig)
    train: TrainerConfig = field(default_factory=tuning_training)

    def __post_init__(self) -> None:
        if self.train.compile:
            raise InputError("train.compile: expected false; models of transformers are not compiled here")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tuned:
    """The result of a tuning.

    Attributes:
        network: on the device that it was trained on.
        processor: of the model.
        layout: of the tower's output that features replace; None where the model looks at pictures.
        state: steps and seconds.
    """

    network: TunedVlm
    processor: Any
    layout: TowerLayout | None
    state: TrainingState


def open_processor(model: Path, *, with_tokens: bool = False) -> tuple[Any, Any, TowerLayout | None]:
    """Configuration and processor of a model, and the layout of its tower's output where features replace that.

    Raises:
        InputError: see `load_processor` and `tower_layout`.
    """
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
    project: bool | None = None,
    work: Path,
    process: ProcessRank = ProcessRank(),
    device: torch.device = torch.device("cpu"),
    tensorboard: bool = False,
    track: Track = untracked,
) -> Tuned:
    """Trains adapters of a model on questions and answers. Interrupted, it is resumed by the next call with the same
    `work`.

    Args:
        pairs: questions in a store with their answers.
        store: of the prompts.
        model: folder of a vision-language model of transformers.
        config: adapters and loop.
        project: for prompts with rendered features, which replace the output of the model's tower: whether a linear
            layer that is trained, too, leads from the features to the tower's channels; None = where their numbers
            differ.
        work: existing folder for the checkpoint and the log.
        process: rank of this process.
        device: of this process.
        tensorboard: whether to write TensorBoard events.
        track: wraps the loop to show progress.

    Raises:
        InputError: no pairs, a model that cannot be used, `work` holds a run with other settings, or a loss or gradient
            is not finite.
    """
    check_pairs(pairs)
    first = pairs[0].prompt.tokens
    stated, processor, layout = open_processor(model, with_tokens=bool(first))
    channels = store.tokens(first).shape[2] if first else None
    projected = None if layout is None or channels is None else _projected(channels, layout, project)
    digest = model_digest(model)
    check_agreement("the weights of the model", digest)
    seed = config.train.seed
    adapted = load_adapted(model, config.lora, base=config.base, seed=seed)
    if config.recompute:
        recompute_activations(adapted.get_base_model())
    network = TunedVlm(adapted, layout, projected, seed=seed)
    tokenizer = processor.tokenizer
    longest = getattr(stated.get_text_config(), "max_position_embeddings", None)
    padding = tokenizer.pad_token_id if tokenizer.pad_token_id is not None else tokenizer.eos_token_id
    settings = {
        "lora": plain(config.lora),
        "base": config.base,
        "train": {name: value for name, value in plain(config.train).items() if name not in CHANGEABLE_ON_RESUME},
        "model": digest,
        "pairs": pairs_digest(pairs),
        "tokens": {"channels": channels, "projected": projected},
        "samples_per_step": config.train.samples_per_step(process.world_size),
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


def _projected(channels: int, layout: TowerLayout, project: bool | None) -> int | None:
    """The channels of features that are projected; None where they are those of the tower."""
    if project or (project is None and channels != layout.channels):
        return channels
    if channels != layout.channels:
        raise InputError(
            f"project=false: the features have {channels} channels and the tower has {layout.channels}; leave project= "
            "out"
        )
    return None


def check_pairs(pairs: Sequence[TuningPair]) -> None:
    """Checks that there is something to learn.

    Raises:
        InputError: no pairs, answers that are missing or empty, or tokens of several feature spaces.
    """
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
    """Writes adapters as peft does, the processor, and a projection where there is one.

    Raises:
        InputError: the disk is full.
    """
    save_adapters(folder, tuned.network.adapted, tuned.processor)
    if tuned.network.projection is not None:
        arrays = {name: value.detach().cpu().numpy() for name, value in tuned.network.projection.state_dict().items()}
        write_archive(folder / PROJECTION_FILE, arrays, {"what": "features to the channels of a vision tower"})


def open_tuned(folder: Path, model: Path, *, with_tokens: bool = False) -> Tuned:
    """The model with adapters that `save_tuned` wrote, for programs; servers read them through peft themselves.

    Args:
        folder: of the adapters.
        model: that they belong to.
        with_tokens: whether rendered features replace the tower's output, as in the training.

    Raises:
        InputError: peft is missing, or the files cannot be used.
    """
    check_peft()
    import peft
    from transformers import AutoModelForImageTextToText

    _, processor, layout = open_processor(model, with_tokens=with_tokens)
    if not (folder / "adapter_model.safetensors").is_file():
        raise InputError(f"{WHAT}: {folder} has no adapter_model.safetensors; expected what tune wrote")
    for name in ("adapter_model.safetensors", "adapter_config.json"):
        check_written(folder / name)
    base = load_pretrained(AutoModelForImageTextToText, model.resolve(), WHAT)
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
