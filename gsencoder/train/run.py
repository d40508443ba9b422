"""Distillation from scenes on disk to a trained encoder (SplatDistill, sec. 3.3): prepare, train, validate."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32

from gsencoder.core.files.json_values import plain
from gsencoder.core.files.model_files import find_file
from gsencoder.core.runtime.device_names import Device
from gsencoder.core.runtime.tracking import Track, untracked
from gsencoder.fusion.teachers.build import text_table_of
from gsencoder.models.encoder import EncoderConfig, GaussianEncoder
from gsencoder.models.output_space import OutputSpace
from gsencoder.text.table import TextTable
from gsencoder.train.adapter_heads import load_heads
from gsencoder.train.augment import AugmentConfig
from gsencoder.train.checkpoint import TrainingState
from gsencoder.train.crops import SamplingConfig
from gsencoder.train.distributed import ProcessRank, joined
from gsencoder.train.losses import LossConfig
from gsencoder.train.prepare import PreparedDataset
from gsencoder.train.prepare_scenes import SourceConfig, prepare_scenes
from gsencoder.train.prepared_scene import PreparedScene
from gsencoder.train.samples import SampleDataset, SampleRecipe
from gsencoder.train.trainer import Trainer, TrainerConfig, Validated

Validate = Callable[
    [Sequence[PreparedScene], GaussianEncoder, OutputSpace, Float32[np.ndarray, "C channels"]], Validated
]
"""Scores an encoder on held-out scenes: scenes, encoder, output space, and the codebook of target kinds."""
FREE_TO_CHANGE = ("workers", "log_every", "validate_every", "checkpoint_every", "compile", "accumulate")
"""Settings of the loop that a continued run may change: none of them changes a step's result."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainConfig(SourceConfig):
    """All settings of a training."""

    tensorboard: bool = field(default=True, metadata={"help": "write TensorBoard events beside log.csv"})
    heads: str = field(
        default="",
        metadata={"help": "file of the teacher's adapter heads, behind which cells are compared; empty = none"},
    )
    model: EncoderConfig = field(default_factory=EncoderConfig, metadata={"preset": "tiny"})
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    train: TrainerConfig = field(default_factory=TrainerConfig)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Training:
    """A trained encoder.

    Attributes:
        encoder: the network.
        outputs: what its output channels mean.
        words: the teacher's text table; None where it has none.
        state: steps and seconds of the training.
        scores: of the last validation; empty without held-out scenes.
    """

    encoder: GaussianEncoder
    outputs: OutputSpace
    words: TextTable | None
    state: TrainingState
    scores: dict[str, float]


def train(
    scenes: Sequence[str | Path],
    config: TrainConfig = TrainConfig(),
    *,
    work: str | Path,
    held_out: Sequence[str | Path] = (),
    prepared: str | Path | None = None,
    device: Device = "auto",
    validate: Validate | None = None,
    track: Track = untracked,
) -> Training:
    """Distils a teacher into an encoder. Under torchrun or SLURM every process calls this, and all return the result.

    A call that was interrupted is continued by the next with the same `work`: from its checkpoint, and without
    preparing scenes again.

    Args:
        scenes: folders or splat files to train on.
        config: see there.
        work: folder for the checkpoint and the log; made if it does not exist.
        held_out: scenes that `validate` scores.
        prepared: folder of prepared scenes, which trainings with the same sources may share; None = in `work`.
        device: where the encoder computes.
        validate: scores the encoder while it is trained, such as `gsencoder.evaluate.validation.validate_names`.
        track: progress.

    Raises:
        InputError: what is wrong with a scene, which is named; another run in `work` or `prepared`; a loss or gradient
            that is not finite.
    """
    folder = Path(work)
    training, validation = [Path(path) for path in scenes], [Path(path) for path in held_out]
    words = text_table_of(config.teacher)
    with joined(device) as (process, chosen):
        folder.mkdir(parents=True, exist_ok=True)
        place = Path(prepared) if prepared is not None else folder / "prepared"
        voxel = config.model.voxel
        dataset = prepare_scenes(training, validation, words, config, place, voxel=voxel, process=process, track=track)
        return fit(
            dataset,
            [path.name for path in training],
            [path.name for path in validation],
            words,
            config,
            work=folder,
            process=process,
            device=chosen,
            validate=validate,
            track=track,
        )


def fit(
    dataset: PreparedDataset,
    training: Sequence[str],
    held_out: Sequence[str],
    words: TextTable | None,
    config: TrainConfig,
    *,
    work: Path,
    process: ProcessRank,
    device: torch.device,
    validate: Validate | None = None,
    track: Track = untracked,
) -> Training:
    """Trains an encoder on prepared scenes, which are given by name; the other arguments are those of `train`.

    Raises:
        InputError: see `train`.
    """
    outputs, _ = dataset.load_space()
    rarity = dataset.load_rarity()
    recipe = SampleRecipe(
        encoder=config.model,
        sampling=config.sampling,
        augmentation=config.augment,
        losses=config.loss,
        rarity=rarity,
        seed=config.train.seed,
        step_samples=config.train.samples_per_step(process.world_size),
    )
    judge: Callable[[GaussianEncoder], Validated] = lambda encoder: Validated({})  # noqa: ARG005, E731
    if validate is not None and held_out:
        judge = partial(_validate, validate, dataset.scenes(held_out), outputs, rarity.codebook)
    torch.manual_seed(config.train.seed)
    trainer = Trainer(
        GaussianEncoder(config.model, outputs.channels),
        SampleDataset(dataset.scenes(training), recipe),
        config.loss,
        config.train,
        folder=work,
        settings=identity(config, process, dataset),
        heads=load_heads(find_file(config.heads, "heads"), outputs) if config.heads else (),
        process=process,
        device=device,
        tensorboard=config.tensorboard,
        validate=judge,
    )
    state = trainer.run(track)
    # A run that was interrupted between its last step and the validation of it has not been validated.
    if trainer.validated is None and process.is_first:
        trainer.validated = judge(trainer.encoder)
    scores = dict(trainer.validated.scores) if trainer.validated is not None else {}
    return Training(encoder=trainer.encoder, outputs=outputs, words=words, state=state, scores=scores)


def identity(config: TrainConfig, process: ProcessRank, dataset: PreparedDataset) -> dict[str, Any]:
    """What an interrupted run must share with the run that continues it, as JSON values. How the micro-batches of a
    step are spread over processes may change."""
    chosen = {name: plain(getattr(config, name)) for name in ("model", "sampling", "augment", "loss", "train")}
    for name in FREE_TO_CHANGE:
        del chosen["train"][name]
    heads = hashlib.sha256(find_file(config.heads, "heads").read_bytes()).hexdigest()[:16] if config.heads else ""
    return {
        **chosen,
        **{"space": dataset.fingerprint(), "prepared": dataset.settings, "heads": heads},
        "samples_per_step": config.train.samples_per_step(process.world_size),
    }


def _validate(
    validate: Validate,
    scenes: Sequence[PreparedScene],
    outputs: OutputSpace,
    codebook: Float32[np.ndarray, "C channels"],
    encoder: GaussianEncoder,
) -> Validated:
    return validate(scenes, encoder, outputs, codebook)
