"""`gsencoder train SCENE… out=FOLDER`: distil a teacher into an encoder that needs neither photographs nor teacher."""

import hashlib
import os
import shutil
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from fnmatch import fnmatch
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import torch

from gsencoder.app.runs.output_folder import lies_in, output_folder, refuse_to_replace_inputs
from gsencoder.app.runs.progress import Progress, console
from gsencoder.app.runs.summary import Summary
from gsencoder.app.runs.work_folder import WorkFolder
from gsencoder.app.settings.config import CommonConfig, settings
from gsencoder.core.errors import InputError, about
from gsencoder.core.files.model_files import find_file
from gsencoder.core.runtime.device_names import Device
from gsencoder.core.runtime.heap import keep_heap
from gsencoder.data.scenes import SceneConfig, find_scenes, load_scene
from gsencoder.data.seeding.seed import SeedConfig, with_gaussians
from gsencoder.data.seeding.spacing import unit_of
from gsencoder.data.splats import READABLE
from gsencoder.evaluate.validation import validate_encoder
from gsencoder.fusion.orbit_views import check_orbits, with_views
from gsencoder.fusion.store.folder import WORDS_FILE
from gsencoder.fusion.teachers import Teacher
from gsencoder.fusion.teachers.build import TeacherConfig, build_teacher, text_table_of
from gsencoder.fusion.teachers.labels import LabelsConfig
from gsencoder.infer.encode.chunks import EncodeConfig
from gsencoder.models.encoder import EncoderConfig, GaussianEncoder
from gsencoder.models.output_space import OutputSpace
from gsencoder.models.weights import WEIGHTS_FILE, save_weights
from gsencoder.text.table import TextTable, save_text_table
from gsencoder.train.adapter_heads import load_heads
from gsencoder.train.augment import AugmentConfig
from gsencoder.train.crops import SamplingConfig
from gsencoder.train.distributed import Place, joined, together
from gsencoder.train.log import EVENTS_FOLDER, LOG_FILE
from gsencoder.train.losses import LossConfig
from gsencoder.train.prepare import PrepareConfig, PreparedDataset
from gsencoder.train.prepared_scene import PreparedScene
from gsencoder.train.samples import SampleDataset, SampleRecipe
from gsencoder.train.trainer import Trainer, TrainerConfig, Validated
from gsencoder.types import Scene

