"""Translations of operators that the exporter does not know into standard ONNX operators.

Convolutions stay operators of our own (`gsencoder::convolve`) until a graph is finished, so that what changes the
graph's precision finds them; `in_standard_operators` then writes them out.
"""

from typing import Any

import numpy as np
import onnx
import onnx_ir.passes.common as passes
import torch
from onnxscript import FLOAT, INT8, INT32, INT64, UINT8, graph, ir, optimizer, script
from onnxscript import opset18 as traced
from onnxscript import opset20 as op
from onnxscript.values import OnnxFunction, Opset

import gsencoder.models.neighbors
import gsencoder.models.raw_encoder  # noqa: F401  these two define the operators that are translated
from gsencoder.models.grid import MAX_LEVELS, hilbert_table, start_orientation

OPSET = 20
ROWS_AT_ONCE = 1024
"""Rows that are convolved together."""

FOLDED = 1 << 17
"""Elements of the largest constant that is worked out: the parts of the weights of attention are below it."""

OURS = Opset("gsencoder", 1)


@script(default_opset=traced)
def search(keys: INT64, wanted: INT64, more: INT64) -> INT64:
    """How many of the sorted keys are below wanted + more, by halving steps from the first power of two above their
    number (or the second, where the logarithm is near a whole number)."""
    size = traced.Size(keys)
    halvings = traced.Cast(traced.Floor(traced.Log(traced.Cast(size, to=1)) * 1.4426950408889634 + 1e-3), to=7) + 1
    one = traced.Constant(value_int=1)
    step = traced.Cast(traced.BitShift(traced.Cast(one, to=13), traced.Cast(halvings, to=13), direction="LEFT"), to=7)
    largest = traced.Constant(value_int=9223372036854775807)
    missing = traced.Expand(largest, traced.Reshape(step - size, traced.Constant(value_ints=[1])))
    # Place k holds key k − 1, so that a count is the place of the last key that it counts.
    placed = traced.Concat(traced.Expand(largest, traced.Constant(value_ints=[1])), keys, missing, axis=0)
    target = wanted + more
    result = wanted - wanted
    for _ in range(halvings):
        step = step / 2
        tried = result + step
        result = traced.Where(traced.Less(traced.Gather(placed, tried, axis=0), target), tried, result)
    return result


@script(OURS, default_opset=op)
def in_blocks(neighbors: INT32) -> INT32:
    """Neighborhoods of n cells in blocks of some rows, [blocks, rows, n], so that what a block takes stays in the
    cache."""
    shape = op.Shape(neighbors)
    rows, cells = op.Gather(shape, op.Constant(value_ints=[0])), op.Gather(shape, op.Constant(value_ints=[1]))
    blocks = (rows + (ROWS_AT_ONCE - 1)) / ROWS_AT_ONCE
    size = (rows + blocks - 1) / blocks
    # Rows that fill up the last block have no neighbors: they read the row of zeros, as missing cells do.
    missing = op.Concat(blocks * size - rows, cells, axis=0)
    filled = op.Concat(neighbors, op.Expand(op.CastLike(rows, neighbors), missing), axis=0)
    return op.Reshape(filled, op.Concat(blocks, size, cells, axis=0))


@script(OURS, default_opset=op)
def out_of_blocks(result: FLOAT, neighbors: INT32) -> FLOAT:
    """The rows of all blocks, [blocks, rows, channels], as many as there are neighborhoods."""
    first, last = op.Constant(value_ints=[0]), op.Constant(value_ints=[2])
    flat = op.Reshape(result, op.Concat(op.Constant(value_ints=[-1]), op.Gather(op.Shape(result), last), axis=0))
    return op.Slice(flat, first, op.Gather(op.Shape(neighbors), first), first)


@script(OURS, default_opset=op)
def with_row(x: FLOAT, value: FLOAT) -> FLOAT:
    """One more row, of one value: what missing cells hold."""
    second = op.Constant(value_ints=[1])
    row = op.Expand(value, op.Concat(second, op.Gather(op.Shape(x), second), axis=0))
    return op.Concat(x, row, axis=0)


