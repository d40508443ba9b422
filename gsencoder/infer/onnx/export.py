"""Export of an encoder to one ONNX file that takes raw Gaussians, with metadata, in float32 or cheaper precisions.

Convolutions stay operators of our own (`gsencoder::convolve`) until a graph is finished, so that what changes the
graph's precision finds them; `in_standard_operators` then writes them out.

In eight bits a weight matrix is rounded to int8 with a scale for each output channel. In a product of integers the
other factor is rounded to uint8 with one scale and one zero point, which are computed when the graph runs (dynamic
quantization). Sums are int32, and everything between products stays float32.

Processors without VNNI add two products of bytes in 16 bits, which 255 · 127 twice overflows without an error. Weights
of integer products are therefore at most `PRODUCT_LIMIT`.
"""

import logging
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from copy import deepcopy
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float32

from gsencoder.core.arrays import round_columns
from gsencoder.core.errors import InputError
from gsencoder.infer.onnx.runtime import (
    FIELDS,
    NO_SUM,
    OUTPUT,
    SETTINGS,
    SUM,
    EncoderHeader,
    inputs_of,
    to_metadata,
    with_sum,
)
from gsencoder.models.encoder import GaussianEncoder
from gsencoder.models.grid import MAX_LEVELS, hilbert_table, start_orientation
from gsencoder.models.raw_encoder import RawEncoder
from gsencoder.types import Gaussians

try:
    import onnx
    import onnx_ir.passes.common as passes
    from onnx import helper, numpy_helper
    from onnxscript import FLOAT, INT8, INT32, INT64, UINT8, graph, ir, optimizer, script
    from onnxscript import opset18 as traced
    from onnxscript import opset20 as op
    from onnxscript.values import OnnxFunction, Opset
except ImportError as error:
    raise InputError(f"export needs the package {error.name}: pip install 'gsencoder[export]'") from error

KNOWN_TORCH = "2.13"
"""The earliest release whose exporter translates encoders: 2.11 fails on slices whose sizes follow from data."""


def lower(module: GaussianEncoder, header: EncoderHeader, *, half: bool = False) -> Any:
    """A network as an ONNX graph whose convolutions are still operators of ours.

    Args:
        half: compute in float16 once Gaussians have been merged into tokens.
    """
    network = deepcopy(module).half() if half else module
    cloud = random_cloud(300, header.voxel)
    clouds, patches = torch.export.Dim("gaussians"), torch.export.Dim("patches")
    example = [torch.from_numpy(value) for value in inputs_of(cloud).values()]
    voxel, corner, starts = (torch.from_numpy(value) for value in _settings(header).values())
    sizes = (*({0: clouds} for _ in FIELDS), {}, {}, {1: patches})
    with torch.no_grad(), _quiet():
        try:
            program = torch.export.export(
                RawEncoder(network, header.outputs).eval(),
                (*example, voxel, corner, starts.repeat(1, 5)),
                dynamic_shapes=sizes,
            )
            exported = torch.onnx.export(
                program,
                dynamo=True,
                opset_version=OPSET,
                custom_translation_table=TRANSLATIONS,
                input_names=[*FIELDS, *SETTINGS],
                output_names=[OUTPUT],
                optimize=False,
                verbose=False,
            )
        except Exception as error:  # the exporter raises its own classes, and whatever its passes stumble over
            if torch.__version__ >= KNOWN_TORCH:
                raise
            raise InputError(
                f"the exporter of torch {torch.__version__} cannot translate this encoder ({type(error).__name__}); "
                f"export with torch {KNOWN_TORCH} or later, the file runs anywhere"
            ) from error
    assert exported is not None
    return simplified(exported.model)


def export_onnx(header: EncoderHeader, lowered: Any) -> bytes:
    """What the file is to hold: the graph, and what a runtime must know of it.

    Args:
        header: with the precision that the graph is to compute in.
        lowered: what `lower` made of the network, in half precision for float16.
    """
    if header.precision == "int8_weights":
        lowered = weights_in_int8(lowered)
    elif header.precision == "int8_dynamic":
        lowered = products_in_int8(lowered)
    model = in_standard_operators(lowered)
    for name, value in _settings(header).items():
        model.graph.initializer.append(onnx.numpy_helper.from_array(value, name))
    for key, text in to_metadata(header).items():
        model.metadata_props.add(key=key, value=text)
    model.metadata_props.add(key=SUM, value=NO_SUM)
    return with_sum(model.SerializeToString())


def _settings(header: EncoderHeader) -> dict[str, np.ndarray]:
    """What the settings are where nobody gives any: a splat in metres, that is no part of another."""
    return {
        "voxel": np.array(header.voxel, np.float64),
        "corner": np.full(3, np.inf, np.float32),
        "starts": np.full((header.levels * len(header.orders), 1), -1, np.int64),
    }


