"""Training samples: augmented crops of prepared scenes with their plans, targets and rows of the render loss.

All random numbers of sample k of a run come from (seed, k), and its size from (seed, step). Nothing depends on the
process that makes a sample or on the samples before it, so that an interrupted run, or a run on more machines, goes
through the same samples.
"""

from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, Int32, Int64
from torch.utils.data import Dataset, Sampler

from gsencoder.core.errors import InputError, about
from gsencoder.models.encoder import EncoderConfig, encoder_inputs
from gsencoder.train.augment import AugmentConfig, augment
from gsencoder.train.batch import Sample, TeacherTargets, no_targets
from gsencoder.train.class_balance import ClassBalance, nearest_codes
from gsencoder.train.crops import SamplingConfig, choose_crop, crop_size, drop_random
from gsencoder.train.losses import LossConfig
from gsencoder.train.prepared_scene import PreparedScene
from gsencoder.train.render_rows import empty_rows, join_rows, make_render_rows, restrict_rows
from gsencoder.train.training_scene import TrainingScene

MAX_OPEN_FILES = 256
"""Largest number of files of prepared scenes, one for each teacher, that a process keeps open; those of the scene that
was used least recently are closed first."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TeacherRecipe:
    """A teacher of a training.

    Attributes:
        name: for messages and logs.
        class_balance: classes of its targets in the dataset and their frequencies; the columns of the codebook are the
            teacher's columns of the encoder's outputs.
        weight: of its losses.
        contrast: whether its losses include L_contrast.
    """

    name: str
    class_balance: ClassBalance
    weight: float = 1.0
    contrast: bool = True

    @property
    def channels(self) -> int:
        """Columns of its targets."""
        return self.class_balance.codebook.shape[1]


@dataclass(frozen=True, slots=True, kw_only=True)
class SampleRecipe:
    """Settings of making samples from scenes.

    Attributes:
        encoder: attributes and grid of the encoder.
        sampling: selection of views and Gaussians.
        augmentation: random changes; None = none.
        losses: thresholds of the rows of the render loss, and the power of class weights.
        teachers: the teachers, in the order of the encoder's output columns. Centers of crops are drawn by the classes
            of the first one that a scene has.
        seed: seed of all random numbers.
        step_samples: samples of one step over all processes; their crops have one size, so that no process waits for
            another.
    """

    encoder: EncoderConfig
    sampling: SamplingConfig
    augmentation: AugmentConfig | None
    losses: LossConfig
    teachers: tuple[TeacherRecipe, ...]
    seed: int
    step_samples: int = 1

    def uses_classes(self, teacher: TeacherRecipe) -> bool:
        """Whether samples depend on the classes of a teacher's targets: by the centers of crops, by weights of rare
        classes, or by L_contrast."""
        by_center = self.sampling.rare_centers > 0 and self.sampling.gaussians > 0
        by_contrast = teacher.contrast and teacher.weight > 0 and self.losses.contrast_weight > 0
        return by_center or by_contrast or self.losses.rarity != 0


Codes = tuple[Int32[np.ndarray, " N"] | None, ...]
"""For each teacher the class of each Gaussian's target, −1 without a target; None in a scene that lacks the teacher."""


