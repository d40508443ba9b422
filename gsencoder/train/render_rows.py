"""Rows of B in a sample: cells of the teacher's grid over the Gaussians that the sample holds, and what the teacher saw
there."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int32, Int64
from torch import Tensor

from gsencoder.render import Blend, BlendConfig
from gsencoder.render.rays import Lattice
from gsencoder.train.class_balance import Rarity
from gsencoder.train.losses import LossConfig
from gsencoder.train.prepared_scene import ViewRows

MIN_LEFT = 0.5
"""Share of a row's weight that must be left when Gaussians were thinned out at random."""


class Rows(NamedTuple):
    """Rows of B that are compared with a teacher's cells, over the Gaussians of a sample or a batch.

    Attributes:
        crow, col, weight: compressed rows, as in `gsencoder.render.Blend`.
        targets: the teacher's vectors in the cells, standard units.
        row_weights: of each row in the loss.
    """

    crow: Int64[Tensor, " P_plus_1"]
    col: Int32[Tensor, " nnz"]
    weight: Float[Tensor, " nnz"]
    targets: Float[Tensor, "P C"]
    row_weights: Float[Tensor, " P"]

    def blend(self, gaussians: int) -> Blend:
        """B itself. Its rows belong to no picture, so its lattice is a line of them."""
        lattice = Lattice(height=len(self.crow) - 1, width=1, side=1, x0=0.5, y0=0.5, dx=1.0, dy=1.0)
        depths = self.weight.new_zeros(gaussians)
        return Blend(self.crow, self.col, self.weight, depths, lattice, BlendConfig())


def restrict(
    view: ViewRows,
    gaussians: int,
    selected: Int64[np.ndarray, " s"],
    kept: Int64[np.ndarray, " n"],
    config: LossConfig,
) -> ViewRows:
    """The rows of B that a sample can be held against, over its Gaussians.

    A row stays if the teacher saw something there, the whole scene fills it to `min_alpha`, and the selection has
    `min_kept` of its weight. Of Gaussians that were left out at random afterwards the row is simply without, as long as
    MIN_LEFT of its weight is there.

    Args:
        view: over all Gaussians of the scene.
        gaussians: how many these are.
        selected: the Gaussians that the views were chosen for.
        kept: those of them that the sample has; they become columns 0, 1, ….
        config: see there.
    """
    column = np.full(gaussians, -1, np.int32)
    column[selected] = -2
    column[kept] = np.arange(len(kept), dtype=np.int32)
    place = column[view.col]
    alpha = _row_sums(view.weight, view.crow)
    inside = _row_sums(np.where(place != -1, view.weight, 0), view.crow)
    there = _row_sums(np.where(place >= 0, view.weight, 0), view.crow)
    good = view.valid & (alpha >= config.min_alpha) & (inside >= config.min_kept * alpha)
    # What is left after thinning out must still be more than a trace, or its average means nothing.
    good &= there >= MIN_LEFT * alpha
    entries = np.repeat(good, np.diff(view.crow)) & (place >= 0)
    counts = np.add.reduceat(np.append(entries, False), view.crow[:-1])[good] if len(entries) else np.zeros(0, int)
    return ViewRows(
        crow=np.concatenate(([0], np.cumsum(counts))).astype(np.int64),
        col=place[entries],
        weight=view.weight[entries],
        targets=view.targets[good],
        valid=np.ones(int(good.sum()), bool),
    )


def _row_sums(values: np.ndarray, crow: np.ndarray) -> np.ndarray:
    """Sums of compressed rows; empty rows are 0."""
    total = np.add.reduceat(np.append(values, np.float32(0)), crow[:-1])
    return np.where(np.diff(crow) > 0, total, 0)


def rows_of(view: ViewRows, rarity: Rarity, power: float) -> Rows:
    """Rows of one view as tensors; the weight of each in the loss is that of its target's kind to a power."""
    return Rows(
        crow=torch.from_numpy(view.crow),
        col=torch.from_numpy(view.col),
        weight=torch.from_numpy(view.weight),
        targets=torch.from_numpy(view.targets),
        row_weights=torch.from_numpy(rarity.weights(view.targets, power)),
    )


def no_rows(channels: int) -> Rows:
    """A matrix of no rows."""
    nothing = torch.zeros(0)
    crow, col = torch.zeros(1, dtype=torch.int64), torch.zeros(0, dtype=torch.int32)
    return Rows(crow=crow, col=col, weight=nothing, targets=nothing.view(0, channels), row_weights=nothing)


def join_rows(parts: Sequence[Rows], shifts: Sequence[int]) -> Rows:
    """Rows below one another as one matrix; `shifts` are added to the columns of each."""
    entries = np.cumsum([0, *(len(part.col) for part in parts)]).tolist()
    crows = [part.crow[:-1] + entry for part, entry in zip(parts, entries, strict=False)]
    return Rows(
        crow=torch.cat([*crows, torch.tensor(entries[-1:])]),
        col=torch.cat([part.col + shift for part, shift in zip(parts, shifts, strict=True)]),
        weight=torch.cat([part.weight for part in parts]),
        targets=torch.cat([part.targets for part in parts]),
        row_weights=torch.cat([part.row_weights for part in parts]),
    )
