"""Samples and batches of the training of an encoder: its inputs, and the targets of each teacher."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float16, Float32, Int32, Int64
from torch import Tensor

from gsencoder.core.errors import InputError
from gsencoder.models.plan import CloudPlan, Plan, join_plans
from gsencoder.render import Blend, BlendConfig
from gsencoder.render.rays import Lattice
from gsencoder.train.losses import LossConfig
from gsencoder.train.prepare import ClassBalance
from gsencoder.train.prepared_file import ViewRows
from gsencoder.types import Cameras

MIN_REMAINING_WEIGHT = 0.5
"""Smallest share of a row's weight that must remain after Gaussians are dropped at random."""


class RenderRows(NamedTuple):
    """Rows of B for the render loss, over the Gaussians of a sample or a batch.

    Attributes:
        crow, col, weight: compressed rows, as in `gsencoder.render.Blend`.
        targets: the teacher's vectors in the cells, standard units.
        row_weights: weight of each row in the loss.
    """

    crow: Int64[Tensor, " P_plus_1"]
    col: Int32[Tensor, " nnz"]
    weight: Float[Tensor, " nnz"]
    targets: Float[Tensor, "P C"]
    row_weights: Float[Tensor, " P"]

    def blend(self, gaussians: int) -> Blend:
        """The rows as a `Blend`. They are not the pixels of an image, so its lattice is a single column."""
        lattice = Lattice(height=len(self.crow) - 1, width=1, side=1, x0=0.5, y0=0.5, dx=1.0, dy=1.0)
        depths = self.weight.new_zeros(gaussians)
        return Blend(self.crow, self.col, self.weight, depths, lattice, BlendConfig())


def restrict_rows(
    view: ViewRows,
    gaussians: int,
    selected: Int64[np.ndarray, " s"],
    remaining: Int64[np.ndarray, " n"],
    config: LossConfig,
) -> ViewRows:
    """Restricts the rows of B of a view to the Gaussians of a sample, and selects the rows to compare.

    A row is selected if the teacher has a vector there, the full scene covers it with an alpha of `min_alpha` or more,
    and at least the share `min_kept` of its weight is on selected Gaussians. Gaussians that were then dropped at random
    are left out of the row, of whose weight at least MIN_REMAINING_WEIGHT must remain.

    Args:
        view: rows over all Gaussians of the scene.
        selected: the Gaussians of the crop.
        remaining: those of them that the sample has after dropping some at random; they become columns 0, 1, ….
        config: the thresholds.
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
    `min_alpha` or more.

    Args:
        view: rows over all Gaussians.
        seen: the Gaussians that take part.
        min_alpha: smallest sum of the weights of a row.
        count: number of rows that are drawn at random; 0 = all of them.
        rng: source of random numbers.
    """
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


def gaussian_rows(rows: Int64[np.ndarray, " n"], targets: Float32[np.ndarray, "n C"], weight: float) -> RenderRows:
    """Gaussians as rows of B with one entry each.

    Args:
        rows: which Gaussians.
        targets: of these, standard units.
        weight: of each in the loss.
    """
    count = len(rows)
    return RenderRows(
        crow=torch.arange(count + 1),
        col=torch.from_numpy(rows.astype(np.int32)),
        weight=torch.ones(count),
        targets=torch.from_numpy(targets),
        row_weights=torch.full((count,), float(weight)),
    )


