"""Words for the classes of networks that segment pictures, and views for them."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper
from splats import front_camera

from gsencoder.teachers.segmenter import OnnxSegmenterOptions, SegmenterConfig, SegmenterTeacher
from gsencoder.text.table import TextTable, make_text_table, unit
from gsencoder.text.vocabulary import OpenVocabulary
from gsencoder.types import Views

NAMES = ("other", "wall", "chair, seat", "table")


def words(rng: np.random.Generator, names: Sequence[str] = ("wall", "chair", "seat", "table", "lamp")) -> TextTable:
    return make_text_table(names, unit(rng.normal(size=(len(names), 8))), "toy")


def views_of(image: np.ndarray) -> Views:
    return Views(cameras=front_camera(image.shape[1], image.shape[0]), names=("a",), images=[image])


PLAIN = OnnxSegmenterOptions(scale=1.0, mean=(0.0, 0.0, 0.0), std=(1.0, 1.0, 1.0))


def save_graph(
    path: Path,
    *,
    input_type: int = TensorProto.FLOAT,
    shape: Sequence[Any] = (1, 3, 8, 12),
    last: bool = False,
    fourth: float = 1.5,
) -> None:
    """A graph that gives for class c the mean of channel c of cells of 2×2 pixels; the fourth class is constant."""
    pick = np.zeros((4, 3, 2, 2), np.float32)
    for channel in range(3):
        pick[channel, channel] = 0.25
    nodes = [helper.make_node("Cast", ["image"], ["float"], to=TensorProto.FLOAT)]
    nodes += [helper.make_node("Transpose", ["float"], ["first"], perm=[0, 3, 1, 2])] * last
    nodes += [helper.make_node("Conv", ["first" if last else "float", "pick", "bias"], ["scores"], strides=[2, 2])]
    output = helper.make_tensor_value_info("scores", TensorProto.FLOAT, None)
    weights = [
        numpy_helper.from_array(pick, "pick"),
        numpy_helper.from_array(np.array([0, 0, 0, fourth], np.float32), "bias"),
    ]
    graph = helper.make_graph(
        nodes, "net", [helper.make_tensor_value_info("image", input_type, shape)], [output], weights
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=10), path)


def teacher_of(
    path: Path, table: TextTable | OpenVocabulary, options: OnnxSegmenterOptions = PLAIN
) -> SegmenterTeacher:
    classes = path.with_name("classes.json")
    if not classes.exists():
        classes.write_text(json.dumps(NAMES))
    return SegmenterTeacher(SegmenterConfig(model=str(path), classes=str(classes), onnx=options), table)