@contextmanager
def _quiet() -> Iterator[None]:
    """The exporter tells of its own deprecations, and of packages that it does not need."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)


def random_cloud(count: int, voxel: float, seed: int = 0) -> Gaussians:
    """A sheet of Gaussians of all sizes and shapes, two to a cell and many cells apart.

    Args:
        voxel: edge of a cell, which sizes are measured in.
    """
    rng = np.random.default_rng(seed)
    side = voxel * max(count, 1) ** 0.5
    quats = rng.normal(size=(count, 4))
    return Gaussians(
        means=(rng.uniform(-0.5, 0.5, (count, 3)) * (side, side, 4 * voxel)).astype(np.float32),
        quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        scales=(voxel * np.exp(rng.normal(-1, 1, (count, 3)))).astype(np.float32),
        opacities=rng.uniform(0, 1, count).astype(np.float32),
        sh=rng.normal(size=(count, 1, 3)).astype(np.float32),
    )


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
    """As `gsencoder.models.transformer.NeighborConv`."""
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
    standard = deepcopy(model)
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
    torch.ops.gsencoder.convolve.default: lambda x, neighbors, weight: OURS.convolve(x, neighbors, weight),
    torch.ops.gsencoder.hilbert.default: lambda morton: OURS.hilbert(morton),
    torch.ops.aten.searchsorted.Tensor: _searchsorted,
    torch.ops.aten.sort.stable: _sort,
}


PRODUCT_LIMIT = 63
"""2 · 255 · 63 < 2¹⁵."""


class Product(NamedTuple):
    """A product with weights that do not change, a column of `matrix` for each output channel: a linear layer, or a
    convolution over neighborhoods of `cells`."""

    node: onnx.NodeProto
    x: str
    weight: str
    matrix: Float32[np.ndarray, "rows columns"]
    cells: int = 1

    @property
    def convolves(self) -> bool:
        return bool(self.node.domain == OURS.domain)


def weights_in_int8(model: onnx.ModelProto) -> onnx.ModelProto:
    """Weights are stored as int8 and made float32 when the graph runs; all arithmetic stays what it was."""
    done = deepcopy(model)
    products = {each.node.output[0]: each for each in _products(done.graph)}
    nodes: list[onnx.NodeProto] = []
    for node in done.graph.node:
        product = products.get(node.output[0])
        if product is not None:
            rounded, scale = round_columns(product.matrix)
            # As its operator has them: [cells, C, D] for a convolution, [D, C] for a linear layer.
            shaped = rounded.reshape(product.cells, -1, rounded.shape[1]) if product.convolves else rounded.T
            names = _store(done.graph, product.weight, rounded=shaped, scale=scale)
            wide = f"{product.weight}.float32"
            axis = 2 if product.convolves else 0
            nodes.append(helper.make_node("DequantizeLinear", names, [wide], axis=axis))
            node.input[list(node.input).index(product.weight)] = wide
        nodes.append(node)
    return _with_nodes(done, nodes)


def products_in_int8(model: onnx.ModelProto) -> onnx.ModelProto:
    """Replaces products of floats by products of integers, in a graph whose convolutions are not yet written out."""
    done = deepcopy(model)
    products = {each.node.output[0]: each for each in _products(done.graph)}
    nodes: list[onnx.NodeProto] = []
    as_bytes: dict[str, tuple[str, str, str]] = {}
    for node in done.graph.node:
        product = products.get(node.output[0])
        if product is None:
            nodes.append(node)
            continue
        if product.x not in as_bytes:
            # Queries, keys and values are products of the same tokens.
            as_bytes[product.x] = tuple(f"{product.x}.{chunk}" for chunk in ("uint8", "step", "zero"))  # type: ignore[assignment]
            nodes.append(helper.make_node("DynamicQuantizeLinear", [product.x], list(as_bytes[product.x])))
        rounded, scale = round_columns(product.matrix, PRODUCT_LIMIT)
        weights = _store(done.graph, product.weight, rounded=rounded, scale=scale)
        name, rest = (convolve_int8, []) if product.convolves else (linear_int8, [node.input[2]])
        between = [node.input[1]] if product.convolves else []
        inputs = [*as_bytes[product.x], *between, *weights, *rest]
        nodes.append(helper.make_node(name.name, inputs, list(node.output), domain=OURS.domain))
    return _with_nodes(done, nodes)


def _products(graph: onnx.GraphProto) -> Iterator[Product]:
    initializers = {each.name: numpy_helper.to_array(each) for each in graph.initializer}
    for node in graph.node:
        if node.domain == OURS.domain and node.op_type == convolve.name and node.input[2] in initializers:
            weight = initializers[node.input[2]]
            yield Product(node, node.input[0], node.input[2], weight.reshape(-1, weight.shape[2]), len(weight))
        elif node.op_type == "Gemm" and node.input[1] in initializers:
            attributes = {each.name: helper.get_attribute_value(each) for each in node.attribute}
            if attributes.get("transB", 0) == 1 and not attributes.get("transA", 0) and len(node.input) == 3:
                yield Product(node, node.input[0], node.input[1], initializers[node.input[1]].T)


def _store(graph: onnx.GraphProto, weight: str, **arrays: np.ndarray) -> list[str]:
    names = [f"{weight}.{chunk}" for chunk in arrays]
    graph.initializer.extend(
        numpy_helper.from_array(np.ascontiguousarray(array), name)
        for name, array in zip(names, arrays.values(), strict=True)
    )
    return names


def _with_nodes(model: onnx.ModelProto, nodes: Sequence[onnx.NodeProto]) -> onnx.ModelProto:
    # The list may hold nodes of the graph itself, which go when it is cleared.
    copies = [onnx.NodeProto.FromString(node.SerializeToString()) for node in nodes]
    del model.graph.node[:]
    model.graph.node.extend(copies)
    return model
