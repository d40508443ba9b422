"""Gaussian memory attention in torch, for training and rendering (M3 Eq. 2), and what M3 compares it with: features of
as few channels and a decoder, linear as in Feature-3DGS (Zhou et al. 2024) or a perceptron as in Feature-Splatting (Qiu
et al. 2024)."""

import json
import logging
import math
import warnings
from dataclasses import asdict
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor, nn
from torch.nn.functional import scaled_dot_product_attention
from torch.utils.checkpoint import checkpoint

from gsencoder.core.errors import InputError
from gsencoder.render import Blend
from gsencoder.types import MemoryBank, QueryMemory
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
        """Centered cosines are about the mean of the space; that of the bank is zero where it was made without. Values
        are what is averaged, such as the components in a basis; None = the components."""
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


def render_queries(memory: QueryMemory, b: Blend) -> tuple[Float32[np.ndarray, "P s"], Float32[np.ndarray, " P"]]:
    """The queries of the rows of B, and the share of each row that is hit with a query; Gaussians without one take no
    part in the mean. Where that share is 0 a query is zero and means nothing."""
    if b.gaussians != len(memory):
        raise InputError(f"memory: queries of {len(memory):,} Gaussians, and a view of {b.gaussians:,}")
    seen = torch.from_numpy((memory.weights > 0).astype(np.float32))
    queries, alpha = b.render(torch.from_numpy(memory.queries)), b.render(seen)
    return (queries / alpha.clamp(min=1e-12)[:, None]).numpy(), alpha.numpy()


Decoder = Literal["linear", "mlp"]


def make_decoder(
    kind: Decoder, projection: Float[Tensor, "s C"], *, hidden: int = 64, generator: torch.Generator | None = None
) -> nn.Module:
    """A decoder from s channels to C: linear, which begins with a projection, or a perceptron of one hidden layer."""
    channels, width = projection.shape
    if kind == "linear":
        linear = nn.Linear(channels, width)
        with torch.no_grad():
            linear.weight.copy_(projection.T)
            linear.bias.zero_()
        return linear
    layers = nn.Sequential(nn.Linear(channels, hidden), nn.ReLU(), nn.Linear(hidden, width))
    with torch.no_grad():
        for layer in (layers[0], layers[2]):
            assert isinstance(layer, nn.Linear)
            bound = layer.in_features**-0.5
            for parameter in (layer.weight, layer.bias):
                parameter.uniform_(-bound, bound, generator=generator)
    return layers


INPUT, OUTPUT = "queries", "features"
OPSET = 20
TOLERANCE = 1e-4
"""Largest difference from numpy, as a share of the largest feature."""


class _Attention(nn.Module):
    """The attention of one block of queries; the keys are folded with the projection."""

    def __init__(self, memory: QueryMemory) -> None:
        super().__init__()
        projection = torch.from_numpy(memory.projection)
        attention = MemoryAttention(
            memory.bank, projection, mean=memory.mean, scoring=memory.scoring, temperature=memory.temperature
        )
        self.cosines = memory.scoring != "dot"
        self.register_buffer("keys", (projection @ attention.keys.T) / memory.temperature)
        self.register_buffer("gram", projection @ projection.T)
        self.register_buffer("values", attention.values)
        self.keys: Tensor
        self.gram: Tensor
        self.values: Tensor

    def forward(self, queries: Float[Tensor, "n s"]) -> Float[Tensor, "n D"]:
        if self.cosines:
            queries = unit_queries(queries, self.gram)
        return torch.softmax(queries @ self.keys, dim=1) @ self.values


def export_memory(memory: QueryMemory) -> bytes:
    """A graph with the input `queries` f32[n, s] and the output `features` f32[n, D], compared with numpy.

    A runtime holds the scores of all queries that it is given at once, n × M numbers, so that large pictures go in
    blocks. The metadata entry `gsencoder` is a JSON object with the feature space and the figures of the bank."""
    try:
        import onnx  # noqa: F401
        import onnxscript  # noqa: F401
    except ImportError as error:
        raise InputError(f"export needs the package {error.name}: pip install 'gsencoder[export]'") from error
    example = torch.from_numpy(memory.queries[:2] if len(memory) > 1 else np.ones((2, memory.channels), np.float32))
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program = torch.export.export(
            _Attention(memory).eval(), (example,), dynamic_shapes=({0: torch.export.Dim("n", min=1)},)
        )
        exported = torch.onnx.export(
            program, dynamo=True, opset_version=OPSET, input_names=[INPUT], output_names=[OUTPUT], verbose=False
        )
    assert exported is not None
    model = exported.model_proto
    about = {"version": 1, "kind": "memory", "space": asdict(memory.space), "channels": memory.channels}
    about |= {name: getattr(memory.bank, name) for name in ("threshold", "coverage", "cosine")}
    model.metadata_props.add(key="gsencoder", value=json.dumps(about))
    graph: bytes = model.SerializeToString()
    difference = _difference(graph, memory)
    if not difference <= TOLERANCE:
        raise InputError(f"export: the graph differs from numpy by {difference:.2g} of the largest feature")
    return graph


def _difference(graph: bytes, memory: QueryMemory) -> float:
    """The largest difference of features, of Gaussians and of random queries of any length, from those of numpy."""
    from onnxruntime import InferenceSession

    session = InferenceSession(graph, providers=["CPUExecutionProvider"])
    seen = memory.queries[memory.weights > 0][:1000]
    rng = np.random.default_rng(0)
    lengths = np.float32(10) ** rng.uniform(-3, 3, (100, 1)).astype(np.float32)
    drawn = rng.standard_normal((100, memory.channels), np.float32) * (lengths if memory.scoring != "dot" else 1)
    largest = 0.0
    for queries in (seen, drawn, drawn[:1]):
        if len(queries):
            (features,) = session.run([OUTPUT], {INPUT: queries})
            largest = max(largest, float(np.abs(features - memory.attend(queries)).max()))
    return largest / float(np.abs(memory.bank.components).max())
