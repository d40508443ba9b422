"""The network of a scene's memory, its samples and its loss: principal queries of Gaussians, rendered through B, attend
to banks (M3 sec. 3.3).

    R̂ = A_gm(B q / alpha),   L = λ_cos · (1 − cos(R̂, R)) + λ_L2 · |R̂ − R|² / C

over rows of B that are drawn at random in each view, and Gaussians, which are rows with one entry, with a weight of
their own; in standard units about the mean of the space. With the geometry
frozen this is a regression on sparse rows, without a rasterizer.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.utils.data import Dataset

from gsencoder.core.errors import InputError
from gsencoder.train.memory_scene import MemoryScene
from gsencoder.train.prepared_scene import PreparedScene
from gsencoder.train.render_rows import RenderRows, gaussian_rows, join_rows, sample_rows
from gsencoder.types.features import Scoring

EPS = 1e-12
MAX_CHANNELS = 1024
"""Channels of a query, at most; 16 to 64 are enough for most teachers."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MemoryConfig:
    """Queries, attention and loss of a memory."""

    channels: int = field(default=16, metadata={"help": "channels s of a Gaussian's query for each teacher"})
    init: Literal["fused", "random"] = field(
        default="fused",
        metadata={
            "help": "first queries: the principal coordinates of the fused features, with which Gaussians themselves "
            "keep features; random = as the paper, where only rendered queries do"
        },
    )
    scoring: Scoring = field(
        default="centered",
        metadata={
            "help": "queries and components are compared by the cosine about the mean; cosine = as they are, as M3's "
            "code does; dot = by products, as its equation"
        },
    )
    temperature: float = field(default=0.05, metadata={"help": "temperature of the attention's softmax"})
    points: int = field(default=2000, metadata={"help": "rows of B that are drawn in each view of a step"})
    gaussian_weight: float = field(
        default=0.3,
        metadata={
            "help": "weight of Gaussians that are compared with their fused features, half as many as points; without "
            "them rendered features come nearer to the teacher's, and those of the Gaussians go their own way; 0 = off"
        },
    )
    min_alpha: float = field(default=0.5, metadata={"help": "smallest opacity of a row"})
    cosine: float = field(default=1.0, metadata={"help": "weight of 1 − cosine"})
    l2: float = field(default=1.0, metadata={"help": "weight of the squared distance in standard units"})

    def __post_init__(self) -> None:
        if not 1 <= self.channels <= MAX_CHANNELS:
            raise InputError(f"channels: expected 1 to {MAX_CHANNELS:,}, got {self.channels:,}")
        if self.points < 1:
            raise InputError(f"points: expected 1 or more, got {self.points}")
        if not 0 < self.temperature < math.inf:
            raise InputError(f"temperature: expected a positive number, got {self.temperature}")
        if not 0 < self.min_alpha <= 1:
            raise InputError(f"min_alpha: expected a number in (0, 1], got {self.min_alpha}")
        for name in ("cosine", "l2", "gaussian_weight"):
            if not 0 <= getattr(self, name) < math.inf:
                raise InputError(f"{name}: expected 0 or more, got {getattr(self, name)}")
        if not self.cosine + self.l2 > 0:
            raise InputError("cosine, l2: expected one above 0; there would be no loss")


class MemoryBatch(NamedTuple):
    """Rows of one or more views, for each teacher."""

    names: tuple[str, ...]
    rows: tuple[RenderRows, ...]

    def to(self, device: torch.device) -> "MemoryBatch":
        """The batch with its tensors on a device."""
        rows = tuple(RenderRows(*(part.to(device, non_blocking=True) for part in each)) for each in self.rows)
        return MemoryBatch(names=self.names, rows=rows)