SHOWN_SCENES = 3
"""Held-out scenes of which a view is drawn at every validation."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainConfig(CommonConfig):
    """Settings of `train`."""

    has_experiments: ClassVar[bool] = True

    paths: tuple[str, ...] = field(
        default=(), metadata={"help": "scenes, or folders of scenes", "metavar": "SCENE", "required": True}
    )
    holdout: tuple[str, ...] = field(
        default=(), metadata={"help": "names of scenes kept for validation, with * and ? as in file names"}
    )
    prepared: Path | None = field(
        default=None,
        metadata={"help": "folder of prepared scenes, made if missing; empty = OUT.prepared", "metavar": "PATH"},
    )
    prepare_only: bool = field(default=False, metadata={"help": "prepare the scenes and stop"})
    resume: bool = field(default=True, metadata={"help": "go on where a run that was cut off stopped"})
    tensorboard: bool = field(default=True, metadata={"help": "write TensorBoard events beside log.csv"})
    heads: str = field(
        default="",
        metadata={"help": "file of the teacher's adapter heads, behind which cells are compared; empty = none"},
    )
    store: Literal["float16", "float32"] = field(
        default="float16", metadata={"help": "type of the written weights and words"}
    )
    device: Device = field(default="auto", metadata={"help": "where the encoder computes"})
    splat: str = field(default="", metadata={"help": f"Gaussians of scenes with views; empty = seeds. {READABLE}"})
    orbits: int = field(default=24, metadata={"help": "cameras put around a splat that has no views"})
    data: SceneConfig = field(default_factory=SceneConfig)
    seeds: SeedConfig = field(default_factory=SeedConfig)
    teacher: TeacherConfig = field(default_factory=LabelsConfig)
    prepare: PrepareConfig = field(default_factory=PrepareConfig)
    model: EncoderConfig = field(default_factory=EncoderConfig, metadata={"preset": "tiny"})
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    train: TrainerConfig = field(default_factory=TrainerConfig)

    def __post_init__(self) -> None:
        check_orbits(self.orbits)


def run(config: TrainConfig, summary: Summary) -> None:
    """Prepares scenes, trains, and writes weights, log and scores into out=."""
    keep_heap()
    out = config.out or Path("outputs") / "train"
    real = Path(os.path.realpath(out))
    work, kept = real.with_name(f"{real.name}.training"), config.prepared or real.with_name(f"{real.name}.prepared")
    for name, taken in (("out", real), ("the state of the run", work)):
        if lies_in(kept, taken):
            raise InputError(f"prepared={kept}: lies in the folder of {name}, {taken}; give another folder")
    training, held_out = split(find_scenes(config.paths), config.holdout)
    words = text_table_of(config.teacher)
    with WorkFolder(work) as state, joined(config.device) as (place, device), ExitStack() as results:
        track = Progress(quiet=config.quiet or not place.first)
        folder = None
        with together():
            if place.first and not config.prepare_only:
                # Opened now, so that an out= that cannot be written is told before hours of work.
                folder = results.enter_context(output_folder(out, overwrite=config.overwrite, summary=summary))
        with summary.step("prepare"):
            dataset = prepare(training, held_out, words, config, kept, place, track)
        if config.prepare_only:
            counts = f"{len(training)} scenes to train on, {len(held_out)} for validation"
            console(config.quiet or not place.first).print(f"{dataset.folder}: {counts}")
            return
        with together():
            if place.first:
                refuse_to_replace_inputs(work, settings(config))
                state.take(anew=not config.resume)
        trainer, outputs = make_trainer(dataset, training, held_out, config, state.path, place, device)
        with summary.step("train"):
            done = trainer.run(track)
        if folder is None:
            return
        write_results(folder, trainer, outputs, words, config, summary)
    scores = summary.results["validation"]
    told = ", ".join(f"{name} {value:.3f}" for name, value in scores.items()) or "not validated"
    console(config.quiet).print(f"{out}: {done.step} steps in {done.seconds / 60:.1f} minutes; {told}")


def make_trainer(
    dataset: PreparedDataset,
    training: Sequence[Path],
    held_out: Sequence[Path],
    config: TrainConfig,
    work: Path,
    place: Place,
    device: torch.device,
) -> tuple[Trainer, OutputSpace]:
    """The trainer of prepared scenes, and the space that its encoder learns."""
    outputs, _ = dataset.load_space()
    rarity = dataset.load_rarity()
    recipe = SampleRecipe(
        encoder=config.model,
        sampling=config.sampling,
        augmentation=config.augment,
        losses=config.loss,
        rarity=rarity,
        seed=config.train.seed,
        step_samples=config.train.samples_per_step(place.size),
    )
    validation = dataset.scenes([path.name for path in held_out])
    torch.manual_seed(config.train.seed)
    trainer = Trainer(
        GaussianEncoder(config.model, outputs.channels),
        SampleDataset(dataset.scenes([path.name for path in training]), recipe),
        config.loss,
        config.train,
        folder=work,
        settings=_identity(config, place, dataset),
        heads=load_heads(find_file(config.heads, "heads"), outputs) if config.heads else (),
        place=place,
        device=device,
        tensorboard=config.tensorboard,
        validate=partial(_validate, validation, outputs, rarity.codebook, config),
    )
    return trainer, outputs


def write_results(
    folder: Path,
    trainer: Trainer,
    outputs: OutputSpace,
    words: TextTable | None,
    config: TrainConfig,
    summary: Summary,
) -> None:
    """Weights, words, log and pictures; what was reached goes into the summary."""
    done, encoder = trainer.state, trainer.encoder
    # A run that had been cut off after its last step has not validated it.
    judged = trainer.validated or trainer.validate(encoder)
    scores = dict(judged.scores)
    made_by = {"settings": settings(config), "steps": done.step, "seconds": done.seconds, "validation": scores}
    save_weights(folder / WEIGHTS_FILE, encoder, outputs, made_by, dtype=config.store)
    if words is not None:
        save_text_table(folder / WORDS_FILE, words, dtype=config.store)
    shutil.copy(trainer.folder / LOG_FILE, folder / LOG_FILE)
    for name in (EVENTS_FOLDER, "validation"):
        if (trainer.folder / name).is_dir():
            shutil.copytree(trainer.folder / name, folder / name)
    summary.results.update(
        steps=done.step,
        seconds=done.seconds,
        parameters=sum(value.numel() for value in encoder.parameters()),
        validation=scores,
        weights=WEIGHTS_FILE,
        log=LOG_FILE,
    )


def split(paths: Sequence[Path], patterns: Sequence[str]) -> tuple[list[Path], list[Path]]:
    """Scenes to train on, and those whose names match a pattern.

    Raises:
        InputError: a pattern that matches nothing, none left to train on, or two scenes of one name.
    """
    names = [path.name for path in paths]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"paths: two scenes are called {twice!r}; prepared scenes are told apart by name")
    for pattern in patterns:
        if not any(fnmatch(name, pattern) for name in names):
            raise InputError(f"holdout: no scene is called {pattern!r}; there are {', '.join(names[:5])}, …")
    held = [path for path in paths if any(fnmatch(path.name, pattern) for pattern in patterns)]
    training = [path for path in paths if path not in held]
    if not training:
        raise InputError("holdout: matches every scene; none is left to train on")
    return training, held


def prepare(
    training: Sequence[Path],
    held_out: Sequence[Path],
    words: TextTable | None,
    config: TrainConfig,
    folder: Path,
    place: Place,
    track: Progress,
) -> PreparedDataset:
    """Prepares what is not prepared yet in `folder`; processes share the scenes.

    Raises:
        InputError: of any process; the scene is named.
    """
    made_with = {
        "scenes": {path.name: str(path.resolve()) for path in training},
        "words": _digest_of(words),
        **{name: settings(getattr(config, name)) for name in ("data", "seeds", "teacher", "prepare")},
        **{"splat": config.splat, "orbits": config.orbits, "voxel": config.model.voxel},
    }
    opened = OpenScenes(config, words)
    with together():
        if place.first:
            dataset = PreparedDataset(folder, made_with)
            dataset.remove_leftovers()
            dataset.find_space(training, opened.look, config.prepare)
    dataset = PreparedDataset(folder, made_with)
    missing = [path for path in [*training, *held_out] if not dataset.holds(path)]
    with together():
        pass  # Nobody begins before everybody has seen what is missing.
    with together():
        for path in track(missing[place.rank :: place.size], "preparing scenes"):
            scene, teacher = opened.complete(path)
            with about(path):
                dataset.prepare(scene, teacher, config.prepare, source=path)
    with together():
        if place.first:
            dataset.find_rarity([path.name for path in training], track)
    return dataset


class OpenScenes:
    """Reads scenes and gives each its teacher: one for all, unless it is made of the scene's own labels."""

    def __init__(self, config: TrainConfig, words: TextTable | None) -> None:
        self.config, self.words = config, words
        self._shared: Teacher | None = None

    def look(self, path: Path) -> tuple[Scene, Teacher]:
        """A scene for a look at its maps, without Gaussians where it has views.

        Raises:
            InputError: whatever is wrong with the scene, which is named.
        """
        with about(path):
            scene = load_scene(path, splat=self.config.splat or None, options=self.config.data)
            if scene.views is None:
                scene = with_views(scene, self.config.orbits, self.config.prepare.fusion.blend)
            return scene, self._teacher(scene)

    def complete(self, path: Path) -> tuple[Scene, Teacher]:
        """A scene with Gaussians, views and a unit, under the name of its folder.

        Raises:
            InputError: whatever is wrong with the scene, which is named.
        """
        scene, teacher = self.look(path)
        with about(path):
            scene = with_gaussians(scene, self.config.seeds)
            return replace(scene, name=path.name, metres_per_unit=unit_of(scene, self.config.model.voxel)), teacher

    def _teacher(self, scene: Scene) -> Teacher:
        if isinstance(self.config.teacher, LabelsConfig):
            return build_teacher(self.config.teacher, scene, self.words)
        if self._shared is None:
            self._shared = build_teacher(self.config.teacher, scene, self.words)
        return self._shared


