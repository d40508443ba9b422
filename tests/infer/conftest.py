"""An encoder that is small, and what it was exported to."""

import fcntl
import os
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


@pytest.fixture(scope="session")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of weights with a basis and words beside them, as `train` leaves them."""
    folder = tmp_path_factory.mktemp("encoder")
    rng = np.random.default_rng(0)
    table = make_text_table(("mug", "plant", "chair"), np.linalg.qr(rng.normal(size=(6, 3)))[0].T, "words-6")
    table = replace(table, trained=("mug", "plant"))
    space = FeatureSpace(name="six", channels=6, teacher="labels", text_encoder="words-6", preprocessing="none")
    mean = rng.normal(size=6).astype(np.float32)
    components = np.linalg.qr(rng.normal(size=(6, 4)))[0].T.astype(np.float32)
    basis = FeatureBasis(mean=mean, components=components, energy_kept=0.9, space=space)
    torch.manual_seed(0)
    encoder = GaussianEncoder(EncoderConfig(voxel=0.05, transformer=SHAPE), 4)
    outputs = OutputSpace(space=space, mean=mean, scale=2.0, basis=basis)
    spaces = OutputSpaces(by_teacher={"labels": outputs})
    save_weights(folder / "encoder.safetensors", encoder, spaces, {"steps": 3})
    save_text_table(folder / "words.safetensors", table)
    return folder


@pytest.fixture(scope="session")
def lowered(weights: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The encoder as a graph whose convolutions are still one operator each, made by one of all processes of tests."""
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent
    file = folder / "lowered.onnx"
    with open(folder / "lowered.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not file.exists():
            with symbolic_sizes():
                onnx.save(TorchNetwork.load(str(weights)).lower(), file)
    return onnx.load(file)


@pytest.fixture(scope="session")
def exported(weights: Path, lowered: Any) -> Path:
    """The same folder, and in it what the command exported the encoder to."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TorchNetwork, "lower", lambda _: lowered)
        words = [f"weights={weights}", f"out={weights / 'encoder.onnx'}", "sizes=[1,50]", "quiet=true"]
        assert cli.main(["export", *words]) == 0
    return weights
