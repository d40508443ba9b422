"""Training samples: augmented crops of prepared scenes with their plans, targets and rows of the render loss.

All random numbers of sample k of a run come from (seed, k), and its size from (seed, step). Nothing depends on the
process that makes a sample or on the samples before it, so that an interrupted run, or a run on more machines, goes
through the same samples.
"""

import math
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int32, Int64, Integer
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.utils.data import Dataset

from gsencoder.core.errors import InputError, error_prefix, listed
from gsencoder.core.settings import CheckedConfig, option
from gsencoder.data.up import scaled, turn, upright_gaussians
from gsencoder.models.encoder import EncoderConfig, encoder_inputs
from gsencoder.models.plan import CloudPlan, join_plans
from gsencoder.train.losses import TERMS, Batch, LossConfig, RenderRows, TeacherRecipe, TeacherTargets
from gsencoder.train.prepared import ScenePart, ViewRows, nearest_codes
from gsencoder.types import SH_C0, Cameras, Gaussians
from gsencoder.types.scene import perpendicular

NEAR = 0.01
"""Smallest depth of a Gaussian that a view shows, world units."""
_CANDIDATES_PER_GAUSSIAN = 4
"""Gaussians nearest to the center that are tested against the frusta first, as a multiple of the size of a crop."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SamplingConfig(CheckedConfig):
    """Selection of the Gaussians and views of a sample (SplatDistill sec. 3.3, "view-dependent selection")."""

    views: int = option(4, "number of target views of a sample, in which the render loss is computed", ge=1)
    gaussians: int = option(
        30_000, "largest number of Gaussians of a sample, nearest to its center first; 0 = all", ge=0
    )
    smallest: int = option(
        4_000, "smallest size of a crop; sizes are log-uniform up to `gaussians`; 0 = all of that size", ge=0
    )
    rare_centers: float = option(
        0.8, "share of crops whose center is drawn by target classes instead of evenly over Gaussians", ge=0, le=1
    )
    center_power: float = option(
        1.0,
        "power p of the weights n^−p by which these centers are drawn; 1 = classes evenly, 0 = Gaussians",
        ge=0,
        le=2,
    )
    coarsest: float = option(
        1.0, "largest edge of a sample's token grid, log-uniform from model.voxel, as a multiple of it", ge=1, le=16
    )

    def draw_voxel(self, voxel: float, rng: np.random.Generator) -> float:
        """Draws the edge of a token grid."""
        return voxel * self.coarsest ** rng.random() if self.coarsest > 1 else voxel


@dataclass(frozen=True, slots=True, kw_only=True)
class RoomsConfig(CheckedConfig):
    """Settings of the rooms that are made during a training."""

    libraries: tuple[str, ...] = option(
        (), "furniture libraries (.sh3f) for rooms that are made while the training runs; empty = no such rooms"
    )
    share: float = option(0.75, "share of the samples that is from these rooms; the others are from SCENES", gt=0, le=1)
    samples: int = option(128, "number of samples from each room", ge=1, le=1_000_000)
    without: tuple[str, ...] = option(
        (), "kinds that no room has, to judge an encoder on kinds that it never saw", names=True
    )

    def __post_init__(self) -> None:
        CheckedConfig.__post_init__(self)
        from gsencoder.data.furnished.kinds import kinds

        unknown = [name for name in self.without if name not in kinds()]
        if unknown:
            raise InputError(f"rooms.without={unknown[0]}: no such kind; the kinds are {listed(list(kinds()), 8)}")
        if self.without and not self.libraries:
            raise InputError("rooms.without: expected rooms.libraries= with it; things of SCENES keep their names")


def in_frusta(means: Float32[np.ndarray, "N 3"], cameras: Cameras) -> Bool[np.ndarray, " N"]:
    """True for Gaussians whose center lies in the image of at least one camera and beyond its near plane."""
    inside = np.zeros(len(means), bool)
    for view in range(len(cameras)):
        # The rows that are found already need not be looked at again.
        rows = np.flatnonzero(~inside)
        inside[rows] = cameras.in_image(*cameras.project(means[rows], view), view, near=NEAR)
    return inside


def nearest_rows(
    means: Float32[np.ndarray, "n 3"], center: Float32[np.ndarray, "3"], count: int
) -> Int64[np.ndarray, " m"]:
    """The `count` rows nearest to a point, in ascending order; all rows if there are not more."""
    if len(means) <= count:
        return np.arange(len(means))
    offsets = means - center
    distances = np.einsum("nc,nc->n", offsets, offsets)
    return np.sort(np.argpartition(distances, count)[:count])


def crop_size(config: SamplingConfig, rng: np.random.Generator) -> int:
    """Draws the largest number of Gaussians of a crop; 0 = no limit.

    Small crops show small objects often; large ones show the context by which a door or a sofa is recognized.
    """
    if not 0 < config.smallest < config.gaussians:
        return config.gaussians
    return round(config.smallest * (config.gaussians / config.smallest) ** rng.random())


def choose_crop(
    means: Float32[np.ndarray, "N 3"],
    cameras: Cameras,
    center_weights: Float32[np.ndarray, " N"],
    config: SamplingConfig,
    size: int,
    rng: np.random.Generator,
) -> tuple[tuple[int, ...], Int64[np.ndarray, " n"]]:
    """Chooses target views and the Gaussians of a sample: distinct views, fewer than `config.views` if no more are
    suitable, and rows in ascending order.

    Without a limit of size the views are drawn first and all Gaussians in their frusta are taken, as in the paper. With
    a limit the center of the crop is drawn first, by `center_weights`, which are 0 for Gaussians without a target, and
    the views are drawn from those that see it: other views would show nothing of the sample.
    """
    if not 0 < size < len(means):
        drawn = rng.permutation(len(cameras))
        views = drawn[: config.views]
        rows = np.flatnonzero(in_frusta(means, cameras.select(views)))
        for view in drawn[config.views :]:
            if len(rows):
                break
            # A view that sees nothing is replaced by another one.
            views = np.array([view])
            rows = np.flatnonzero(in_frusta(means, cameras.select(views)))
    else:
        center = means[_draw_center(center_weights, config, rng)]
        seeing = np.flatnonzero(cameras.in_image(*cameras.project(center[None]), near=NEAR)[:, 0])
        views = rng.permutation(seeing if len(seeing) else len(cameras))[: config.views]
        rows = nearest_rows(means, center, _CANDIDATES_PER_GAUSSIAN * size)
        selected = cameras.select(views)
        rows = rows[in_frusta(means[rows], selected)]
        if len(rows) < size:
            rows = np.flatnonzero(in_frusta(means, selected))
        if not len(rows):  # No view sees the center, and those drawn see no Gaussian at all: use all views.
            views = rng.permutation(len(cameras))
            rows = np.flatnonzero(in_frusta(means, cameras))
        rows = rows[nearest_rows(means[rows], center, size)]
    if not len(rows):
        raise InputError("sample: no Gaussian lies in the frustum of any view; check poses and units")
    return tuple(int(view) for view in views), rows


def _draw_center(center_weights: Float32[np.ndarray, " N"], config: SamplingConfig, rng: np.random.Generator) -> int:
    """Draws the row of the center of a crop."""
    weights = center_weights.astype(np.float64)
    if rng.random() >= config.rare_centers:
        weights = (weights > 0).astype(np.float64)
    cumulative = np.cumsum(weights)
    if not 0 < cumulative[-1] < math.inf:
        return int(rng.integers(len(center_weights)))
    return int(min(np.searchsorted(cumulative, rng.random() * cumulative[-1], side="right"), len(center_weights) - 1))


def drop_random(rows: Int64[np.ndarray, " n"], max_share: float, rng: np.random.Generator) -> Int64[np.ndarray, " m"]:
    """Drops each row with one probability that is drawn between 0 and `max_share`; never drops all rows."""
    if not max_share:
        return rows
    remaining = rows[rng.random(len(rows)) >= rng.uniform(0, max_share)]
    return remaining if len(remaining) else rows


@dataclass(frozen=True, slots=True, kw_only=True)
class Augmentation:
    """Strengths of the random changes to a training sample; 0 = none."""

    turn: float = 4.0  # standard deviation of the angle of walls after a quarter turn about up, degrees; 0 = none
    askew: float = 0.15  # probability of any other angle
    tilt: float = 3.0  # standard deviation of the tilt of the up axis, degrees
    mirror: float = 0.5  # probability
    scale: float = 0.1  # largest relative change of size
    bend: float = 0.03  # largest standard deviation of smooth shifts, as a share of their wavelength
    jitter: float = 0.1  # standard deviation of the shift of each center, voxels
    drop: float = 0.2  # largest share of Gaussians that is dropped at random
    light: float = 0.2  # largest relative change of brightness
    tint: float = 0.08  # largest relative change of each color channel, and largest shift of black
    noise: float = 0.02  # standard deviation of the noise added to each Gaussian's color; white = 1
    recolor: float = 0.0  # probability that color channels are permuted, inverted or made gray, a third each
    spread: float = 0.15  # standard deviation of the logarithm of a common factor of scales, and of one for each axis
    lift: float = 0.15  # probability that the floor is believed anywhere, up to FAR voxels from where it is
    fade: float = 0.3  # largest share of its opacity that a Gaussian loses


FAR, NEAR_FLOOR = 70.0, 2.0
"""Largest error of a floor that was not found, and the usual one of one that was, in voxels."""


def augment(
    gaussians: Gaussians,
    rng: np.random.Generator,
    config: Augmentation,
    *,
    voxel: float,
) -> Gaussians:
    """Applies random changes to an upright splat with colors of degree 0; row i of the result is Gaussian i. `drop` is
    applied by `make_sample`, since it removes rows; the voxel, in metres, is the unit of `jitter` and `lift`."""
    axis = np.array([0.0, 0.0, 1.0])
    angle = rng.normal(0, config.turn) + (90 * rng.integers(4) if config.turn else 0)
    if rng.random() < config.askew:
        angle += rng.uniform(-45, 45)
    rotation = Rotation.from_rotvec(axis * math.radians(angle))
    horizontal = Rotation.from_rotvec(axis * rng.uniform(0, 2 * math.pi)).apply(perpendicular(axis))
    rotation = Rotation.from_rotvec(horizontal * math.radians(rng.normal(0, config.tilt))) * rotation
    to_from = rotation.as_matrix()
    if rng.random() < config.mirror:
        to_from = to_from @ np.diag([-1.0, 1.0, 1.0])
    # About the middle of the floor below it, so that a tilt does not lift it.
    middle = np.append(gaussians.means[:, :2].mean(axis=0), np.float32(0))
    centered = replace(gaussians, means=gaussians.means - middle)
    turned = turn(centered, to_from, float(rng.uniform(1 - config.scale, 1 + config.scale)))
    shift = middle + rng.uniform(0, voxel, 3) + rng.normal(0, config.jitter * voxel, turned.means.shape)
    if config.lift:
        shift[:, 2] += voxel * (rng.uniform(-FAR, FAR) if rng.random() < config.lift else rng.normal(0, NEAR_FLOOR))
    shift += _smooth_shifts(turned.means, rng, rng.uniform(0, config.bend))
    # Colors are ½ + SH_C0·dc.
    gain = rng.uniform(1 - config.light, 1 + config.light) * rng.uniform(1 - config.tint, 1 + config.tint, 3)
    black_shift = 0.5 * gain - 0.5 + rng.uniform(-config.tint, config.tint)
    noise = rng.normal(0, config.noise, (len(turned.sh), 3))
    relit = _recolored(turned.sh, rng, config.recolor) * gain + ((black_shift + noise) / SH_C0)[:, None]
    factors = rng.normal(rng.normal(0, config.spread), config.spread, turned.scales.shape)
    kept = 1 - rng.uniform(0, config.fade) * rng.random(len(turned.opacities))
    return replace(
        turned,
        means=(turned.means + shift).astype(np.float32),
        sh=relit.astype(np.float32),
        scales=(turned.scales * np.exp(factors)).astype(np.float32),
        opacities=(turned.opacities * kept).astype(np.float32),
    )


WAVES, SHORTEST_WAVE, LONGEST_WAVE = 12, 0.3, 2.0
"""Number of waves that bend a sample, and their shortest and longest length, metres."""


def _smooth_shifts(
    means: Float32[np.ndarray, "N 3"], rng: np.random.Generator, amount: float
) -> Float[np.ndarray, "N 3"]:
    """Shifts by waves in random directions: depth sensors and poses are off by what changes slowly over a surface
    (elastic distortion, Choy et al. 2019). Normals stay, as slopes are small."""
    lengths = SHORTEST_WAVE * (LONGEST_WAVE / SHORTEST_WAVE) ** rng.random(WAVES)
    directions = rng.normal(0, 1, (3, WAVES))
    directions /= np.linalg.norm(directions, axis=0)
    sizes = rng.normal(0, amount * math.sqrt(2 / WAVES), (WAVES, 3)) * lengths[:, None]
    phases = (means @ (2 * math.pi * directions / lengths) + rng.uniform(0, 2 * math.pi, WAVES)).astype(np.float32)
    return np.sin(phases) @ sizes.astype(np.float32)


def _recolored(
    sh: Float32[np.ndarray, "N 1 3"], rng: np.random.Generator, probability: float
) -> Float[np.ndarray, "N 1 3"]:
    """Colors of which things are not known: with other channels, inverted, or gray; and of another saturation."""
    if rng.random() >= probability:
        return sh
    change = rng.integers(3)
    gray = sh.mean(axis=2, keepdims=True)
    if change == 0:
        return np.repeat(gray, 3, axis=2)
    # Colors are ½ + SH_C0·dc, so that the inverted ones have the negative coefficients.
    changed = -sh if change == 1 else sh[:, :, rng.permutation(3)]
    gray = changed.mean(axis=2, keepdims=True)
    return gray + (changed - gray) * rng.uniform(0.3, 1.5)


MIN_REMAINING_WEIGHT = 0.5
"""Smallest share of a row's weight that must remain after Gaussians are dropped at random."""


