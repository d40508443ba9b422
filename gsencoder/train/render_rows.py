"""Rows of the blending matrix for the render loss, restricted to a sample's Gaussians, with the teacher's vectors."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int32, Int64
from torch import Tensor

from gsencoder.render import Blend, BlendConfig
from gsencoder.render.rays import Lattice
from gsencoder.train.class_balance import ClassBalance
from gsencoder.train.losses import LossConfig
from gsencoder.train.prepared_file import ViewRows

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
        gaussians: number of Gaussians of the scene.
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
