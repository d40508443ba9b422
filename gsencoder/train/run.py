"""Training of an encoder from scenes on disk (SplatDistill sec. 3.3): preparation, distillation, validation."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float32

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.files import plain
from gsencoder.core.process import Device, ProcessRank, Track, untracked
from gsencoder.core.settings import option
from gsencoder.core.threads import threads_of_torch
from gsencoder.fusion.measured_heads import heads_digest
from gsencoder.models.encoder import EncoderConfig, GaussianEncoder, load_start, start_from
from gsencoder.models.output_space import OutputSpaces
from gsencoder.text.table import TextTable
from gsencoder.text.vocabulary import Words, closed_table
from gsencoder.train.distributed import check_agreement, cpu_share, digest_of, fail_together, join_processes
from gsencoder.train.loop import (
    TRAINING_CHECKPOINT_FILE,
    Trainer,
    TrainerConfig,
    TrainingState,
    ValidationResult,
    check_same_teachers,
)
from gsencoder.train.losses import TERMS, Distillation, Heads, LossConfig, TeacherRecipe, render_heads
from gsencoder.train.prepare import dataset_heads, required_heads, teacher_of_heads
from gsencoder.train.prepare_scenes import SourceConfig, prepare_scenes
from gsencoder.train.prepared import PreparedDataset, PreparedScene, nearest_codes
from gsencoder.train.samples import (
    Augmentation,
    SampleDataset,
    SampleRecipe,
    SamplingConfig,
    TrainingScene,
    join_samples,
)

if TYPE_CHECKING:
    from gsencoder.train.rooms import RoomStream


def encoder_trainer(
    encoder: GaussianEncoder,
    dataset: SampleDataset,
    losses: LossConfig,
    config: TrainerConfig,
    *,
    heads: Mapping[str, Heads] = {},
    device: torch.device = torch.device("cpu"),
    **settings: Any,
) -> Trainer:
    """A trainer that distills the teachers of a dataset into an encoder; `settings` are the other arguments of
    `Trainer`."""
    return Trainer(
        encoder,
        dataset,
        partial(Distillation, config=losses, teachers=dataset.recipe.teachers, heads=heads, device=device),
        config,
        collate=partial(join_samples, patch=encoder.config.transformer.patch),
        device=device,
        **settings,
    )


SceneValidator = Callable[
    [Sequence[TrainingScene], GaussianEncoder, OutputSpaces, Mapping[str, Float32[np.ndarray, "C channels"]]],
    ValidationResult,
]
"""Scores an encoder on held-out scenes, given these, the encoder, its output spaces, and the codebook of each teacher's
target classes. It is called in all processes, and what it returns in the first one is logged."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainConfig(SourceConfig):
    """Settings of a training run."""

    tensorboard: bool = option(True, "write TensorBoard events in addition to log.csv")
    heads: tuple[str, ...] = option(
        (),
        "the teacher's adapter heads on whose outputs L_render is computed, such as siglip,sam.features; "
        "they are stored next to the weights; empty = L_render compares the features themselves",
        names=True,
    )
    model: EncoderConfig = field(default_factory=EncoderConfig, metadata={"preset": "tiny"})
    init: str = option(
        "",
        "weights to start from, made with the same model= settings (but for voxel where inputs has cell): a folder or "
        "file written by `train`, or the name of an encoder that comes with gsencoder; empty = random parameters",
    )
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    augment: bool = option(True, "turn, mirror, scale, shift, thin and relight samples at random")
    recolor: float = option(
        0.0,
        "share of augmented samples whose colors are permuted, inverted or gray, so that shapes are learned",
        ge=0,
        le=1,
    )
    loss: LossConfig = field(default_factory=LossConfig)
    train: TrainerConfig = field(default_factory=TrainerConfig)
    prepare_threads: int = option(
        0,
        "threads of each process while scenes are prepared; 0 = the machine's cores, divided among its processes",
        ge=0,
    )

    def __post_init__(self) -> None:
        SourceConfig.__post_init__(self)
        if self.loss.confidence and not (self.prepare.center and self.prepare.scale):
            raise InputError(
                "loss.confidence: weights by distances from the mean in typical ones; give loss.confidence=false with "
                "prepare.center=false or prepare.scale=false"
            )
        teachers, weights = self.teachers_by_name, self.loss.teacher_weights
        if weights and len(weights) != len(teachers):
            raise InputError(
                f"loss.teacher_weights: expected {len(teachers)} numbers, one for each of {', '.join(teachers)}, got "
                f"{list(weights)}"
            )
        if len(set(self.heads)) < len(self.heads):
            raise InputError(f"heads: {', '.join(self.heads)} names a head twice; its loss would count twice")
        if self.loss.contrast_weight and not self.prepare.scale:
            raise InputError(
                "loss.contrast_weight: compares distances with typical ones; expected 0 with prepare.scale=false"
            )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Training:
    """The result of a training run; text tables are those of the teachers that have one, and scores those of the last
    validation."""

    encoder: GaussianEncoder
    outputs: OutputSpaces
    tables: Mapping[str, TextTable]
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
    An interrupted call is resumed by the next one with the same `work`.

    Args:
        scenes: folders or splat files to train on.
        work: folder for the checkpoint and the log; created if it does not exist.
        held_out: scenes on which `validate` scores the encoder.
        prepared: folder of prepared scenes, which runs with the same sources can share; None = a folder in `work`.
        validate: scores the encoder during training, for example `gsencoder.evaluate.validation.validate_names`.
    """
    folder = Path(work)
    training, validation = [Path(path) for path in scenes], [Path(path) for path in held_out]
    words = config.load_words()
    with join_processes(device) as (process, chosen_device):
        folder.mkdir(parents=True, exist_ok=True)
        with fail_together():
            if process.is_first:
                check_start(config, folder / TRAINING_CHECKPOINT_FILE)
        place: dict[str, Any] = {"process": process, "device": chosen_device, "track": track}
        prepared_in = Path(prepared) if prepared is not None else folder / "prepared"
        datasets = prepare(training, validation, words, config, prepared_in, **place)
        return fit(datasets, training, validation, words, config, work=folder, validate=validate, **place)


def check_start(config: TrainConfig, checkpoint: Path | None) -> None:
    """Checks, before anything is prepared, the checkpoint that a run continues, or the weights that it starts from."""
    if checkpoint is not None and checkpoint.is_file():
        check_same_teachers(checkpoint, list(config.teachers_by_name))
    elif config.init:
        load_start(config.model, config.init)


def prepare(
    scenes: Sequence[Path],
    held_out: Sequence[Path],
    words: Mapping[str, Words],
    config: TrainConfig,
    folder: Path,
    *,
    process: ProcessRank,
    device: torch.device,
    track: Track = untracked,
) -> dict[str, PreparedDataset]:
    """Prepares the scenes of a training in a folder, with this process's share of the cores."""
    heads = required_heads(config.heads, config.teachers_by_name)
    if config.rooms.libraries:
        from gsencoder.train.rooms import models_of

        models_of(config.rooms)  # What cannot be read is an error before hours of preparation.
    place: dict[str, Any] = {"process": process, "device": device, "track": track}
    with threads_of_torch(cpu_share(process, config.prepare_threads)):
        return prepare_scenes(scenes, held_out, words, config, folder, heads=heads, **place)