def restrict_rows(
    view: ViewRows,
    gaussians: int,
    selected: Int64[np.ndarray, " s"],
    remaining: Int64[np.ndarray, " n"],
    config: LossConfig,
) -> ViewRows:
    """Restricts the rows of B of a view to the `selected` Gaussians of a crop, and selects the rows to compare.

    A row is selected if the teacher has a vector there, the full scene covers it with an alpha of `min_alpha` or more,
    and at least the share `min_kept` of its weight is on selected Gaussians. Those of them that were then dropped at
    random are left out of the row, of whose weight at least MIN_REMAINING_WEIGHT must remain; the `remaining` ones
    become columns 0, 1, ….
    """
    column_of = np.full(gaussians, -1, np.int32)
    column_of[selected] = -2
    column_of[remaining] = np.arange(len(remaining), dtype=np.int32)
    column = column_of[view.col]
    alpha = _row_sums(view.weight, view.crow)
    selected_alpha = _row_sums(np.where(column != -1, view.weight, 0), view.crow)
    remaining_alpha = _row_sums(np.where(column >= 0, view.weight, 0), view.crow)
    usable = view.valid & (alpha >= config.min_alpha) & (selected_alpha >= config.min_kept * alpha)
    # Of rows with less than this the weighted mean of the remaining Gaussians would say little.
    usable &= remaining_alpha >= MIN_REMAINING_WEIGHT * alpha
    entries = np.repeat(usable, np.diff(view.crow)) & (column >= 0)
    counts = np.add.reduceat(np.append(entries, False), view.crow[:-1])[usable] if len(entries) else np.zeros(0, int)
    return ViewRows(
        crow=np.concatenate(([0], np.cumsum(counts))).astype(np.int64),
        col=column[entries],
        weight=view.weight[entries],
        targets=view.targets[usable],
        valid=np.ones(int(usable.sum()), bool),
    )


