"""Two operators that the exporter does not know, in others of ONNX."""

from typing import Any

import torch
from onnxscript import INT64, script
from onnxscript import opset18 as op


@script(default_opset=op)
def search(keys: INT64, wanted: INT64, more: INT64) -> INT64:
    """How many of the sorted keys are below wanted + more, by halving steps from the first power of two above N."""
    size = op.Size(keys)
    halvings = op.Cast(op.Floor(op.Log(op.Cast(size, to=1)) * 1.4426950408889634), to=7) + 2
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
    torch.ops.aten.searchsorted.Tensor: _searchsorted,
    torch.ops.aten.sort.stable: _sort,
}
