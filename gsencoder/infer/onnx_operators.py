"""Operators that the exporter does not know, in others of ONNX."""

from typing import Any

import torch
from onnxscript import FLOAT, INT32, INT64, graph, script
from onnxscript import opset18 as op

import gsencoder.models.neighbors  # noqa: F401  the operator of the convolution

ROWS_AT_ONCE = 1024
"""Rows that are convolved together."""


@script(default_opset=op)
def search(keys: INT64, wanted: INT64, more: INT64) -> INT64:
    """How many of the sorted keys are below wanted + more, by halving steps from the first power of two above their
    number (or the second, where the logarithm is near a whole number)."""
    size = op.Size(keys)
    halvings = op.Cast(op.Floor(op.Log(op.Cast(size, to=1)) * 1.4426950408889634 + 1e-3), to=7) + 1
    one = op.Constant(value_int=1)
    step = op.Cast(op.BitShift(op.Cast(one, to=13), op.Cast(halvings, to=13), direction="LEFT"), to=7)
    largest = op.Constant(value_int=9223372036854775807)
    missing = op.Expand(largest, op.Reshape(step - size, op.Constant(value_ints=[1])))
    # Place k holds key k − 1, so that a count is the place of the last key that it counts.
    placed = op.Concat(op.Expand(largest, op.Constant(value_ints=[1])), keys, missing, axis=0)
    target = wanted + more
    found = wanted - wanted
    for _ in range(halvings):
        step = step / 2
        tried = found + step
        found = op.Where(op.Less(op.Gather(placed, tried, axis=0), target), tried, found)
    return found


@script(default_opset=op)
def convolve(x: FLOAT, neighbors: INT32, weight: FLOAT) -> FLOAT:
    """As `models.neighbors.NeighborConv`, some rows at a time, so that what they take stays in the cache."""
    first, second = op.Constant(value_ints=[0]), op.Constant(value_ints=[1])
    rows = op.Gather(op.Shape(neighbors), first)
    blocks = (rows + (ROWS_AT_ONCE - 1)) / ROWS_AT_ONCE
    size = (rows + blocks - 1) / blocks
    # Rows that fill up the last block have no neighbours: they read the row of zeros, as missing cells do.
    missing = op.Concat(blocks * size - rows, op.Constant(value_ints=[27]), axis=0)
    table = op.Concat(neighbors, op.Expand(op.CastLike(rows, neighbors), missing), axis=0)
    table = op.Reshape(table, op.Concat(blocks, size, op.Constant(value_ints=[27]), axis=0))
    zeros = op.Expand(op.CastLike(0.0, x), op.Concat(second, op.Gather(op.Shape(x), second), axis=0))
    padded = op.Concat(x, zeros, axis=0)
    wide = op.Reshape(weight, op.Concat(op.Constant(value_ints=[-1]), op.Gather(op.Shape(weight), second + 1), axis=0))

    @graph()
    def block(part: INT32[...]) -> FLOAT[...]:
        near = op.Reshape(op.Gather(padded, part), op.Concat(size, op.Constant(value_ints=[-1]), axis=0))
        return op.MatMul(near, wide)

    found = op.Scan(table, body=block, num_scan_inputs=1)
    flat = op.Reshape(found, op.Concat(op.Constant(value_ints=[-1]), op.Gather(op.Shape(weight), second + 1), axis=0))
    return op.Slice(flat, first, rows, first)


def _searchsorted(keys: Any, wanted: Any, right: bool = False, **others: Any) -> Any:
    assert not any(others.values()), f"searchsorted is translated without {others}"
    return search(keys, wanted, op.Constant(value_int=int(right)))


def _sort(values: Any, *, dim: int = -1, descending: bool = False, **others: Any) -> Any:
    """Ascending; among equals TopK gives the earlier first, as a stable sort does."""
    assert dim == -1
    assert not descending
    assert set(others) <= {"stable"}
    return op.TopK(values, op.Reshape(op.Size(values), op.Constant(value_ints=[1])), largest=0, sorted=1)


TRANSLATIONS: dict[Any, Any] = {
    torch.ops.gsencoder.convolve.default: convolve,
    torch.ops.aten.searchsorted.Tensor: _searchsorted,
    torch.ops.aten.sort.stable: _sort,
}