def fit(
    datasets: Mapping[str, PreparedDataset],
    scenes: Sequence[Path],
    held_out: Sequence[Path],
    words: Mapping[str, Words],
    config: TrainConfig,
    *,
    work: Path,
    process: ProcessRank,
    device: torch.device,
    validate: SceneValidator | None = None,
    track: Track = untracked,
) -> Training:
    """Trains an encoder on prepared scenes; the arguments are those of `train`."""
    # Samples are numbered by scene, so that the order in which scenes are given must not matter to a resumed run.
    training = sorted(path.name for path in scenes)
    with_heads = teacher_of_heads(config.teachers_by_name, config.heads)
    heads = dataset_heads(datasets[with_heads], config.heads)
    if len(heads.heads) < len(config.heads):
        raise InputError(f"heads: {', '.join(config.heads)} names a head twice; its loss would count twice")
    digest_of_heads = heads_digest(heads) if config.heads else ""
    check_agreement("the heads of L_render", digest_of_heads)
    recipe = SampleRecipe(
        encoder=config.model,
        sampling=config.sampling,
        augmentation=Augmentation(recolor=config.recolor) if config.augment else None,
        losses=config.loss,
        teachers=teacher_recipes(datasets, config.loss),
        seed=config.train.seed,
        step_samples=config.train.samples_per_step(process.world_size),
    )
    outputs = OutputSpaces(by_teacher={name: dataset.load_space()[0] for name, dataset in datasets.items()})
    stream = None
    if config.rooms.libraries:
        stream = room_stream(outputs, words, config, recipe)
    score_encoder: Callable[[GaussianEncoder], ValidationResult] | None = None
    if validate is not None and held_out:
        held_out_parts = [_parts(datasets, path.name) for path in held_out]
        others = [TrainingScene(parts) for parts in held_out_parts if any(part is not None for part in parts)]
        codebooks = {teacher.name: teacher.codebook for teacher in recipe.teachers}
        score_encoder = lambda encoder: validate(others, encoder, outputs, codebooks)  # noqa: E731
    if process.world_size > 1:
        digests = [dataset.digest_of_scenes(training) for dataset in datasets.values()]
        check_agreement("the prepared scenes", digest_of(digests))
    torch.manual_seed(config.train.seed)
    encoder = GaussianEncoder(config.model, outputs.widths)
    if config.init and not (work / TRAINING_CHECKPOINT_FILE).is_file():
        start_from(encoder, outputs, config.init)
    trainer = encoder_trainer(
        encoder,
        SampleDataset([TrainingScene(_parts(datasets, name)) for name in training], recipe, stream),
        config.loss,
        config.train,
        folder=work,
        settings=resume_settings(config, datasets, training, digest_of_heads),
        heads={with_heads: render_heads(heads, outputs[with_heads])} if config.heads else {},
        process=process,
        device=device,
        tensorboard=config.tensorboard,
        validate=score_encoder,
    )
    state = trainer.run(track)
    scores: Mapping[str, float] = {}
    if score_encoder is not None:
        # A run that is resumed after its last step and validation has not validated in this process.
        scores = (trainer.last_validation or score_encoder(encoder)).scores
    tables = {name: _table_of(each, datasets[name]) for name, each in words.items()}
    return Training(encoder=encoder, outputs=outputs, tables=tables, state=state, scores=dict(scores))


