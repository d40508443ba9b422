"""Adapter heads on disk, and what the render loss does behind them."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from gsencoder.data.archive import write_archive
from gsencoder.errors import InputError
from gsencoder.models.output_space import OutputSpace
from gsencoder.train.heads import Decode, load_heads, save_heads
from gsencoder.types import FeatureBasis, FeatureSpace

SPACE = FeatureSpace(name="s", channels=6)


def outputs(rank: int = 3) -> OutputSpace:
    rng = np.random.default_rng(0)
    components = np.linalg.qr(rng.normal(size=(6, 6)))[0][:rank].astype(np.float32)
    mean = rng.normal(size=6).astype(np.float32)
    basis = FeatureBasis(mean=mean, components=components, energy_kept=1.0, space=SPACE) if rank else None
    return OutputSpace(space=SPACE, mean=mean, scale=2.0, basis=basis)


@pytest.mark.parametrize("rank", [0, 3])
def test_decoding_undoes_standard_units(rank: int) -> None:
    space = outputs(rank)
    standard = np.random.default_rng(1).normal(size=(5, space.channels)).astype(np.float32)
    restored = space.restore(standard)
    expected = restored if space.basis is None else restored @ space.basis.components + space.mean
    found = Decode(space)(torch.from_numpy(standard)).numpy()
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_heads_that_are_read_give_what_the_written_ones_gave(tmp_path: Path) -> None:
    layers = [nn.Linear(6, 8), nn.Linear(8, 4)]
    mean = np.arange(4, dtype=np.float32)
    save_heads(tmp_path / "h", {"clip": (layers, mean, 2.0), "dino": ([nn.Linear(6, 5)], np.zeros(5), 1.0)})
    (clip, decode), (dino, _) = load_heads(tmp_path / "h", outputs())
    standard = torch.randn(7, 3)
    features = decode(standard)
    expected = (layers[1](nn.functional.gelu(layers[0](features))) - torch.from_numpy(mean)) / (2.0 / 4**0.5)
    torch.testing.assert_close(clip(features), expected)
    assert dino(features).shape == (7, 5)
    assert not any(value.requires_grad for value in clip.parameters())


def test_heads_for_features_of_another_width_are_refused(tmp_path: Path) -> None:
    save_heads(tmp_path / "h", {"clip": ([nn.Linear(9, 4)], np.zeros(4), 1.0)})
    with pytest.raises(InputError, match=r"expected clip\.0\.weight"):
        load_heads(tmp_path / "h", outputs())


@pytest.mark.parametrize(
    "entry", [{}, {"name": "a", "layers": 0, "scale": 1.0}, {"name": 3, "layers": 1, "scale": 1.0}]
)
def test_a_file_that_lists_no_heads_is_refused(tmp_path: Path, entry: dict) -> None:
    write_archive(tmp_path / "h", {"x": np.zeros(1, np.float32)}, {"heads": [entry]})
    with pytest.raises(InputError, match="expected heads with name, layers and scale"):
        load_heads(tmp_path / "h", outputs())


@pytest.mark.parametrize("scale", [0.0, -1.0, float("inf")])
def test_a_scale_that_is_none_is_refused(tmp_path: Path, scale: float) -> None:
    save_heads(tmp_path / "h", {"clip": ([nn.Linear(6, 4)], np.zeros(4), scale)})
    with pytest.raises(InputError, match="scale"):
        load_heads(tmp_path / "h", outputs())