def _row_sums(values: np.ndarray, crow: np.ndarray) -> np.ndarray:
    """Sums of the entries of each compressed row; 0 for empty rows."""
    total = np.add.reduceat(np.append(values, np.float32(0)), crow[:-1])
    return np.where(np.diff(crow) > 0, total, 0)


def sample_rows(
    view: ViewRows,
    seen: Bool[np.ndarray, " N"],
    min_alpha: float,
    count: int = 0,
    rng: np.random.Generator | None = None,
) -> RenderRows:
    """Rows of a view over the Gaussians that were seen, all with the weight 1: those with a vector and an alpha of
    `min_alpha` or more, or `count` of them, drawn at random."""
    weight = np.where(seen[view.col], view.weight, np.float32(0))
    chosen = np.flatnonzero(view.valid & (_row_sums(weight, view.crow) >= min_alpha))
    if rng is not None and 0 < count < len(chosen):
        chosen = np.sort(rng.choice(chosen, count, replace=False))
    counts = np.diff(view.crow)[chosen]
    crow = np.concatenate(([0], np.cumsum(counts))).astype(np.int64)
    entries = np.arange(crow[-1]) + np.repeat(view.crow[:-1][chosen] - crow[:-1], counts)
    return RenderRows(
        crow=torch.from_numpy(crow),
        col=torch.from_numpy(view.col[entries]),
        weight=torch.from_numpy(weight[entries]),
        targets=torch.from_numpy(view.targets[chosen]),
        row_weights=torch.ones(len(chosen)),
    )


