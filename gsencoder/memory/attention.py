"""Gaussian memory attention in torch, for training and rendering (M3 Eq. 2)."""

import math

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor, nn
from torch.nn.functional import scaled_dot_product_attention
from torch.utils.checkpoint import checkpoint

from gsencoder.types import MemoryBank
from gsencoder.types.features import EPS, Scoring, attention_keys

BLOCK_SCORES = 1 << 24
"""Scores of queries and components that are held at once; 64 MiB."""


class MemoryAttention(nn.Module):
    """Features for principal queries: R̂ = softmax(score(Q_p W_m, PSC) / τ) PSC.

    The projection is applied to the components, not to the queries: (q W)·k = q·(W k), and |q W|² = q (W Wᵀ) qᵀ, so
    that scores cost s products a pair instead of D. Queries go in blocks, with gradients as well, so that no more than
    `BLOCK_SCORES` scores are held at once, however many components there are.
    """

    def __init__(
        self,
        bank: MemoryBank,
        projection: Float[Tensor, "s D"],
        *,
        mean: Float32[np.ndarray, " D"],
        scoring: Scoring,
        temperature: float,
        values: Float[Tensor, "M C"] | None = None,
    ) -> None:
        """Args:
        bank: the components.
        projection: initial W_m.
        mean: of the space, about which centered cosines are; that of the bank is zero where it was made without.
        scoring: how queries are compared with components.
        temperature: τ.
        values: what is averaged, such as the components in a basis; None = the components.
        """
        super().__init__()
        self.scoring, self.temperature = scoring, temperature
        self.projection = nn.Parameter(projection)
        keys = attention_keys(bank.components, mean, scoring)
        self.register_buffer("keys", torch.from_numpy(keys), persistent=False)
        values = torch.from_numpy(bank.components) if values is None else values
        self.register_buffer("values", values, persistent=False)
        self.keys: Tensor
        self.values: Tensor

    def forward(self, queries: Float[Tensor, "n s"]) -> Float[Tensor, "n C"]:
        """The features that queries stand for; with cosines their length does not matter."""
        step = max(1, BLOCK_SCORES // len(self.values))
        if len(queries) <= step:
            return self._attend(queries)
        if not torch.is_grad_enabled():
            return torch.cat([self._attend(part) for part in queries.split(step)])
        # Scores of a block are computed again for its gradient, instead of those of all blocks being kept.
        return torch.cat([checkpoint(self._attend, part, use_reentrant=False) for part in queries.split(step)])

    def _attend(self, queries: Float[Tensor, "n s"]) -> Float[Tensor, "n C"]:
        keys = self.keys @ self.projection.T
        if self.scoring != "dot":
            queries = unit_queries(queries, self.projection @ self.projection.T)
        scaled = (queries / self.temperature)[None]
        return scaled_dot_product_attention(scaled, keys[None], self.values[None], scale=1.0)[0]


def unit_queries(queries: Float[Tensor, "n s"], gram: Float[Tensor, "s s"]) -> Float[Tensor, "n s"]:
    """Queries q divided by |q W|, or by `EPS` where it is smaller, with gram = W Wᵀ.

    The largest entry is taken out of the root, so that squares neither overflow nor vanish, and a gradient exists for a
    query of zeros.
    """
    largest = queries.detach().abs().amax(dim=1, keepdim=True).clamp(min=EPS)
    unit = queries / largest
    squares = ((unit @ gram) * unit).sum(dim=1, keepdim=True)
    return unit / squares.clamp(min=EPS**2).sqrt()


def random_projection(query_channels: int, channels: int, generator: torch.Generator) -> Float[Tensor, "s D"]:
    """A random W_m of queries with s channels and components with D, with rows of length 1 on average."""
    return torch.randn(query_channels, channels, generator=generator) / math.sqrt(channels)
