"""Training samples: augmented crops of prepared scenes with their plans, targets and rows of the render loss.

All random numbers of sample k of a run come from (seed, k), and its size from (seed, step). Nothing depends on the
process that makes a sample or on the samples before it, so that an interrupted run, or a run on more machines, goes
through the same samples.
"""

import math
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int32, Int64
from scipy.spatial.transform import Rotation
from torch.utils.data import Dataset, Sampler

from gsencoder.core.errors import InputError, about
from gsencoder.geometry import sh_basis
from gsencoder.models.encoder import EncoderConfig, encoder_inputs
from gsencoder.train.batch import (
    Sample,
    SamplingConfig,
    TeacherTargets,
    choose_crop,
    crop_size,
    drop_random,
    empty_rows,
    join_rows,
    make_render_rows,
    no_targets,
    restrict_rows,
)
from gsencoder.train.losses import LossConfig
from gsencoder.train.prepare import ClassBalance, nearest_codes
from gsencoder.train.prepared_file import PreparedScene
from gsencoder.types import SH_C0, Cameras, Gaussians
from gsencoder.types.checks import perpendicular

_DIRECTIONS = 64
"""Directions over which harmonics are turned: more than enough for the 16 coefficients of degree 3."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AugmentConfig:
    """Strengths of the random changes to a training sample; 0 = none."""

    turn: float = field(
        default=180.0, metadata={"help": "largest rotation about the up axis in either direction, degrees"}
    )
    tilt: float = field(default=3.0, metadata={"help": "standard deviation of the tilt of the up axis, degrees"})
    mirror: float = field(default=0.5, metadata={"help": "probability of mirroring"})
    scale: float = field(default=0.1, metadata={"help": "largest relative change of size"})
    jitter: float = field(default=0.1, metadata={"help": "standard deviation of the shift of each center, voxels"})
    drop: float = field(default=0.2, metadata={"help": "largest share of Gaussians that is dropped at random"})
    light: float = field(default=0.2, metadata={"help": "largest relative change of brightness"})
    tint: float = field(
        default=0.08, metadata={"help": "largest relative change of each color channel, and largest shift of black"}
    )
    noise: float = field(
        default=0.02, metadata={"help": "standard deviation of the noise added to each Gaussian's color; white = 1"}
    )

    def __post_init__(self) -> None:
        for name in ("turn", "tilt", "jitter", "noise"):
            if not 0 <= getattr(self, name) < math.inf:
                raise InputError(f"{name}: expected 0 or more, got {getattr(self, name)}")
        for name in ("turn", "tilt"):
            if getattr(self, name) > 360:
                raise InputError(f"{name}: expected at most 360 degrees, got {getattr(self, name)}")
        for name in ("mirror", "drop", "scale", "light", "tint"):
            if not 0 <= getattr(self, name) <= (1 if name == "mirror" else 0.9):
                limit = 1 if name == "mirror" else 0.9
                raise InputError(f"{name}: expected a number from 0 to {limit}, got {getattr(self, name)}")


def augment(
    gaussians: Gaussians,
    rng: np.random.Generator,
    config: AugmentConfig,
    *,
    voxel: float,
    up: Float64[np.ndarray, "3"] | None = None,
) -> Gaussians:
    """Applies random changes to a splat; row i of the result is Gaussian i.

    Args:
        gaussians: the splat, world units.
        rng: source of all random numbers.
        config: strengths of the changes; `drop` is applied by `samples.make_sample`, since it removes rows.
        voxel: unit of `jitter`, world units.
        up: axis of `turn`, a unit vector; None = the z axis of the world.
    """
    axis = np.array([0.0, 0.0, 1.0]) if up is None else up / np.linalg.norm(up)
    rotation = Rotation.from_rotvec(axis * math.radians(rng.uniform(-config.turn, config.turn)))
    horizontal = Rotation.from_rotvec(axis * rng.uniform(0, 2 * math.pi)).apply(perpendicular(axis))
    rotation = Rotation.from_rotvec(horizontal * math.radians(rng.normal(0, config.tilt))) * rotation
    to_from = rotation.as_matrix()
    if rng.random() < config.mirror:
        to_from = to_from @ (np.eye(3) - 2 * np.outer(horizontal, horizontal))
    turned = turn(gaussians, to_from, float(rng.uniform(1 - config.scale, 1 + config.scale)))
    shift = rng.uniform(0, voxel, 3) + rng.normal(0, config.jitter * voxel, turned.means.shape)
    return replace(
        turned,
        means=(turned.means + shift).astype(np.float32),
        sh=_relight(turned.sh, rng, config),
    )


def turn(gaussians: Gaussians, to_from: Float64[np.ndarray, "3 3"], scale: float = 1.0) -> Gaussians:
    """The splat after x → scale · to_from · x: means, quats, scales and harmonics together.

    Args:
        gaussians: world units.
        to_from: a rotation, or a rotation with a mirror: any orthonormal matrix.
        scale: > 0.
    """
    if np.abs(to_from @ to_from.T - np.eye(3)).max() > 1e-6 or not 0 < scale < math.inf:
        raise InputError("turn: expected an orthonormal matrix and a positive scale")
    mirrored = np.linalg.det(to_from) < 0
    # A Gaussian looks the same mirrored through its center, so −M turns its axes as M does, and is a rotation.
    rotation = Rotation.from_matrix(-to_from if mirrored else to_from)
    # A product of quaternions is linear in each: those with 1, i, j and k make its matrix. For many Gaussians that is
    # ten times faster than scipy's product with each.
    units = Rotation.from_quat(np.eye(4), scalar_first=True)
    quats = gaussians.quats @ (rotation * units).as_quat(scalar_first=True)
    return Gaussians(
        means=(gaussians.means.astype(np.float64) @ (scale * to_from.T)).astype(np.float32),
        quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        scales=(gaussians.scales * np.float32(scale)).astype(np.float32),
        opacities=gaussians.opacities,
        sh=_turn_sh(gaussians.sh, to_from),
    )


def _turn_sh(sh: Float32[np.ndarray, "N K 3"], to_from: np.ndarray) -> Float32[np.ndarray, "N K 3"]:
    """Coefficients of the turned function, f'(d) = f(to_fromᵀ d), from its values in many directions: exact, since a
    turned harmonic is a sum of harmonics of its degree."""
    degree = math.isqrt(sh.shape[1]) - 1
    if degree == 0:
        return sh
    i = np.arange(_DIRECTIONS) + 0.5
    z, azimuth = 1 - 2 * i / _DIRECTIONS, i * math.pi * (1 + 5**0.5)
    radius = np.sqrt(1 - z * z)
    directions = np.stack((radius * np.cos(azimuth), radius * np.sin(azimuth), z), axis=1)
    basis = sh_basis(torch.from_numpy(directions), degree).numpy()
    unturned_basis = sh_basis(torch.from_numpy(directions @ to_from), degree).numpy()
    matrix = np.linalg.lstsq(basis, unturned_basis, rcond=None)[0]
    return np.einsum("kj,njc->nkc", matrix, sh).astype(np.float32)


def _relight(
    sh: Float32[np.ndarray, "N K 3"], rng: np.random.Generator, config: AugmentConfig
) -> Float32[np.ndarray, "N K 3"]:
    """Changes brightness and tint and adds noise; colors are ½ + SH_C0·dc, and all degrees are scaled equally."""
    gain = rng.uniform(1 - config.light, 1 + config.light) * rng.uniform(1 - config.tint, 1 + config.tint, 3)
    relit = sh * gain
    black_shift = 0.5 * gain - 0.5 + rng.uniform(-config.tint, config.tint)
    relit[:, 0] += (black_shift + rng.normal(0, config.noise, (len(sh), 3))) / SH_C0
    return relit.astype(np.float32)


class TrainingScene:
    """The prepared files of one scene. Gaussians and cameras are read from the first of them, and are the same in all.

    Attributes:
        parts: the prepared scene of each teacher, in the order of the teachers; None for those that the scene lacks.
        name: of the scene.
    """

    def __init__(self, parts: Sequence[PreparedScene | None]) -> None:
        """Args:
        parts: see the class.
        """
        present = [part for part in parts if part is not None]
        if not present:
            raise InputError("training: a scene has no teacher")
        self.parts, self._first = tuple(parts), present[0]
        self.name = self._first.name

    def check_consistent(self) -> None:
        """Checks that all parts were prepared for the same Gaussians and views."""
        first = self._first
        for part in self.parts:
            same = part is None or (
                part.view_names == first.view_names
                and len(part) == len(first)
                and np.array_equal(part.means, first.means)
            )
            if part is not None and not same:
                raise InputError(
                    f"{part.path}: has other Gaussians or views than {first.path}; remove both to prepare the scene "
                    "again"
                )

    def close(self) -> None:
        """Closes the files; the next access opens them again."""
        for part in self.parts:
            if part is not None:
                part.close()

    def __len__(self) -> int:
        return len(self._first)

    @property
    def cameras(self) -> Cameras:
        return self._first.cameras

    @property
    def view_names(self) -> tuple[str, ...]:
        return self._first.view_names

    @property
    def metres_per_unit(self) -> float | None:
        return self._first.metres_per_unit

    @property
    def up(self) -> Float64[np.ndarray, "3"] | None:
        return self._first.up

    @property
    def means(self) -> Float32[np.ndarray, "N 3"]:
        return self._first.means

    def gaussians(self, rows: np.ndarray) -> Gaussians:
        """Reads Gaussians by row; see `PreparedScene.gaussians`."""
        return self._first.gaussians(rows)


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
        """Makes sample `number`."""
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
        codes: target classes of its Gaussians for each teacher (`target_codes`).
        recipe: settings of the sample.
        size: largest number of Gaussians; 0 = all that the views see.
        rng: source of all random numbers.
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