def make_render_rows(view: ViewRows, codebook: Float32[np.ndarray, "C channels"], power: float) -> RenderRows:
    """Rows of one view as tensors; the weight of each in the loss is n^−power, where n rows have its target's class."""
    classes = nearest_codes(codebook, view.targets) if power else np.zeros(len(view.targets), np.int64)
    return RenderRows(
        crow=torch.from_numpy(view.crow),
        col=torch.from_numpy(view.col),
        weight=torch.from_numpy(view.weight),
        targets=torch.from_numpy(view.targets),
        row_weights=torch.from_numpy(rarity_weights(classes, power)),
    )


def empty_rows(channels: int) -> RenderRows:
    """A matrix without rows."""
    empty = torch.zeros(0)
    crow, col = torch.zeros(1, dtype=torch.int64), torch.zeros(0, dtype=torch.int32)
    return RenderRows(crow=crow, col=col, weight=empty, targets=empty.view(0, channels), row_weights=empty)


def join_rows(matrices: Sequence[RenderRows], shifts: Sequence[int]) -> RenderRows:
    """Concatenates matrices along their rows; `shifts` are added to the column numbers of each."""
    entries = np.cumsum([0, *(len(matrix.col) for matrix in matrices)]).tolist()
    crows = [matrix.crow[:-1] + entry for matrix, entry in zip(matrices, entries, strict=False)]
    return RenderRows(
        crow=torch.cat([*crows, torch.tensor(entries[-1:])]),
        col=torch.cat([matrix.col + shift for matrix, shift in zip(matrices, shifts, strict=True)]),
        weight=torch.cat([matrix.weight for matrix in matrices]),
        targets=torch.cat([matrix.targets for matrix in matrices]),
        row_weights=torch.cat([matrix.row_weights for matrix in matrices]),
    )


