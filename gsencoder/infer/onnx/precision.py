"""Quantization of an exported encoder to eight bits: its weights alone, or its products too.

A weight matrix is rounded to int8 with a scale for each output channel. In a product of integers the other factor is
rounded to uint8 with one scale and one zero point, which are computed when the graph runs (dynamic quantization). Sums
are int32, and everything between products stays float32.

Processors without VNNI add two products of bytes in 16 bits, which 255 · 127 twice overflows without an error. Weights
of integer products are therefore at most `PRODUCT_LIMIT`.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import onnx
from jaxtyping import Float32
from onnx import helper, numpy_helper

from gsencoder.core.arrays import round_columns
from gsencoder.infer.onnx.operators import OURS, convolve, convolve_int8, linear_int8

PRODUCT_LIMIT = 63
"""2 · 255 · 63 < 2¹⁵."""


class Product(NamedTuple):
    """A product with weights that do not change: a linear layer or a convolution.

    Attributes:
        node: of the graph.
        x: what is multiplied.
        weight: name of the weights.
        matrix: the same, a column for each output channel.
        cells: cells of a convolution's neighborhood; 1 for a linear layer.
    """

    node: onnx.NodeProto
    x: str
    weight: str
    matrix: Float32[np.ndarray, "rows columns"]
    cells: int = 1

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