def _digest_of(words: TextTable | None) -> str:
    if words is None:
        return ""
    return hashlib.sha256(repr(words.names).encode() + words.embeddings.tobytes()).hexdigest()[:16]


def _digest_of_file(given: str) -> str:
    """What a file of adapter heads holds, wherever it lies; empty for none."""
    return hashlib.sha256(find_file(given, "heads").read_bytes()).hexdigest()[:16] if given else ""


def _validate(
    scenes: Sequence[PreparedScene],
    outputs: OutputSpace,
    codebook: np.ndarray,
    config: TrainConfig,
    encoder: GaussianEncoder,
) -> Validated:
    if not scenes:
        return Validated({})
    encoding = EncodeConfig(precision=config.train.precision, device=config.device)
    found = validate_encoder(scenes, encoder, outputs, codebook, encoding, shown=SHOWN_SCENES)
    pictures = {} if found.sheet is None else {"features": found.sheet}
    return Validated({"names": found.score, "cosine_named": found.cosine_named}, pictures)


def _identity(config: TrainConfig, place: Place, dataset: PreparedDataset) -> dict[str, Any]:
    """What a run must have in common with one that it continues."""
    chosen = {name: settings(getattr(config, name)) for name in ("model", "sampling", "augment", "loss", "train")}
    for name in ("workers", "log_every", "validate_every", "checkpoint_every", "compile", "accumulate"):
        del chosen["train"][name]
    told = {"space": dataset.fingerprint(), "prepared": dataset.settings, "heads": _digest_of_file(config.heads)}
    # How the micro-batches of a step are spread over processes may change.
    return {**chosen, **told, "samples_per_step": config.train.samples_per_step(place.size)}
