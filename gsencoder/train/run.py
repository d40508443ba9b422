"""Training of an encoder from scenes on disk (SplatDistill sec. 3.3): preparation, distillation, validation."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32

from gsencoder.core.errors import InputError
from gsencoder.core.files.json_values import plain
from gsencoder.core.runtime.device_names import Device
from gsencoder.core.runtime.tracking import Track, untracked
from gsencoder.fusion.heads.store import heads_digest
from gsencoder.fusion.teachers.build import text_table_of
from gsencoder.models.encoder import EncoderConfig, GaussianEncoder
from gsencoder.models.output_space import OutputSpace
from gsencoder.text.table import TextTable
from gsencoder.train.adapter_heads import asked_heads, dataset_heads, render_heads
from gsencoder.train.augment import AugmentConfig
from gsencoder.train.checkpoint import TrainingState
from gsencoder.train.crops import SamplingConfig
from gsencoder.train.distributed import ProcessRank, check_agreement, join_processes
from gsencoder.train.losses import LossConfig
from gsencoder.train.prepare import PreparedDataset
from gsencoder.train.prepare_scenes import SourceConfig, prepare_scenes
from gsencoder.train.prepared_scene import PreparedScene
from gsencoder.train.samples import SampleDataset, SampleRecipe
from gsencoder.train.trainer import Trainer, TrainerConfig, ValidationResult

SceneValidator = Callable[
    [Sequence[PreparedScene], GaussianEncoder, OutputSpace, Float32[np.ndarray, "C channels"]], ValidationResult
]
"""Scores an encoder on held-out scenes, given these, the encoder, its output space and the target classes' codebook."""
CHANGEABLE_ON_RESUME = ("workers", "log_every", "validate_every", "checkpoint_every", "compile", "accumulate")
"""Settings of the trainer that a resumed run may change, since they do not change the result of a step."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainConfig(SourceConfig):
    """Settings of a training run."""

    tensorboard: bool = field(default=True, metadata={"help": "write TensorBoard events in addition to log.csv"})
    heads: tuple[str, ...] = field(
        default=(),
        metadata={
            "names": True,
            "help": "the teacher's adapter heads on whose outputs L_render is computed, such as siglip,sam.features; "
            "they are stored beside the weights; empty = L_render compares the features themselves",
        },
    )
    model: EncoderConfig = field(default_factory=EncoderConfig, metadata={"preset": "tiny"})
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    train: TrainerConfig = field(default_factory=TrainerConfig)

    def __post_init__(self) -> None:
        SourceConfig.__post_init__(self)
        if self.loss.confidence and not (self.prepare.center and self.prepare.scale):
            raise InputError(
                "loss.confidence: weights by distances from the mean in typical ones; give loss.confidence=false with "
                "prepare.center=false or prepare.scale=false"
            )
        if self.loss.contrast_weight and not self.prepare.scale:
            raise InputError(
                "loss.contrast_weight: compares distances with typical ones; expected 0 with prepare.scale=false"
            )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Training:
    """The result of a training run.

    Attributes:
        encoder: the trained network.
        outputs: its output space.
        words: text table of the teacher; None if it has none.
        state: steps and seconds of the training.
        scores: scores of the last validation; empty without held-out scenes.
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
    validate: SceneValidator | None = None,
    track: Track = untracked,
) -> Training:
    """Distills a teacher into an encoder. Under torchrun or SLURM every process calls this, and all return the result.

    An interrupted call is resumed by the next one with the same `work`, from its checkpoint and its prepared scenes.

    Args:
        scenes: folders or splat files to train on.
        config: settings of the run.
        work: folder for the checkpoint and the log; created if it does not exist.
        held_out: scenes on which `validate` scores the encoder.
        prepared: folder of prepared scenes, which runs with the same sources can share; None = a folder in `work`.
        device: the device on which the encoder is trained.
        validate: scores the encoder during training, for example `gsencoder.evaluate.validation.validate_names`.
        track: wraps loops to show progress.

    Raises:
        InputError: a scene cannot be used; `work` or `prepared` holds a run with other settings; or a loss or gradient
            is not finite.
    """
    folder = Path(work)
    training, validation = [Path(path) for path in scenes], [Path(path) for path in held_out]
    words = text_table_of(config.teacher)
    with join_processes(device) as (process, chosen_device):
        folder.mkdir(parents=True, exist_ok=True)
        prepared_folder = Path(prepared) if prepared is not None else folder / "prepared"
        voxel = config.model.voxel
        dataset = prepare_scenes(
            training,
            validation,
            words,
            config,
            prepared_folder,
            voxel=voxel,
            heads=asked_heads(config.heads, config.teacher),
            process=process,
            track=track,
        )
        return fit(
            dataset,
            [path.name for path in training],
            [path.name for path in validation],
            words,
            config,
            work=folder,
            process=process,
            device=chosen_device,
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
    validate: SceneValidator | None = None,
    track: Track = untracked,
) -> Training:
    """Trains an encoder on prepared scenes, given by name; the other arguments are those of `train`.

    Raises:
        InputError: see `train`.
    """
    outputs, _ = dataset.load_space()
    heads = dataset_heads(dataset, config.heads)
    if len(heads.heads) < len(config.heads):
        raise InputError(f"heads: {', '.join(config.heads)} names a head twice; its loss would count twice")
    check_agreement("the heads of L_render", heads_digest(heads))
    class_balance = dataset.load_class_balance()
    recipe = SampleRecipe(
        encoder=config.model,
        sampling=config.sampling,
        augmentation=config.augment,
        losses=config.loss,
        class_balance=class_balance,
        seed=config.train.seed,
        step_samples=config.train.samples_per_step(process.world_size),
    )
    score_encoder: Callable[[GaussianEncoder], ValidationResult] = lambda encoder: ValidationResult({})  # noqa: ARG005, E731
    if validate is not None and held_out:
        score_encoder = partial(_validate, validate, dataset.scenes(held_out), outputs, class_balance.codebook)
    torch.manual_seed(config.train.seed)
    trainer = Trainer(
        GaussianEncoder(config.model, outputs.channels),
        SampleDataset(dataset.scenes(training), recipe),
        config.loss,
        config.train,
        folder=work,
        settings=resume_settings(config, process, dataset),
        heads=render_heads(heads, outputs),
        process=process,
        device=device,
        tensorboard=config.tensorboard,
        validate=score_encoder,
    )
    state = trainer.run(track)
    # A run that is resumed after its last step and validation has not validated in this process.
    if trainer.last_validation is None and process.is_first:
        trainer.last_validation = score_encoder(trainer.encoder)
    scores = dict(trainer.last_validation.scores) if trainer.last_validation is not None else {}
    return Training(encoder=trainer.encoder, outputs=outputs, words=words, state=state, scores=scores)


def resume_settings(config: TrainConfig, process: ProcessRank, dataset: PreparedDataset) -> dict[str, Any]:
    """The settings that a run must share with the one that it resumes, as JSON values.

    The distribution of a step's micro-batches over processes may change.
    """
    shared = {name: plain(getattr(config, name)) for name in ("model", "sampling", "augment", "loss", "train")}
    for name in CHANGEABLE_ON_RESUME:
        del shared["train"][name]
    heads = f"{','.join(config.heads)} ({heads_digest(dataset_heads(dataset, config.heads))})" if config.heads else ""
    return {
        **shared,
        **{"space": dataset.fingerprint(), "prepared": dataset.settings, "heads": heads},
        "samples_per_step": config.train.samples_per_step(process.world_size),
    }


def _validate(
    validate: SceneValidator,
    scenes: Sequence[PreparedScene],
    outputs: OutputSpace,
    codebook: Float32[np.ndarray, "C channels"],
    encoder: GaussianEncoder,
) -> ValidationResult:
    """`validate` with the encoder as the last argument, for `partial`."""
    return validate(scenes, encoder, outputs, codebook)