def no_targets(gaussians: int, channels: int) -> TeacherTargets:
    """The targets of a teacher that a scene lacks: nothing that has a weight."""
    return TeacherTargets(
        targets=torch.zeros(gaussians, channels, dtype=torch.float16),
        codes=torch.full((gaussians,), -1),
        loss_weights=torch.zeros(gaussians),
        rows=empty_rows(channels),
    )


class Sample(NamedTuple):
    """One sample, as a data worker returns it."""

    name: str
    attributes: Float[Tensor, "N A"]
    opacities: Float[Tensor, " N"]
    plan: CloudPlan
    teachers: tuple[TeacherTargets, ...]


def join_samples(samples: Sequence[Sample], patch: int) -> Batch:
    """Joins samples to a batch; `patch` is the largest number of tokens in a patch of the encoder."""
    sizes = [len(sample.plan.token_of) for sample in samples]
    starts = [sum(sizes[:i]) for i in range(len(sizes))]
    return Batch(
        names=tuple(sample.name for sample in samples),
        attributes=torch.cat([sample.attributes for sample in samples]),
        opacities=torch.cat([sample.opacities for sample in samples]),
        plan=join_plans([sample.plan for sample in samples], patch),
        teachers=tuple(
            TeacherTargets(
                targets=torch.cat([each.targets for each in of_teacher]),
                codes=torch.cat([each.codes for each in of_teacher]),
                loss_weights=torch.cat([each.loss_weights for each in of_teacher]),
                rows=join_rows([each.rows for each in of_teacher], starts),
            )
            for of_teacher in zip(*(sample.teachers for sample in samples), strict=True)
        ),
    )


