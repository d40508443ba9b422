"""An encoder that is small, and what it was exported to."""

import fcntl
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from symbolic import symbolic_sizes
from training_scenes import SMALL

from gsencoder.app import main as cli
from gsencoder.infer.torch_network import TorchNetwork
from gsencoder.models.encoder import EncoderConfig, GaussianEncoder, save_weights
from gsencoder.models.output_space import OutputSpace, OutputSpaces
from gsencoder.models.transformer import TransformerConfig
from gsencoder.text.table import make_text_table, save_text_table
from gsencoder.types import FeatureBasis, FeatureSpace

SHAPE = replace(SMALL.transformer, head_channels=8, patch=24, drop_path=TransformerConfig().drop_path)


SEVERAL_COLUMNS = "features_of_all_teachers"


def save_encoder(folder: Path, state: Mapping[str, torch.Tensor] | None, spaces: OutputSpaces) -> GaussianEncoder:
    """Weights of these teachers, which are those of `state` where it is given, with words beside them."""
    torch.manual_seed(0)
    encoder = GaussianEncoder(EncoderConfig(voxel=0.05, stem=5, transformer=SHAPE), spaces.widths)
    if state is not None:
        encoder.load_state_dict({name: state[name] for name in encoder.state_dict()})
    save_weights(folder / "encoder.safetensors", encoder, spaces, {"steps": 3})
    vectors = np.linalg.qr(np.random.default_rng(0).normal(size=(6, 3)))[0].T
    table = replace(make_text_table(("mug", "plant", "chair"), vectors, "words-6"), trained=("mug", "plant"))
    save_text_table(folder / ("words.safetensors" if len(spaces) == 1 else "words.labels.safetensors"), table)
    return encoder


@pytest.fixture(scope="session")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A folder of weights with a basis and words beside them, as `train` leaves them; and one whose encoder has two
    more teachers, and otherwise the same parameters."""
    rng = np.random.default_rng(1)
    space = FeatureSpace(name="six", channels=6, teacher="labels", text_encoder="words-6", preprocessing="none")
    mean = rng.normal(size=6).astype(np.float32)
    components = np.linalg.qr(rng.normal(size=(6, 4)))[0].T.astype(np.float32)
    basis = FeatureBasis(mean=mean, components=components, energy_kept=0.9, space=space)
    labels = OutputSpace(space=space, mean=mean, scale=2.0, basis=basis)
    thirds = np.arange(3, dtype=np.float32) / 10
    colors = OutputSpace(space=FeatureSpace(name="three", channels=3), mean=thirds, scale=5.0)
    # A teacher whose vectors are learned as they are.
    raw = replace(colors, space=FeatureSpace(name="raw", channels=3), centered=False, scaled=False)
    one, several = tmp_path_factory.mktemp("encoder"), tmp_path_factory.mktemp("several")
    outputs = OutputSpaces(by_teacher={"labels": labels, "colors": colors, "raw": raw})
    state = save_encoder(several, None, outputs).state_dict()
    save_encoder(one, state, OutputSpaces(by_teacher={"labels": labels}))
    return one, several


@pytest.fixture(scope="session")
def weights(folders: tuple[Path, Path]) -> Path:
    return folders[0]


@pytest.fixture(scope="session")
def several(folders: tuple[Path, Path]) -> Path:
    return folders[1]


@pytest.fixture(scope="session")
def lowered_several(several: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The encoder of several teachers as a graph whose convolutions are still one operator each, made by one of all
    processes of tests."""
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent
    file = folder / "lowered.onnx"
    with open(folder / "lowered.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not file.exists():
            with symbolic_sizes():
                onnx.save(TorchNetwork.load(str(several)).lower(), file)
    return onnx.load(file)


@pytest.fixture(scope="session")
def lowered(weights: Path, lowered_several: Any) -> Any:
    """The encoder of one teacher as such a graph: the columns of the first of several, since a graph takes a quarter of
    a minute to make."""
    graph = onnx.ModelProto()
    graph.CopyFrom(lowered_several)
    (output,) = graph.graph.output
    (node,) = (each for each in graph.graph.node if output.name in each.output)
    node.output[list(node.output).index(output.name)] = SEVERAL_COLUMNS
    (columns,) = TorchNetwork.load(str(weights)).header.outputs.widths
    for name, at in (("first", 0), ("end", columns), ("axis", 1)):
        graph.graph.initializer.append(onnx.helper.make_tensor(f"cut.{name}", onnx.TensorProto.INT64, [1], [at]))
    inputs = [SEVERAL_COLUMNS, "cut.first", "cut.end", "cut.axis"]
    graph.graph.node.append(onnx.helper.make_node("Slice", inputs, [output.name]))
    output.type.tensor_type.shape.dim[1].dim_value = columns
    return graph


@pytest.fixture(scope="session")
def exported(weights: Path, lowered: Any) -> Path:
    """The folder of one teacher, and in it what the command exported the encoder to."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TorchNetwork, "lower", lambda _: lowered)
        words = [f"weights={weights}", f"out={weights / 'encoder.onnx'}", "sizes=[1,50]", "quiet=true"]
        assert cli.main(["export", *words]) == 0
    return weights
