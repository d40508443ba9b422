"""Quantization of an exported encoder to eight bits: its weights alone, or its products too.

A weight matrix is rounded to int8 with a scale for each output channel. In a product of integers the other side is
rounded to uint8 with one scale and one zero for all of it: found anew for each cloud (dynamic), or once from clouds
that stand for all (static). Sums are int32, and everything between products stays float32.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import onnx
from jaxtyping import Float32, UInt8
from onnx import helper, numpy_helper

from gsencoder.core.errors import InputError
from gsencoder.core.int8 import round_columns
from gsencoder.core.runtime.tracking import Track, untracked
from gsencoder.infer.encode.chunks import EncodeConfig, cut
from gsencoder.infer.onnx.operators import OURS, convolve, convolve_int8, in_standard_operators, linear_int8
from gsencoder.infer.onnx.runtime import feed_of, open_session
from gsencoder.types import Gaussians

Ranges = Mapping[str, tuple[float, float]]
"""The smallest and the largest value of what goes into products, by name."""


class Product(NamedTuple):
    """A product with weights that do not change: a linear layer or a convolution.

    Attributes:
        node: of the graph.
        x: what is multiplied.
        weight: name of the weights.
        matrix: the same, a column for each output channel.
    """

    node: onnx.NodeProto
    x: str
    weight: str
    matrix: Float32[np.ndarray, "rows columns"]

    @property
    def convolves(self) -> bool:
        """Whether it is a convolution."""
        return bool(self.node.domain == OURS.domain)


def weights_in_int8(model: onnx.ModelProto) -> onnx.ModelProto:
    """Weights are stored as int8 and made float32 when the graph runs; all arithmetic stays what it was."""
    done = _copy(model)
    products = {each.node.output[0]: each for each in _products(done.graph)}
    nodes: list[onnx.NodeProto] = []
    for node in done.graph.node:
        product = products.get(node.output[0])
        if product is not None:
            rounded, scale = round_columns(product.matrix)
            # As its operator has them: [27, C, D] for a convolution, [D, C] for a linear layer.
            shaped = rounded.reshape(27, -1, rounded.shape[1]) if product.convolves else rounded.T
            names = _store(done.graph, product.weight, rounded=shaped, scale=scale)
            wide = f"{product.weight}.float32"
            axis = 2 if product.convolves else 0
            nodes.append(helper.make_node("DequantizeLinear", names, [wide], axis=axis))
            node.input[list(node.input).index(product.weight)] = wide
        nodes.append(node)
    return _with_nodes(done, nodes)


def products_in_int8(model: onnx.ModelProto, ranges: Ranges | None = None) -> onnx.ModelProto:
    """Products are of integers.

    Args:
        model: the graph, its convolutions not yet written out.
        ranges: of `calibrate`; None = each cloud's own.
    """
    done = _copy(model)
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
            nodes.append(_quantize(done.graph, product.x, as_bytes[product.x], ranges))
        rounded, scale = round_columns(product.matrix)
        weights = _store(done.graph, product.weight, rounded=rounded, scale=scale)
        name, rest = (convolve_int8, []) if product.convolves else (linear_int8, [node.input[2]])
        between = [node.input[1]] if product.convolves else []
        inputs = [*as_bytes[product.x], *between, *weights, *rest]
        nodes.append(helper.make_node(name.name, inputs, list(node.output), domain=OURS.domain))
    return _with_nodes(done, nodes)


def step_and_zero(low: float, high: float) -> tuple[Float32[np.ndarray, ""], UInt8[np.ndarray, ""]]:
    """What bytes stand for so that they span a range and hold 0 exactly: step · (byte − zero)."""
    low, high = min(low, 0.0), max(high, 0.0)
    step = max((high - low) / 255, float(np.finfo(np.float32).tiny))
    return np.array(step, np.float32), np.array(np.clip(np.rint(-low / step), 0, 255), np.uint8)


def calibrate(
    model: onnx.ModelProto,
    settings: Mapping[str, np.ndarray],
    clouds: Iterable[tuple[str, Gaussians, float]],
    *,
    track: Track = untracked,
) -> dict[str, tuple[float, float]]:
    """The ranges of what goes into products, over clouds.

    Args:
        model: as above.
        settings: values of the graph's other inputs, for a splat in metres that is no part of another.
        clouds: each with its name and its metres per unit; large ones are run in parts.
        track: wraps the loop over clouds to show progress.

    Raises:
        InputError: no clouds.
    """
    given = tuple(clouds)
    if not given:
        raise InputError("int8_static: give splats or scenes to calibrate on, of the kind that the file is for")
    watched = _copy(model)
    names = tuple(dict.fromkeys(each.x for each in _products(watched.graph)))
    outputs = [f"{name}.{kind}" for kind in ("ReduceMin", "ReduceMax") for name in names]
    for output in outputs:
        name, _, kind = output.rpartition(".")
        watched.graph.node.append(helper.make_node(kind, [name], [output], keepdims=0))
        watched.graph.output.append(helper.make_tensor_value_info(output, onnx.TensorProto.FLOAT, []))
    session = open_session(in_standard_operators(watched).SerializeToString(), "calibration", "cpu")
    low, high = np.full(len(names), np.inf), np.full(len(names), -np.inf)
    for _, cloud, unit in track(given, "calibrating"):
        for chunk in cut(cloud.means, EncodeConfig().chunk, EncodeConfig().halo / unit):
            feed = feed_of(cloud.select(chunk.rows), None, float(settings["voxel"]) / unit)
            extremes = session.run(outputs, {**settings, **feed})
            low, high = np.minimum(low, extremes[: len(names)]), np.maximum(high, extremes[len(names) :])
    return {name: (float(a), float(b)) for name, a, b in zip(names, low, high, strict=True)}


def _products(graph: onnx.GraphProto) -> Iterator[Product]:
    known = {each.name: numpy_helper.to_array(each) for each in graph.initializer}
    for node in graph.node:
        if node.domain == OURS.domain and node.op_type == convolve.name and node.input[2] in known:
            weight = known[node.input[2]]
            yield Product(node, node.input[0], node.input[2], weight.reshape(-1, weight.shape[2]))
        elif node.op_type == "Gemm" and node.input[1] in known:
            given = {each.name: helper.get_attribute_value(each) for each in node.attribute}
            if given.get("transB", 0) == 1 and not given.get("transA", 0) and len(node.input) == 3:
                yield Product(node, node.input[0], node.input[1], known[node.input[1]].T)


def _quantize(graph: onnx.GraphProto, x: str, names: Sequence[str], ranges: Ranges | None) -> onnx.NodeProto:
    if ranges is None:
        return helper.make_node("DynamicQuantizeLinear", [x], list(names))
    step, zero = step_and_zero(*ranges[x])
    graph.initializer.extend([numpy_helper.from_array(step, names[1]), numpy_helper.from_array(zero, names[2])])
    return helper.make_node("QuantizeLinear", [x, *names[1:]], [names[0]])


def _store(graph: onnx.GraphProto, weight: str, **arrays: np.ndarray) -> list[str]:
    names = [f"{weight}.{chunk}" for chunk in arrays]
    graph.initializer.extend(
        numpy_helper.from_array(np.ascontiguousarray(array), name)
        for name, array in zip(names, arrays.values(), strict=True)
    )
    return names


def _copy(model: onnx.ModelProto) -> onnx.ModelProto:
    done = onnx.ModelProto()
    done.CopyFrom(model)
    return done


def _with_nodes(model: onnx.ModelProto, nodes: Sequence[onnx.NodeProto]) -> onnx.ModelProto:
    # The list may hold nodes of the graph itself, which go when it is cleared.
    copies = [onnx.NodeProto.FromString(node.SerializeToString()) for node in nodes]
    del model.graph.node[:]
    model.graph.node.extend(copies)
    return model