class TrainingScene:
    """What each teacher says of one scene, in the order of the teachers; None for those that the scene lacks. Gaussians
    and cameras are read from the first."""

    def __init__(self, parts: Sequence[ScenePart | None]) -> None:
        present = [part for part in parts if part is not None]
        if not present:
            raise InputError("training: a scene has no teacher")
        self.parts, self.first, self.name = tuple(parts), present[0], present[0].name

    def check_consistent(self) -> None:
        """Checks that all parts were prepared for the same Gaussians and views."""
        first = self.first
        for part in self.parts:
            if part is None or (
                part.view_names == first.view_names
                and len(part) == len(first)
                and np.array_equal(part.means, first.means)
            ):
                continue
            raise InputError(
                f"{part.path}: has other Gaussians or views than {first.path}; remove both to prepare the scene again"
            )

    def close(self) -> None:
        """Closes the files; the next access opens them again."""
        for part in self.parts:
            if part is not None:
                part.close()


MAX_OPEN_FILES = 256
"""Largest number of files of prepared scenes, one for each teacher, that a process keeps open; those of the scene that
was used least recently are closed first."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SampleRecipe:
    """Settings of making samples from scenes. The teachers are in the order of the encoder's output columns; centers of
    crops are drawn by the classes of the first one that a scene has. The `step_samples` samples of one step over all
    processes have crops of one size, so that no process waits for another."""

    encoder: EncoderConfig
    sampling: SamplingConfig
    augmentation: Augmentation | None
    losses: LossConfig
    teachers: tuple[TeacherRecipe, ...]
    seed: int
    step_samples: int = 1

    def uses_classes(self, teacher: TeacherRecipe) -> bool:
        """Whether samples depend on the classes of a teacher's targets: by the centers of crops, by weights of rare
        classes, or by a term that compares classes."""
        by_center = self.sampling.rare_centers > 0 and self.sampling.gaussians > 0
        compared = any(weight > 0 and TERMS[name].classes for name, weight in self.losses.lambdas.items())
        return by_center or (compared and teacher.classes and teacher.weight > 0) or self.losses.rarity != 0


Codes = tuple[Int32[np.ndarray, " N"] | None, ...]
"""For each teacher the class of each Gaussian's target, −1 without a target; None in a scene that lacks the teacher."""