def make_render_rows(view: ViewRows, class_balance: ClassBalance, power: float) -> RenderRows:
    """Converts rows of one view to tensors; the weight of each in the loss is n^−power of its target's class."""
    return RenderRows(
        crow=torch.from_numpy(view.crow),
        col=torch.from_numpy(view.col),
        weight=torch.from_numpy(view.weight),
        targets=torch.from_numpy(view.targets),
        row_weights=torch.from_numpy(class_balance.target_weights(view.targets, power)),
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


class TeacherTargets(NamedTuple):
    """What one teacher says of the Gaussians and views of a sample or a batch.

    Attributes:
        targets: targets of the Gaussians, standard units; in float16, since samples that are made
            ahead fill shared memory.
        codes: class of each Gaussian's target, a row of the teacher's codebook; −1 without a target.
        loss_weights: weight of each Gaussian in the loss; 0 without a target.
        rows: rows of the render loss.
    """

    targets: Float16[Tensor, "N C"]
    codes: Int64[Tensor, " N"]
    loss_weights: Float[Tensor, " N"]
    rows: RenderRows


def no_targets(gaussians: int, channels: int) -> TeacherTargets:
    """The targets of a teacher that a scene lacks: nothing that has a weight."""
    return TeacherTargets(
        targets=torch.zeros(gaussians, channels, dtype=torch.float16),
        codes=torch.full((gaussians,), -1),
        loss_weights=torch.zeros(gaussians),
        rows=empty_rows(channels),
    )


class Sample(NamedTuple):
    """One sample, as a data worker returns it; attributes as in `Batch`."""

    name: str
    attributes: Float[Tensor, "N A"]
    opacities: Float[Tensor, " N"]
    plan: CloudPlan
    teachers: tuple[TeacherTargets, ...]


class Batch(NamedTuple):
    """A batch of samples, concatenated along Gaussians, tokens and rows.

    Attributes:
        names: scene and views of each sample, for messages.
        attributes, opacities, plan: inputs of the encoder.
        teachers: targets of each teacher, in the order of the recipe; without weights in scenes that lack the teacher.
    """

    names: tuple[str, ...]
    attributes: Float[Tensor, "N A"]
    opacities: Float[Tensor, " N"]
    plan: Plan
    teachers: tuple[TeacherTargets, ...]

    def to(self, device: torch.device) -> "Batch":
        """The batch with all its tensors on a device."""
        if self.attributes.device == device:
            return self

        def move(value: Tensor) -> Tensor:
            return value.to(device, non_blocking=True)

        return Batch(
            names=self.names,
            attributes=move(self.attributes),
            opacities=move(self.opacities),
            plan=self.plan.to(device),
            teachers=tuple(
                TeacherTargets(
                    targets=move(each.targets),
                    codes=move(each.codes),
                    loss_weights=move(each.loss_weights),
                    rows=RenderRows(*map(move, each.rows)),
                )
                for each in self.teachers
            ),
        )


def join_samples(results: Sequence[Sample | InputError], patch: int) -> Batch | InputError:
    """Joins samples to a batch; if one of them is an error, returns the first error instead.

    Args:
        results: one or more samples or errors.
        patch: largest number of tokens in a patch of the encoder.
    """
    samples = []
    for result in results:
        if isinstance(result, InputError):
            return result
        samples.append(result)
    sizes = [len(sample.attributes) for sample in samples]
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


_CANDIDATES_PER_GAUSSIAN = 4
"""Gaussians nearest to the center that are tested against the frusta first, as a multiple of the size of a crop."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SamplingConfig:
    """Selection of the Gaussians and views of a sample (SplatDistill sec. 3.3, "view-dependent selection")."""

    scope: Literal["frusta", "scene"] = field(
        default="frusta",
        metadata={"help": "candidates: Gaussians in the frusta of the target views, or all of the scene"},
    )
    views: int = field(
        default=4, metadata={"help": "number of target views of a sample, in which the render loss is computed"}
    )
    gaussians: int = field(
        default=30_000,
        metadata={"help": "largest number of Gaussians of a sample, nearest to its center first; 0 = all"},
    )
    smallest: int = field(
        default=4_000,
        metadata={"help": "smallest size of a crop; sizes are log-uniform up to `gaussians`; 0 = all of that size"},
    )
    rare_centers: float = field(
        default=0.8,
        metadata={"help": "share of crops whose center is drawn evenly over target classes instead of over Gaussians"},
    )

    def __post_init__(self) -> None:
        if self.views < 1:
            raise InputError(f"views: expected at least 1 target view, got {self.views}")
        if self.gaussians < 0:
            raise InputError(f"gaussians: expected 0 (no limit) or more, got {self.gaussians}")
        if self.smallest < 0:
            raise InputError(f"smallest: expected 0 (crops of one size) or more, got {self.smallest}")
        if not 0 <= self.rare_centers <= 1:
            raise InputError(f"rare_centers: expected a number in [0, 1], got {self.rare_centers}")


def in_frusta(means: Float32[np.ndarray, "N 3"], cameras: Cameras, *, near: float = 0.01) -> Bool[np.ndarray, " N"]:
    """True for Gaussians whose center lies in the image of at least one camera and beyond its near plane.

    Args:
        means: in the cameras' world.
        cameras: all of them count.
        near: smallest depth, world units.
    """
    inside = np.zeros(len(means), bool)
    for view in range(len(cameras)):
        # The rows that are found already need not be looked at again.
        rows = np.flatnonzero(~inside)
        inside[rows] = cameras.in_image(*cameras.project(means[rows], view), view, near=near)
    return inside


def seen_by(point: Float32[np.ndarray, "3"], cameras: Cameras, *, near: float = 0.01) -> Bool[np.ndarray, " V"]:
    """True for cameras in whose image a point lies, beyond the near plane."""
    return cameras.in_image(*cameras.project(point[None]), near=near)[:, 0]


def nearest_rows(
    means: Float32[np.ndarray, "n 3"], center: Float32[np.ndarray, "3"], count: int
) -> Int64[np.ndarray, " m"]:
    """The `count` rows nearest to a point, in ascending order; all rows if there are not more."""
    if len(means) <= count:
        return np.arange(len(means))
    distances = np.square(means - center).sum(axis=1)
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
    """Chooses target views and the Gaussians of a sample.

    Without a limit of size the views are drawn first and all Gaussians in their frusta are taken, as in the paper. With
    a limit the center of the crop is drawn first, and the views are drawn from those that see it: other views would
    show nothing of the sample.

    Args:
        means: centers of all Gaussians of the scene.
        center_weights: for each Gaussian, its weight in drawing the center of a crop; 0 for those without a target.
        config: settings of sampling.
        size: largest number of Gaussians (`crop_size`); 0 = no limit.
        rng: source of all random numbers.

    Returns:
        Distinct views, fewer than `config.views` if no more are suitable, and rows in ascending order.
    """
    full_scene = config.scope == "scene"
    if not 0 < size < len(means):
        drawn = rng.permutation(len(cameras))
        views = drawn[: config.views]
        rows = np.arange(len(means)) if full_scene else np.flatnonzero(in_frusta(means, cameras.select(views)))
        for view in drawn[config.views :]:
            if len(rows):
                break
            # A view that sees nothing is replaced by another one.
            views = np.array([view])
            rows = np.flatnonzero(in_frusta(means, cameras.select(views)))
    else:
        center = means[_draw_center(center_weights, config, rng)]
        seeing = np.flatnonzero(seen_by(center, cameras))
        views = rng.permutation(seeing if len(seeing) else len(cameras))[: config.views]
        rows = nearest_rows(means, center, len(means) if full_scene else _CANDIDATES_PER_GAUSSIAN * size)
        if not full_scene:
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
