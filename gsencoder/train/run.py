"""Training of an encoder from scenes on disk (SplatDistill sec. 3.3): preparation, distillation, validation."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor, nn

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.files import plain
from gsencoder.core.process import Device, ProcessRank, Track, untracked
from gsencoder.core.threads import threads_of_torch
from gsencoder.fusion.measured_heads import heads_digest
from gsencoder.models.encoder import EncoderConfig, GaussianEncoder
from gsencoder.models.output_space import OutputSpaces
from gsencoder.teachers.build import words_by_teacher
from gsencoder.text.table import TextTable
from gsencoder.text.vocabulary import Words, closed_table
from gsencoder.train.adapter_heads import dataset_heads, render_heads, required_heads, teacher_of_heads
from gsencoder.train.batch import Batch, SamplingConfig, TeacherTargets, join_samples
from gsencoder.train.distributed import check_agreement, cpu_share, digest_of, fail_together, join_processes
from gsencoder.train.loop import (
    CHANGEABLE_ON_RESUME,
    TRAINING_CHECKPOINT_FILE,
    Trainer,
    TrainerConfig,
    TrainingState,
    ValidationResult,
    check_same_teachers,
)
from gsencoder.train.losses import AdapterHead, LossConfig, contrast_loss, field_loss, render_loss
from gsencoder.train.prepare import PreparedDataset
from gsencoder.train.prepare_scenes import SourceConfig, prepare_scenes
from gsencoder.train.prepared_file import PreparedScene
from gsencoder.train.samples import AugmentConfig, SampleDataset, SampleRecipe, TeacherRecipe, TrainingScene

Heads = Sequence[tuple[AdapterHead, nn.Module]]
"""Adapter heads of a teacher, each with a decoder from standard units to its input."""


class Distillation:
    """The loss L = Σ_teachers w · (λ_3D · L_3D + λ_render · L_render + λ_contrast · L_contrast), as totals before
    division.

    In a step each term is Σ total / Σ weight over all micro-batches of all processes. The weights are known before
    anything is computed, so each micro-batch divides its totals by the sum of the step's weights, and gradients are
    simply added. A term of one of several teachers is called TEACHER/TERM, such as "labels/field".
    """

    def __init__(
        self,
        network: nn.Module,
        config: LossConfig,
        teachers: Sequence[TeacherRecipe],
        *,
        heads: Mapping[str, Heads] = {},
        device: torch.device = torch.device("cpu"),
    ) -> None:
        """Args:
        network: a `GaussianEncoder`, possibly compiled or wrapped for several processes.
        config: weights and parameters of the terms.
        teachers: the teachers, in the order of the encoder's output columns.
        heads: adapter heads of teachers, by name.
        device: the device of the losses.
        """
        self.network, self.config = network, config
        self._teachers = list(teachers)
        self._codebooks = [torch.from_numpy(each.class_balance.codebook).to(device) for each in teachers]
        self._heads = {
            name: [(head.to(device), decode.to(device)) for head, decode in of_teacher]
            for name, of_teacher in heads.items()
        }

    @property
    def lambdas(self) -> dict[str, float]:
        """The weights of the terms that are not 0, by name."""
        config = self.config
        terms = {"field": config.field_weight, "render": config.render_weight, "contrast": config.contrast_weight}
        return {
            self._term(teacher, name): weight * teacher.weight
            for teacher in self._teachers
            for name, weight in terms.items()
            if weight * teacher.weight and (teacher.contrast or name != "contrast")
        }

    def _term(self, teacher: TeacherRecipe, name: str) -> str:
        return name if len(self._teachers) == 1 else f"{teacher.name}/{name}"

    @property
    def advice(self) -> str:
        """Settings that leave nothing to compare."""
        return "loss.min_alpha, loss.min_kept and loss.rarity"

    def divisors(self, batch: Batch) -> dict[str, float]:
        """The sum of the weights of a batch's Gaussians or rows, for each term."""
        divisors = {}
        for teacher, targets in zip(self._teachers, batch.teachers, strict=True):
            gaussians = float(targets.loss_weights.double().sum())
            divisors[self._term(teacher, "field")] = gaussians
            divisors[self._term(teacher, "render")] = float(targets.rows.row_weights.double().sum())
            divisors[self._term(teacher, "contrast")] = gaussians
        return divisors

    def __call__(self, batch: Batch) -> dict[str, Tensor]:
        """Totals of the terms whose weight is not 0, for the encoder's predictions."""
        return self.terms(self.network(batch.attributes, batch.opacities, batch.plan), batch)

    def terms(self, predicted: Float[Tensor, "N C"], batch: Batch) -> dict[str, Tensor]:
        """Totals of the terms whose weight is not 0; the terms of a teacher that the batch's scenes lack are 0."""
        widths = [teacher.channels for teacher in self._teachers]
        terms: dict[str, Tensor] = {}
        with torch.autocast(predicted.device.type, enabled=False):
            columns = predicted.split(widths, dim=1)
            for number, (teacher, targets) in enumerate(zip(self._teachers, batch.teachers, strict=True)):
                if teacher.weight:
                    totals = self._teacher_terms(columns[number], targets, number)
                    terms |= {self._term(teacher, name): total for name, total in totals.items()}
        return terms

    def _teacher_terms(
        self, predicted: Float[Tensor, "N C"], targets: TeacherTargets, number: int
    ) -> dict[str, Tensor]:
        """The terms of one teacher; the render loss without rows is 0."""
        config, terms = self.config, dict[str, Tensor]()
        teacher = self._teachers[number]
        if config.field_weight:
            terms["field"] = field_loss(predicted, targets.targets.float(), targets.loss_weights, config)
        if config.render_weight:
            rows, heads = targets.rows, self._heads.get(teacher.name, ())
            b = rows.blend(len(predicted))
            terms["render"] = render_loss(predicted, b, rows.targets, rows.row_weights, config, heads)
        if config.contrast_weight and teacher.contrast:
            codebook = self._codebooks[number]
            terms["contrast"] = contrast_loss(predicted, targets.codes, targets.loss_weights, codebook, config)
        return terms


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
    """A trainer that distills the teachers of a dataset into an encoder.

    Args:
        encoder: the encoder, trained in place and moved to `device`.
        dataset: the training samples.
        losses: weights and parameters of the loss terms.
        heads: adapter heads of teachers, by name.
        settings: the other arguments of `Trainer`.
    """
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
    prepare_threads: int = field(
        default=0,
        metadata={
            "help": "threads of each process while scenes are prepared; 0 = the machine's cores, divided among its "
            "processes"
        },
    )

    def __post_init__(self) -> None:
        SourceConfig.__post_init__(self)
        if self.prepare_threads < 0:
            raise InputError(f"prepare_threads: expected 0 or more, got {self.prepare_threads}")
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
    """The result of a training run.

    Attributes:
        encoder: the trained network.
        outputs: its output spaces.
        tables: text tables of the teachers that have one, by name.
        state: steps and seconds of the training.
        scores: scores of the last validation; empty without held-out scenes.
    """

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

    An interrupted call is resumed by the next one with the same `work`, from its checkpoint and its prepared scenes.

    Args:
        scenes: folders or splat files to train on.
        config: settings of the run.
        work: folder for the checkpoint and the log; created if it does not exist.
        held_out: scenes on which `validate` scores the encoder.
        prepared: folder of prepared scenes, which runs with the same sources can share; None = a folder in `work`.
        device: the device on which scenes are prepared and the encoder is trained.
        validate: scores the encoder during training, for example `gsencoder.evaluate.validation.validate_names`.
    """
    folder = Path(work)
    training, validation = [Path(path) for path in scenes], [Path(path) for path in held_out]
    words = words_by_teacher(config.teachers_by_name, config.text, members=bool(config.teachers))
    with join_processes(device) as (process, chosen_device):
        folder.mkdir(parents=True, exist_ok=True)
        with fail_together():
            if process.is_first:
                check_same_teachers(folder / TRAINING_CHECKPOINT_FILE, list(config.teachers_by_name))
        prepared_folder = Path(prepared) if prepared is not None else folder / "prepared"
        voxel = config.model.voxel
        with threads_of_torch(cpu_share(process, config.prepare_threads)):
            datasets = prepare_scenes(
                training,
                validation,
                words,
                config,
                prepared_folder,
                voxel=voxel,
                heads=required_heads(config.heads, config.teachers_by_name),
                process=process,
                device=chosen_device,
                track=track,
            )
        return fit(
            datasets,
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
    datasets: Mapping[str, PreparedDataset],
    training: Sequence[str],
    held_out: Sequence[str],
    words: Mapping[str, Words],
    config: TrainConfig,
    *,
    work: Path,
    process: ProcessRank,
    device: torch.device,
    validate: SceneValidator | None = None,
    track: Track = untracked,
) -> Training:
    """Trains an encoder on prepared scenes, given by name; the other arguments are those of `train`."""
    # Samples are numbered by scene, so that the order in which scenes are given must not matter to a resumed run.
    training = sorted(training)
    spaces = {name: dataset.load_space() for name, dataset in datasets.items()}
    outputs = OutputSpaces(by_teacher={name: space for name, (space, _) in spaces.items()})
    with_heads = teacher_of_heads(config.teachers_by_name, config.heads)
    heads = dataset_heads(datasets[with_heads], config.heads)
    if len(heads.heads) < len(config.heads):
        raise InputError(f"heads: {', '.join(config.heads)} names a head twice; its loss would count twice")
    check_agreement("the heads of L_render", heads_digest(heads))
    weights = config.loss.teacher_weights or (1.0,) * len(datasets)
    with_contrast = {name: config.loss.contrast_clusters or space[1] is not None for name, space in spaces.items()}
    if config.loss.contrast_weight and not any(with_contrast.values()):
        nothing_else = not config.loss.field_weight + config.loss.render_weight > 0
        message = (
            "loss.contrast_weight: the maps of no teacher are codes of a table of names, so L_contrast has no classes; "
            "loss.contrast_clusters=true takes clusters of targets as classes"
        )
        if nothing_else:
            raise InputError(message)
        warnings.warn(message, SceneWarning, stacklevel=2)
    _check_trained(config.loss, weights, with_contrast)
    recipe = SampleRecipe(
        encoder=config.model,
        sampling=config.sampling,
        augmentation=config.augment,
        losses=config.loss,
        teachers=tuple(
            TeacherRecipe(
                name=name,
                class_balance=dataset.load_class_balance(),
                weight=weight,
                contrast=with_contrast[name],
            )
            for (name, dataset), weight in zip(datasets.items(), weights, strict=True)
        ),
        seed=config.train.seed,
        step_samples=config.train.samples_per_step(process.world_size),
    )
    score_encoder: Callable[[GaussianEncoder], ValidationResult] = lambda encoder: ValidationResult({})  # noqa: ARG005, E731
    if validate is not None and held_out:
        held_out_parts = [_parts(datasets, name) for name in held_out]
        scenes = [TrainingScene(parts) for parts in held_out_parts if any(part is not None for part in parts)]
        codebooks = {teacher.name: teacher.class_balance.codebook for teacher in recipe.teachers}
        score_encoder = lambda encoder: validate(scenes, encoder, outputs, codebooks)  # noqa: E731
    if process.world_size > 1:
        digests = [dataset.digest_of_scenes(training) for dataset in datasets.values()]
        check_agreement("the prepared scenes", digest_of(digests))
    scenes_to_train_on = [TrainingScene(_parts(datasets, name)) for name in training]
    torch.manual_seed(config.train.seed)
    encoder = GaussianEncoder(config.model, outputs.widths)
    trainer = encoder_trainer(
        encoder,
        SampleDataset(scenes_to_train_on, recipe),
        config.loss,
        config.train,
        folder=work,
        settings=resume_settings(config, process, datasets, training),
        heads={with_heads: render_heads(heads, outputs[with_heads])},
        process=process,
        device=device,
        tensorboard=config.tensorboard,
        validate=score_encoder,
    )
    state = trainer.run(track)
    # A run that is resumed after its last step and validation has not validated in this process.
    if trainer.last_validation is None:
        trainer.last_validation = score_encoder(encoder)
    scores = dict(trainer.last_validation.scores) if trainer.last_validation is not None else {}
    tables = {name: _table_of(each, datasets[name]) for name, each in words.items()}
    return Training(encoder=encoder, outputs=outputs, tables=tables, state=state, scores=scores)


def _check_trained(losses: LossConfig, weights: Sequence[float], with_contrast: Mapping[str, bool]) -> None:
    """Warns of teachers on which no loss is computed, since the encoder offers their features all the same."""
    of_all = losses.field_weight + losses.render_weight > 0
    untrained = [
        name
        for (name, contrast), weight in zip(with_contrast.items(), weights, strict=True)
        if not weight or not (of_all or (contrast and losses.contrast_weight))
    ]
    if not untrained:
        return
    option = f"loss.teacher_weights={list(weights)}"
    if len(untrained) == len(weights):
        raise InputError(f"loss: the losses of every teacher have the weight 0 ({option}); give one of them a weight")
    names = f"teacher {untrained[0]}" if len(untrained) == 1 else f"teachers {', '.join(untrained)}"
    warnings.warn(
        f"{names}: no loss is computed with a weight above 0 ({option}), so that the encoder gives features that were "
        "never trained; give a weight above 0, or leave the teacher out",
        SceneWarning,
        stacklevel=3,
    )


def _parts(datasets: Mapping[str, PreparedDataset], name: str) -> list[PreparedScene | None]:
    """The prepared scene of each teacher; None for those that the scene lacks."""
    return [dataset.find_scene(name) for dataset in datasets.values()]


def _table_of(words: Words, dataset: PreparedDataset) -> TextTable:
    """The names that are known without a tower: those of a table, or of a tower's vocabulary and the dataset. It states
    those trained on, where the dataset has classes with names."""
    kinds = dataset.load_kinds()
    return closed_table(words.trained_on(kinds) if kinds else words)


def resume_settings(
    config: TrainConfig, process: ProcessRank, datasets: Mapping[str, PreparedDataset], training: Sequence[str]
) -> dict[str, Any]:
    """The settings that a run must share with the one that it resumes, as JSON values.

    The distribution of a step's micro-batches over processes may change.
    """
    shared = {name: plain(getattr(config, name)) for name in ("model", "sampling", "augment", "loss", "train")}
    for name in CHANGEABLE_ON_RESUME:
        del shared["train"][name]
    with_heads = teacher_of_heads(config.teachers_by_name, config.heads)
    digest = heads_digest(dataset_heads(datasets[with_heads], config.heads))
    heads = f"{','.join(config.heads)} ({digest})" if config.heads else ""
    spaces = {name: dataset.fingerprint() for name, dataset in datasets.items()}
    prepared = {name: dataset.settings for name, dataset in datasets.items()}
    if len(datasets) == 1:
        (space,), (of_preparation,) = spaces.values(), prepared.values()
        of_teachers: dict[str, Any] = {"space": space, "prepared": of_preparation}
    else:
        # The order, which a mapping does not state when it is compared, is that of the columns.
        scenes = {name: [each.name for each in dataset.scenes(training)] for name, dataset in datasets.items()}
        of_teachers = {"teachers": list(datasets), "spaces": spaces, "prepared": prepared, "scenes": scenes}
    return {
        **shared,
        **of_teachers,
        "heads": heads,
        "samples_per_step": config.train.samples_per_step(process.world_size),
    }