@runtime_checkable
class SceneStream(Protocol):
    """Scenes that are made while a training runs, from which a share of its samples is drawn, by the sample's number;
    see `rooms.RoomStream`."""

    share: float

    def scene(self, number: int) -> tuple[TrainingScene, Codes]: ...


class SampleDataset(Dataset[Sample]):
    """The samples of a run by number; each epoch goes through the scenes in a new random order. With a `stream` a share
    of the samples is of its scenes, and without other scenes all are."""

    def __init__(
        self, scenes: Sequence[TrainingScene], recipe: SampleRecipe, stream: SceneStream | None = None
    ) -> None:
        if not scenes and stream is None:
            raise InputError("training: no scenes to train on")
        self.scenes, self.recipe, self.stream = list(scenes), recipe, stream
        self._codes: OrderedDict[int, Codes] = OrderedDict()

    def __getitem__(self, number: int) -> Sample:
        seed = self.recipe.seed
        rng = np.random.default_rng([seed, 1, number])
        step_rng = np.random.default_rng([seed, 2, number // self.recipe.step_samples])
        size = crop_size(self.recipe.sampling, step_rng)
        stream, drawn = self.stream, number
        if stream is not None:
            if not self.scenes or np.random.default_rng([seed, 3, number]).random() < stream.share:
                made, codes = stream.scene(number)
                with error_prefix(made.name):
                    return make_sample(made, codes, self.recipe, size, rng)
            drawn = int(number * (1 - stream.share))
        epoch, position = divmod(drawn, len(self.scenes))
        order = np.random.default_rng([seed, 0, epoch]).permutation(len(self.scenes))
        scene_index = int(order[position])
        scene = self.scenes[scene_index]
        with error_prefix(f"scene {scene.name}"):
            return make_sample(scene, self._target_codes(scene_index), self.recipe, size, rng)

    def _target_codes(self, scene_index: int) -> Codes:
        """Target classes of a scene's Gaussians for each teacher, cached together with the open scene; their number is
        limited, since each holds a file descriptor."""
        if scene_index not in self._codes:
            self._codes[scene_index] = target_codes(self.scenes[scene_index], self.recipe)
        self._codes.move_to_end(scene_index)
        if len(self._codes) > max(1, MAX_OPEN_FILES // len(self.recipe.teachers)):
            oldest, _ = self._codes.popitem(last=False)
            self.scenes[oldest].close()
        return self._codes[scene_index]


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
        if recipe.uses_classes(teacher):
            result.append(part.codes(teacher.codebook))
        else:
            result.append(np.where(part.weights > 0, np.int32(0), np.int32(-1)))
    return tuple(result)


def make_sample(
    scene: TrainingScene,
    codes: Codes,
    recipe: SampleRecipe,
    size: int,
    rng: np.random.Generator,
) -> Sample:
    """Makes a sample: selects views and Gaussians of a scene, augments them and computes the encoder's inputs. Its
    `size` is the largest number of Gaussians; 0 = all that the views see."""
    source = scene.first
    first_codes = next(each for each in codes if each is not None)
    center_weights = rarity_weights(first_codes, recipe.sampling.center_power)
    views, selected = choose_crop(source.means, source.cameras, center_weights, recipe.sampling, size, rng)
    augmentation = recipe.augmentation
    remaining = drop_random(selected, augmentation.drop, rng) if augmentation is not None else selected
    voxel = source.voxel or recipe.sampling.draw_voxel(recipe.encoder.voxel, rng)
    gaussians = upright_gaussians(source.gaussians(remaining), source.up, floor_of=source.means)
    gaussians = scaled(gaussians, source.metres_per_unit or 1.0)
    if augmentation is not None:
        gaussians = augment(gaussians, rng, augmentation, voxel=voxel)
    attributes, opacities, plan = encoder_inputs(gaussians, recipe.encoder, voxel)
    compared, shares = np.arange(len(remaining)), np.ones(len(remaining), np.float32)
    if not recipe.losses.render_weight:
        compared, shares = draw_compared(first_codes[remaining], rng)
        plan = plan._replace(token_of=plan.token_of[compared])
    return Sample(
        name=f"{scene.name} ({', '.join(source.view_names[view] for view in views)})",
        attributes=attributes,
        opacities=opacities,
        plan=plan,
        teachers=tuple(
            no_targets(len(compared), teacher.channels)
            if part is None or part_codes is None
            else _targets_of(part, part_codes, teacher, recipe.losses, views, selected, remaining, compared, shares)
            for part, part_codes, teacher in zip(scene.parts, codes, recipe.teachers, strict=True)
        ),
    )


MAX_COMPARED = 1024
"""Largest number of Gaussians of a sample that enter the loss on Gaussians where no view is rendered: those of one
class and one crop say much the same, and to decode and compare all of them would take a third of a step."""


def draw_compared(
    codes: Int32[np.ndarray, " N"], rng: np.random.Generator
) -> tuple[Int64[np.ndarray, " m"], Float32[np.ndarray, " m"]]:
    """Draws at most MAX_COMPARED Gaussians, of each class the same number where there are enough, and the number that
    each of them stands for, so that no class gains or loses weight."""
    _, classes, counts = np.unique(codes, return_inverse=True, return_counts=True)
    drawn, ascending = np.zeros(len(counts), np.int64), np.argsort(counts, kind="stable")
    left = MAX_COMPARED
    for position, number in enumerate(ascending):
        drawn[number] = min(counts[number], max(1, left // (len(counts) - position)))
        left -= drawn[number]
    shuffled = rng.permutation(len(codes))
    by_class = shuffled[np.argsort(classes[shuffled], kind="stable")]
    rank = np.arange(len(codes)) - np.repeat(np.cumsum(counts) - counts, counts)
    compared = np.sort(by_class[rank < np.repeat(drawn, counts)])
    return compared, (counts / drawn)[classes[compared]].astype(np.float32)


def rarity_weights(codes: Integer[np.ndarray, " N"], power: float) -> Float32[np.ndarray, " N"]:
    """The weight n^−power of each target, where its class has n of these targets, scaled to a mean of 1; 0 for those
    without a class (−1)."""
    present = codes >= 0
    weights = np.zeros(len(codes), np.float32)
    values = (np.maximum(np.bincount(codes[present]), 1).astype(np.float64) ** -power)[codes[present]]
    weights[present] = values / values.mean() if len(values) else 1
    return weights


def _targets_of(
    scene: ScenePart,
    codes: Int32[np.ndarray, " N"],
    teacher: TeacherRecipe,
    losses: LossConfig,
    views: Sequence[int],
    selected: Int64[np.ndarray, " s"],
    remaining: Int64[np.ndarray, " n"],
    compared: Int64[np.ndarray, " m"],
    shares: Float32[np.ndarray, " m"],
) -> TeacherTargets:
    """The targets of one teacher for those of the remaining Gaussians that enter the loss on Gaussians, and its rows in
    the views."""
    rows = [empty_rows(teacher.channels)]
    for view in views if losses.render_weight and teacher.weight else ():
        view_rows = restrict_rows(scene.view(view), len(scene), selected, remaining, losses)
        rows.append(make_render_rows(view_rows, teacher.codebook, losses.rarity))
    weights = rarity_weights(codes[remaining], losses.rarity)[compared] * shares
    return TeacherTargets(
        targets=torch.from_numpy(scene.float16_targets(remaining[compared])),
        codes=torch.from_numpy(codes[remaining[compared]].astype(np.int64)),
        loss_weights=torch.from_numpy(weights),
        rows=join_rows(rows, [0] * len(rows)),
    )
