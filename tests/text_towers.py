"""Small text towers that tests make: a tokenizer of eight words and a graph that looks tokens up in a table."""

from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper
from tokenizers import Tokenizer, models, normalizers, pre_tokenizers, processors

WORDS = ("[PAD]", "[UNK]", "[CLS]", "[SEP]", "red", "mug", "chair", "a")
CHANNELS = 6


def save_tokenizer(path: Path, words: tuple[str, ...] = WORDS) -> None:
    tokenizer = Tokenizer(models.WordLevel({word: row for row, word in enumerate(words)}, unk_token="[UNK]"))
    tokenizer.normalizer = normalizers.Lowercase()
    tokenizer.pre_tokenizer = pre_tokenizers.Whitespace()
    tokenizer.post_processor = processors.TemplateProcessing(
        single="[CLS] $A [SEP]", special_tokens=[("[CLS]", 2), ("[SEP]", 3)]
    )
    tokenizer.enable_truncation(10)
    tokenizer.enable_padding(length=10)
    tokenizer.save(str(path))


def save_graph(
    path: Path,
    rows: int = len(WORDS),
    *,
    output: str = "last_hidden_state",
    scale: float = 1.0,
    mask: bool = True,
    length: int | str = "sequence",
) -> None:
    """A graph that looks each token up in a table; with the output "sentence_embedding" it gives the sum of them."""
    table = np.random.default_rng(0).normal(size=(rows, CHANNELS)).astype(np.float32) * np.float32(scale)
    nodes = [helper.make_node("Gather", ["table", "input_ids"], ["tokens"])]
    if output == "sentence_embedding":
        nodes.append(helper.make_node("ReduceSum", ["tokens", "axes"], [output], keepdims=0))
    else:
        nodes.append(helper.make_node("Identity", ["tokens"], [output]))
    names = ("input_ids", *["attention_mask"] * mask)
    inputs = [helper.make_tensor_value_info(name, TensorProto.INT64, ["batch", length]) for name in names]
    outputs = [helper.make_tensor_value_info(output, TensorProto.FLOAT, None)]
    constants = [numpy_helper.from_array(table, "table"), numpy_helper.from_array(np.array([1]), "axes")]
    graph = helper.make_graph(nodes, "text", inputs, outputs, constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=10)
    onnx.save(model, path)