def room_stream(
    outputs: OutputSpaces, words: Mapping[str, Words], config: TrainConfig, recipe: SampleRecipe
) -> "RoomStream":
    """The rooms that are made during a training, with the classes of its labels."""
    from gsencoder.data.furnished.kinds import kinds
    from gsencoder.train.rooms import RoomStream

    name = config.labels_teacher
    assert name is not None
    space, number = outputs[name], list(config.teachers_by_name).index(name)
    codebook = recipe.teachers[number].codebook
    vectors = words[name].encode(list(kinds()))
    codes = nearest_codes(codebook, space.project(vectors))
    return RoomStream(
        config.rooms,
        codebook,
        dict(zip(kinds(), codes.tolist(), strict=True)),
        config.sampling,
        voxel=config.model.voxel,
        teachers=len(recipe.teachers),
        teacher=number,
        step_samples=recipe.step_samples,
        seed=config.train.seed,
    )


def teacher_recipes(datasets: Mapping[str, PreparedDataset], losses: LossConfig) -> tuple[TeacherRecipe, ...]:
    """The teachers of a training with the weights and classes of their targets; refused where no loss is computed on
    any teacher, with a warning where none is on some, or where none has classes for L_contrast."""
    weights = losses.teacher_weights or (1.0,) * len(datasets)
    teachers = tuple(
        TeacherRecipe(
            name=name,
            codebook=dataset.load_codebook(),
            weight=weight,
            classes=losses.contrast_clusters or dataset.load_space()[1] is not None,
        )
        for (name, dataset), weight in zip(datasets.items(), weights, strict=True)
    )
    of_all = any(weight and not TERMS[name].classes for name, weight in losses.lambdas.items())
    if losses.contrast_weight and not any(each.classes for each in teachers):
        message = (
            "loss.contrast_weight: the maps of no teacher are codes of a table of names, so L_contrast has no classes; "
            "loss.contrast_clusters=true takes clusters of targets as classes"
        )
        if not of_all:
            raise InputError(message)
        warnings.warn(message, SceneWarning, stacklevel=3)
    untrained = [each.name for each in teachers if not each.weight or not (of_all or each.classes)]
    option = f"loss.teacher_weights={list(weights)}"
    if len(untrained) == len(teachers):
        raise InputError(f"loss: the losses of every teacher have the weight 0 ({option}); give one of them a weight")
    if untrained:
        names = f"teacher {untrained[0]}" if len(untrained) == 1 else f"teachers {', '.join(untrained)}"
        warnings.warn(
            f"{names}: no loss is computed with a weight above 0 ({option}), so that the encoder gives features that "
            "were never trained; give a weight above 0, or leave the teacher out",
            SceneWarning,
            stacklevel=3,
        )
    return teachers


def _parts(datasets: Mapping[str, PreparedDataset], name: str) -> list[PreparedScene | None]:
    """The prepared scene of each teacher; None for those that the scene lacks."""
    return [dataset.find_scene(name) for dataset in datasets.values()]


def _table_of(words: Words, dataset: PreparedDataset) -> TextTable:
    """The names that are known without a tower: those of a table, or of a tower's vocabulary and the dataset, with
    those trained on marked, where the dataset has classes with names."""
    kinds = dataset.load_kinds()
    return closed_table(words.trained_on(kinds) if kinds else words)


def resume_settings(
    config: TrainConfig, datasets: Mapping[str, PreparedDataset], training: Sequence[str], heads: str
) -> dict[str, Any]:
    """What a run must share with the one that it resumes besides the settings of the loop, as JSON values; `heads` is
    the digest of the render loss's heads."""
    return {
        **{
            name: plain(getattr(config, name))
            for name in ("model", "init", "sampling", "augment", "recolor", "loss", "rooms")
        },
        # The order, which a mapping does not have when it is compared, is that of the columns.
        "teachers": list(datasets),
        "spaces": {name: dataset.fingerprint() for name, dataset in datasets.items()},
        "prepared": {name: dataset.settings for name, dataset in datasets.items()},
        "scenes": {name: [each.name for each in dataset.scenes(training)] for name, dataset in datasets.items()},
        "heads": f"{','.join(config.heads)} ({heads})" if config.heads else "",
    }