@script(OURS, default_opset=op)
def convolve(x: FLOAT, neighbors: INT32, weight: FLOAT) -> FLOAT:
    """As `gsencoder.models.neighbors.NeighborConv`."""
    table = in_blocks(neighbors)
    padded = with_row(x, op.CastLike(0.0, x))
    columns = op.Gather(op.Shape(weight), op.Constant(value_ints=[2]))
    wide = op.Reshape(weight, op.Concat(op.Constant(value_ints=[-1]), columns, axis=0))

    @graph()
    def block(part: INT32[...]) -> FLOAT[...]:
        near = op.Reshape(op.Gather(padded, part), op.Constant(value_ints=[0, -1]))
        return op.MatMul(near, wide)

    result = op.Scan(table, body=block, num_scan_inputs=1)
    return out_of_blocks(result, neighbors)


@script(OURS, default_opset=op)
def convolve_int8(x: UINT8, step: FLOAT, zero: UINT8, neighbors: INT32, weight: INT8, scale: FLOAT) -> FLOAT:
    """The same on integers: x stands for step · (x − zero), and weight [n·C, D] for scale[D] · weight.

    Bytes are gathered, a quarter of what `convolve` moves, and their products are summed in int32."""
    table = in_blocks(neighbors)
    padded = with_row(x, zero)
    unit = step * scale

    @graph()
    def block(part: INT32[...]) -> FLOAT[...]:
        near = op.Reshape(op.Gather(padded, part), op.Constant(value_ints=[0, -1]))
        return op.Cast(op.MatMulInteger(near, weight, zero), to=1) * unit

    result = op.Scan(table, body=block, num_scan_inputs=1)
    return out_of_blocks(result, neighbors)


@script(OURS, default_opset=op)
def linear_int8(x: UINT8, step: FLOAT, zero: UINT8, weight: INT8, scale: FLOAT, bias: FLOAT) -> FLOAT:
    """A linear layer on integers, which stand for what they do in `convolve_int8`; weight [C, D]."""
    return op.Cast(op.MatMulInteger(x, weight, zero), to=1) * (step * scale) + bias


