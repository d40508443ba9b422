"""Export of a memory's attention to ONNX: from queries, of Gaussians or rendered, to features."""

import json
import logging
import warnings
from dataclasses import asdict

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from gsencoder.core.errors import InputError
from gsencoder.memory.attention import MemoryAttention, unit_queries
from gsencoder.types import QueryMemory

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
    blocks. The metadata entry `gsencoder` is a JSON object with the feature space and the figures of the bank.

    Raises:
        InputError: onnx or onnxscript is missing, or the graph and numpy differ.
    """
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
