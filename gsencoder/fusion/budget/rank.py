"""What a rank leaves out of the features of the sample, and which rank fits into a file."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float64

from gsencoder.fusion.basis import Moments
from gsencoder.fusion.budget.model import SampleFeatures
from gsencoder.fusion.fuse import FuseConfig
from gsencoder.teachers.base import Teacher

RANKS = (8, 16, 32, 64, 128)
"""Ranks worth trying; 0 stands for all channels."""
HEADER_BYTES = 4096
"""Of a file of features: names, the space, padding, and the settings."""
ROW_BYTES, COORDINATE_BYTES = 8, 2
"""A stored row has its number and weight, and each coordinate is a float16."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RankErrors:
    """Ranks and the error that each adds.

    Attributes:
        full: largest rank that says anything.
        cumulative: shares of the energy of the teacher's vectors that the first 1, 2, … components keep.
        left_out: error of the sample's features with the first 1, 2, … components.
        choices: ranks that are worth trying; 0 = all.
        fitted: whether the fusion goes over the maps once more to fit a basis.
    """

    full: int = 1
    cumulative: Float64[np.ndarray, " R"] = field(default_factory=lambda: np.ones(1))
    left_out: Float64[np.ndarray, " R"] = field(default_factory=lambda: np.zeros(1))
    choices: tuple[int, ...] = (0,)
    fitted: bool = False

    def error_of(self, rank: int) -> float:
        """The error that a rank adds; 0 = all."""
        return 0.0 if rank == 0 or rank >= self.full else float(self.left_out[rank - 1])

    @property
    def errors(self) -> Mapping[int, float]:
        return {rank: self.error_of(rank) for rank in self.choices}


def rank_errors(
    teacher: Teacher,
    moments: Moments,
    features: SampleFeatures,
    mean: Float64[np.ndarray, " D"],
    config: FuseConfig,
    *,
    needed: bool,
) -> RankErrors:
    """Ranks of a teacher's vectors, with what each leaves out.

    Args:
        teacher: whose table, if it has one, is all that its vectors can be.
        moments: of the vectors of its maps, for teachers without a table.
        features: of the sample.
        mean: of the teacher's vectors.
        config: of the fusion.
        needed: whether a rank is wanted even where the fusion would keep all channels.
    """
    channels = teacher.space.channels
    fitted = teacher.table is None and config.basis and channels > config.narrow
    if not fitted and not needed:
        return RankErrors(full=channels)
    if teacher.table is not None:
        _, lengths, components = np.linalg.svd(teacher.table - mean, full_matrices=False)
        energies = lengths**2
    else:
        values, vectors = np.linalg.eigh(moments.covariance())
        energies, components = np.maximum(values[::-1], 0), vectors[:, ::-1].T
    full = max(int((energies > energies.max(initial=0) * 1e-7).sum()), 1)
    fused, seen = features.fused()
    centered = fused[seen] - mean
    energy = np.square(centered @ components[:full].T).cumsum(axis=1)
    total = np.square(centered).sum(axis=1, keepdims=True)
    shares = np.sqrt(np.minimum(energy / np.maximum(total, 1e-30), 1)) if seen.any() else np.ones((1, full))
    choices = (*(rank for rank in RANKS if rank < full), 0) if fitted else (0,)
    return RankErrors(
        full=full,
        cumulative=energies[:full].cumsum() / max(energies.sum(), 1e-30),
        left_out=1 - shares.mean(axis=0),
        choices=choices,
        fitted=fitted,
    )


def with_rank(config: FuseConfig, rank: int, ranks: RankErrors, teacher: Teacher) -> FuseConfig:
    """The fusion with so many components; 0 = all of them."""
    if teacher.table is not None:
        # The basis of a table has the components that keep a share of its energy.
        energy = 1.0 if rank == 0 else float(ranks.cumulative[rank - 1])
        return replace(config, table_energy=min(energy, 1.0), narrow=config.narrow if rank == 0 else 0)
    if rank == 0:
        return replace(config, energy=1.0, max_rank=0)
    return replace(config, energy=1.0, max_rank=rank, narrow=0)


def file_bytes(rows: int, rank: int, channels: int, *, basis: bool) -> int:
    """Bytes of a file of features of so many seen Gaussians."""
    shared = 4 * rank + 4 * channels + (4 * rank * channels if basis else 0)
    return HEADER_BYTES + rows * (ROW_BYTES + COORDINATE_BYTES * rank) + shared


def rank_of_bytes(size: float, rows: int, channels: int) -> int:
    """The largest rank whose file has at most so many bytes; 0 where there is none."""
    fixed, with_one = file_bytes(rows, 0, channels, basis=True), file_bytes(rows, 1, channels, basis=True)
    return max(int((size - fixed) // (with_one - fixed)), 0)