class SampleDataset(Dataset[Sample]):
    """The samples of a run by number; each epoch goes through the scenes in a new random order."""

    def __init__(self, scenes: Sequence[TrainingScene], recipe: SampleRecipe) -> None:
        """Args:
        scenes: the scenes to train on.
        recipe: settings of the samples.

        Raises:
            InputError: there are no scenes.
        """
        if not scenes:
            raise InputError("training: no scenes to train on")
        self.scenes, self.recipe = list(scenes), recipe
        self._codes: OrderedDict[int, Codes] = OrderedDict()

    def __getitem__(self, number: int) -> Sample | InputError:  # type: ignore[override]
        """Sample `number`, or its error as a value: raised in a data worker it would arrive as a long traceback."""
        try:
            return self.make(number)
        except InputError as error:
            return error

    def make(self, number: int) -> Sample:
        """Makes sample `number`.

        Raises:
            InputError: its scene cannot be read, or no view of the scene sees a Gaussian.
        """
        epoch, position = divmod(number, len(self.scenes))
        order = np.random.default_rng([self.recipe.seed, 0, epoch]).permutation(len(self.scenes))
        rng = np.random.default_rng([self.recipe.seed, 1, number])
        step_rng = np.random.default_rng([self.recipe.seed, 2, number // self.recipe.step_samples])
        size = crop_size(self.recipe.sampling, step_rng)
        scene_index = int(order[position])
        scene = self.scenes[scene_index]
        with about(f"scene {scene.name}"):
            return make_sample(scene, self._target_codes(scene_index), self.recipe, size, rng)

    def _target_codes(self, scene_index: int) -> Codes:
        """Target classes of a scene's Gaussians for each teacher, cached together with the open scene.

        The number of open scenes is limited, since each holds a file descriptor.
        """
        if scene_index not in self._codes:
            self._codes[scene_index] = target_codes(self.scenes[scene_index], self.recipe)
        self._codes.move_to_end(scene_index)
        if len(self._codes) > max(1, MAX_OPEN_FILES // len(self.recipe.teachers)):
            oldest, _ = self._codes.popitem(last=False)
            self.scenes[oldest].close()
        return self._codes[scene_index]


class StepSampler(Sampler[list[int]]):
    """The sample numbers of each micro-batch of this process, in order of steps.

    Step s of a run takes samples s·n to (s + 1)·n − 1, where n = batch · accumulate · world. Each micro-batch of each
    process takes `batch` consecutive ones of them.
    """

    def __init__(self, first: int, last: int, *, batch: int, accumulate: int, rank: int, world: int) -> None:
        """Args:
        first: first step.
        last: step after the last one.
        batch: number of samples of a micro-batch.
        accumulate: number of micro-batches of a process in a step.
        rank: rank of this process.
        world: number of processes.
        """
        self.steps = range(first, last)
        self.batch, self.accumulate, self.rank, self.world = batch, accumulate, rank, world

    def __len__(self) -> int:
        return len(self.steps) * self.accumulate

    def __iter__(self) -> Iterator[list[int]]:
        for step in self.steps:
            for micro in range(self.accumulate):
                start = ((step * self.accumulate + micro) * self.world + self.rank) * self.batch
                yield list(range(start, start + self.batch))


def target_codes(scene: TrainingScene, recipe: SampleRecipe) -> Codes:
    """The class of each Gaussian's target, a row of each teacher's codebook.

    Finding classes reads all targets of a scene, which may be a gigabyte. Where nothing depends on them, every target
    is of class 0.

    Raises:
        InputError: the scene was not prepared for the same Gaussians and views by all teachers.
    """
    scene.check_consistent()
    result: list[np.ndarray | None] = []
    for part, teacher in zip(scene.parts, recipe.teachers, strict=True):
        if part is None:
            result.append(None)
            continue
        codes = np.full(len(part), -1, np.int32)
        seen = np.flatnonzero(part.weights)
        codes[seen] = (
            nearest_codes(teacher.class_balance.codebook, part.targets(seen)) if recipe.uses_classes(teacher) else 0
        )
        result.append(codes)
    return tuple(result)


def make_sample(
    scene: TrainingScene,
    codes: Codes,
    recipe: SampleRecipe,
    size: int,
    rng: np.random.Generator,
) -> Sample:
    """Makes a sample: selects views and Gaussians of a scene, augments them and computes the encoder's inputs.

    Args:
        scene: the scene.
        codes: target classes of its Gaussians for each teacher (`target_codes`).
        recipe: settings of the sample.
        size: largest number of Gaussians; 0 = all that the views see.
        rng: source of all random numbers.

    Raises:
        InputError: no view sees any of the scene's Gaussians.
    """
    # With the power 1 every class is equally often the center of a crop.
    first, first_codes = next((number, each) for number, each in enumerate(codes) if each is not None)
    center_weights = _weights_of(first_codes, recipe.teachers[first].class_balance, 1.0)
    views, selected = choose_crop(scene.means, scene.cameras, center_weights, recipe.sampling, size, rng)
    augmentation = recipe.augmentation
    remaining = drop_random(selected, augmentation.drop, rng) if augmentation is not None else selected
    voxel = recipe.encoder.voxel / (scene.metres_per_unit or 1.0)
    gaussians = scene.gaussians(remaining)
    if augmentation is not None:
        gaussians = augment(gaussians, rng, augmentation, voxel=voxel, up=scene.up)
    attributes, opacities, plan = encoder_inputs(gaussians, recipe.encoder, voxel)
    return Sample(
        name=f"{scene.name} ({', '.join(scene.view_names[view] for view in views)})",
        attributes=attributes,
        opacities=opacities,
        plan=plan,
        teachers=tuple(
            no_targets(len(remaining), teacher.channels)
            if part is None or part_codes is None
            else _targets_of(part, part_codes, teacher, recipe.losses, views, selected, remaining)
            for part, part_codes, teacher in zip(scene.parts, codes, recipe.teachers, strict=True)
        ),
    )


def _weights_of(codes: Int32[np.ndarray, " N"], balance: ClassBalance, power: float) -> Float32[np.ndarray, " N"]:
    """The weight n^−power of each Gaussian's class; 0 without a target, whose code −1 indexes the last row."""
    return np.append(balance.class_weights(power), np.float32(0))[codes]


def _targets_of(
    scene: PreparedScene,
    codes: Int32[np.ndarray, " N"],
    teacher: TeacherRecipe,
    losses: LossConfig,
    views: Sequence[int],
    selected: Int64[np.ndarray, " s"],
    remaining: Int64[np.ndarray, " n"],
) -> TeacherTargets:
    """The targets of one teacher for the remaining Gaussians, and its rows in the views."""
    balance = teacher.class_balance
    rows = [empty_rows(scene.channels)]
    for view in views if losses.render_weight and teacher.weight else ():
        view_rows = restrict_rows(scene.view(view), len(scene), selected, remaining, losses)
        rows.append(make_render_rows(view_rows, balance, losses.rarity))
    return TeacherTargets(
        targets=torch.from_numpy(scene.float16_targets(remaining)),
        codes=torch.from_numpy(codes[remaining].astype(np.int64)),
        loss_weights=torch.from_numpy(_weights_of(codes, balance, losses.rarity)[remaining]),
        rows=join_rows(rows, [0] * len(rows)),
    )