_TABLE = onnx.numpy_helper.from_array(hilbert_table().astype(np.uint64))
_POWERS = onnx.numpy_helper.from_array(64 ** np.arange(1, (MAX_LEVELS + 1) // 2, dtype=np.int64))
_STARTS = onnx.numpy_helper.from_array(
    np.array(
        [start_orientation(min(2 * steps, MAX_LEVELS)) for steps in range(1, (MAX_LEVELS + 1) // 2 + 1)], np.uint64
    )
)


@script(OURS, default_opset=op)
def hilbert(morton: INT64) -> INT64:
    """As `gsencoder.models.grid.hilbert_from_morton`, looking no further than the largest code has digits to
    the base 64."""
    table = op.Constant(value=_TABLE)
    largest = op.ReduceMax(morton, keepdims=0)
    further = op.ReduceSum(op.Cast(op.GreaterOrEqual(largest, op.Constant(value=_POWERS)), to=7), keepdims=0)
    given = op.Cast(morton, to=13)
    six = op.Cast(op.Constant(value_int=6), to=13)
    sixty_three = op.Cast(op.Constant(value_int=63), to=13)
    code = op.BitwiseXor(given, given)
    state = op.BitwiseOr(code, op.Gather(op.Constant(value=_STARTS), further))
    for step in range(further + 1):
        away = op.Cast((further - step) * 6, to=13)
        octants = op.BitwiseAnd(op.BitShift(given, away, direction="RIGHT"), sixty_three)
        key = op.BitwiseOr(op.BitShift(state, six, direction="LEFT"), octants)
        result = op.Gather(table, op.Cast(key, to=7))
        code = op.BitwiseOr(op.BitShift(code, six, direction="LEFT"), op.BitwiseAnd(result, sixty_three))
        state = op.BitShift(result, six, direction="RIGHT")
    return op.Cast(code, to=7)


FUNCTIONS: tuple[OnnxFunction, ...] = (
    in_blocks,
    out_of_blocks,
    with_row,
    convolve,
    convolve_int8,
    linear_int8,
    hilbert,
)

# What the exporter must know of those that it meets.
_T = onnx.defs.OpSchema.FormalParameter
for _name, _inputs, _type in (
    (convolve.name, [_T("x", "T"), _T("neighbors", "tensor(int32)"), _T("weight", "T")], "T"),
    (hilbert.name, [_T("morton", "tensor(int64)")], "tensor(int64)"),
):
    _floats = [("T", ["tensor(float)", "tensor(float16)"], "")] if _type == "T" else []
    onnx.defs.register_schema(
        onnx.defs.OpSchema(
            _name, OURS.domain, OURS.version, inputs=_inputs, outputs=[_T("y", _type)], type_constraints=_floats
        )
    )


def simplified(graph: ir.Model) -> onnx.ModelProto:
    """A graph without what is constant, unused or there twice. It takes seconds, where the exporter's own optimization,
    which also tries hundreds of rules, takes most of a minute and gives no faster a graph."""
    optimizer.fold_constants(graph, input_size_limit=FOLDED, output_size_limit=FOLDED)
    for each in (
        passes.RemoveUnusedNodesPass(),
        passes.LiftConstantsToInitializersPass(lift_all_constants=True, size_limit=0),
        passes.DeduplicateInitializersPass(size_limit=FOLDED),
        passes.CommonSubexpressionEliminationPass(),
        passes.RemoveUnusedNodesPass(),
    ):
        each(graph)
    return ir.serde.serialize_model(graph)


def in_standard_operators(model: onnx.ModelProto) -> onnx.ModelProto:
    """The model with our operators written out, and without where in the source each part came from.

    The types of values stay: they are a hundredth of the file, and onnxruntime takes four times as long to find them.
    """
    standard = onnx.ModelProto()
    standard.CopyFrom(model)
    for function in FUNCTIONS:
        proto = function.to_function_proto()
        # Annotations are types here, and floats may be of either width.
        del proto.value_info[:]
        for body in (each.g for node in proto.node for each in node.attribute if each.name == "body"):
            for value in body.output:
                value.ClearField("type")
        standard.functions.append(proto)
    graph = ir.serde.deserialize_model(standard)
    for each in (
        passes.InlinePass(),
        passes.RemoveUnusedFunctionsPass(),
        passes.RemoveUnusedOpsetsPass(),
        passes.ClearMetadataAndDocStringPass(),
    ):
        each(graph)
    return simplified(graph)


def _convolve(x: Any, neighbors: Any, weight: Any) -> Any:
    return OURS.convolve(x, neighbors, weight)


def _hilbert(morton: Any) -> Any:
    return OURS.hilbert(morton)


def _searchsorted(keys: Any, wanted: Any, right: bool = False, **others: Any) -> Any:
    assert not any(others.values()), f"searchsorted is translated without {others}"
    return search(keys, wanted, traced.Constant(value_int=int(right)))


def _sort(values: Any, *, dim: int = -1, descending: bool = False, **others: Any) -> Any:
    """Ascending; among equals TopK gives the earlier first, as a stable sort does."""
    assert dim == -1
    assert not descending
    assert set(others) <= {"stable"}
    return traced.TopK(
        values, traced.Reshape(traced.Size(values), traced.Constant(value_ints=[1])), largest=0, sorted=1
    )


TRANSLATIONS: dict[Any, Any] = {
    torch.ops.gsencoder.convolve.default: _convolve,
    torch.ops.gsencoder.hilbert.default: _hilbert,
    torch.ops.aten.searchsorted.Tensor: _searchsorted,
    torch.ops.aten.sort.stable: _sort,
}