class ViewSamples(Dataset[MemoryBatch]):
    """Rows of the views of a scene by number of the sample; each epoch goes through the views in a new order."""

    def __init__(self, scenes: Mapping[str, MemoryScene], config: MemoryConfig, seed: int) -> None:
        self._scenes = {name: scene.prepared for name, scene in scenes.items()}
        self._config, self._seed = config, seed
        self._views = next(iter(self._scenes.values())).view_names

    def __getitem__(self, number: int) -> MemoryBatch | InputError:  # type: ignore[override]
        """Sample `number`, or its error as a value."""
        epoch, position = divmod(number, len(self._views))
        view = int(np.random.default_rng([self._seed, 0, epoch]).permutation(len(self._views))[position])
        try:
            rows = tuple(self._rows(scene, view, number) for scene in self._scenes.values())
        except InputError as error:
            return error
        return MemoryBatch(names=(self._views[view],), rows=rows)

    def _rows(self, scene: PreparedScene, view: int, number: int) -> RenderRows:
        config, rng = self._config, np.random.default_rng([self._seed, 1, number])
        seen = scene.weights > 0
        rows = sample_rows(scene.view(view), seen, config.min_alpha, config.points, rng)
        if not config.gaussian_weight:
            return rows
        # A Gaussian is a row of B with one entry.
        of_seen = np.flatnonzero(seen)
        chosen = np.sort(rng.choice(of_seen, min(len(of_seen), -(-config.points // 2)), replace=False))
        return join_rows([rows, gaussian_rows(chosen, scene.targets(chosen), config.gaussian_weight)], [0, 0])


def join_views(samples: Sequence[MemoryBatch | InputError]) -> MemoryBatch | InputError:
    """Joins samples to a batch; if one of them is an error, returns the first error instead."""
    batches = []
    for sample in samples:
        if isinstance(sample, InputError):
            return sample
        batches.append(sample)
    shifts = [0] * len(batches)
    rows = tuple(join_rows(of_teacher, shifts) for of_teacher in zip(*(each.rows for each in batches), strict=True))
    return MemoryBatch(names=tuple(name for each in batches for name in each.names), rows=rows)


class MemoryNetwork(nn.Module):
    """Queries of Gaussians for each teacher, and what turns rendered queries into its features."""

    def __init__(self, queries: Mapping[str, Float[Tensor, "N s"]], decoders: Mapping[str, nn.Module]) -> None:
        super().__init__()
        # Names of modules may hold no dots and are not those of attributes; numbers stand for teachers.
        self.queries = nn.ParameterList([nn.Parameter(each) for each in queries.values()])
        self.decoders = nn.ModuleList(decoders.values())

    def forward(self, rows: tuple[RenderRows, ...]) -> tuple[Float[Tensor, "_ _"], ...]:
        """The features of rows of B for each teacher, in standard units."""
        features = []
        for queries, decoder, each in zip(self.queries, self.decoders, rows, strict=True):
            b = each.blend(len(queries))
            features.append(decoder(b.render(queries) / b.alpha.clamp(min=EPS)[:, None]))
        return tuple(features)


class MemoryObjective:
    """The loss of a memory: for each teacher and row w · (λ_cos · (1 − cos) + λ_L2 · |R̂ − R|² / C)."""

    def __init__(self, network: nn.Module, config: MemoryConfig, teachers: Sequence[str]) -> None:
        self.network, self._config, self._teachers = network, config, tuple(teachers)

    @property
    def advice(self) -> str:
        """Settings that leave nothing to compare."""
        return "memory.min_alpha"

    @property
    def lambdas(self) -> dict[str, float]:
        """The weights of the terms that are not 0, by name."""
        weights = {"cosine": self._config.cosine, "l2": self._config.l2}
        return {self._term(name, term): value for name in self._teachers for term, value in weights.items() if value}

    def _term(self, teacher: str, term: str) -> str:
        return term if len(self._teachers) == 1 else f"{teacher}/{term}"

    def divisors(self, batch: MemoryBatch) -> dict[str, float]:
        """The sum of the weights of the rows, for each term."""
        sums = {
            name: float(rows.row_weights.double().sum()) for name, rows in zip(self._teachers, batch.rows, strict=True)
        }
        return {self._term(name, term): total for name, total in sums.items() for term in ("cosine", "l2")}

    def __call__(self, batch: MemoryBatch) -> dict[str, Tensor]:
        """Totals of the terms whose weight is not 0."""
        terms = {}
        for name, predicted, rows in zip(self._teachers, self.network(batch.rows), batch.rows, strict=True):
            predicted, target = predicted.float(), rows.targets
            products = (predicted * target).sum(dim=1)
            lengths = torch.sqrt(((predicted * predicted).sum(dim=1) + EPS) * ((target * target).sum(dim=1) + EPS))
            terms[self._term(name, "cosine")] = ((1 - products / lengths) * rows.row_weights).sum()
            terms[self._term(name, "l2")] = ((predicted - target).square().mean(dim=1) * rows.row_weights).sum()
        return {name: terms[name] for name in self.lambdas}
