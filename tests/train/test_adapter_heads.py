"""Adapter heads on disk, and what the render loss does behind them."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from gsencoder.core.errors import InputError
from gsencoder.core.files.archive import write_archive
from gsencoder.models.output_space import OutputSpace
from gsencoder.train.adapter_heads import FeatureDecoder, Residual, load_heads, save_heads
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
    found = FeatureDecoder(space)(torch.from_numpy(standard)).numpy()
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_heads_that_are_read_give_what_the_written_ones_gave(tmp_path: Path) -> None:
    layers = nn.Sequential(nn.Linear(6, 8), nn.GELU(), nn.Linear(8, 4))
    mean = np.arange(4, dtype=np.float32)
    save_heads(
        tmp_path / "h", {"clip": (layers, mean, 2.0), "dino": (nn.Sequential(nn.Linear(6, 5)), np.zeros(5), 1.0)}
    )
    (clip, decode), (dino, _) = load_heads(tmp_path / "h", outputs())
    standard = torch.randn(7, 3)
    features = decode(standard)
    expected = (layers(features) - torch.from_numpy(mean)) / (2.0 / 4**0.5)
    torch.testing.assert_close(clip(features), expected)
    assert dino(features).shape == (7, 5)
    assert not any(value.requires_grad for value in clip.parameters())


def test_norms_and_residual_blocks_as_radio_has_them_come_back(tmp_path: Path) -> None:
    torch.manual_seed(0)
    block = Residual(nn.LayerNorm(8), nn.GELU(), nn.Linear(8, 8))
    layers = nn.Sequential(nn.Linear(6, 8), block, nn.LayerNorm(8), nn.ReLU(), nn.Linear(8, 4))
    for parameter in layers.parameters():
        nn.init.normal_(parameter)
    save_heads(tmp_path / "h", {"siglip": (layers, np.zeros(4), 2.0)})
    ((head, _),) = load_heads(tmp_path / "h", outputs())
    x = torch.randn(7, 6)
    torch.testing.assert_close(head(x), layers(x))


def test_layers_that_a_file_cannot_hold_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"clip\.1: expected linear, layernorm, gelu, relu or Residual, got Tanh"):
        save_heads(tmp_path / "h", {"clip": (nn.Sequential(nn.Linear(6, 4), nn.Tanh()), np.zeros(4), 1.0)})


def test_heads_for_features_of_another_width_are_refused(tmp_path: Path) -> None:
    save_heads(tmp_path / "h", {"clip": (nn.Sequential(nn.Linear(9, 4)), np.zeros(4), 1.0)})
    with pytest.raises(InputError, match=r"expected clip\.0\.weight"):
        load_heads(tmp_path / "h", outputs())


@pytest.mark.parametrize(
    "entry",
    [
        {},
        {"name": "a", "layers": [], "scale": 1.0},
        {"name": 3, "layers": ["linear"], "scale": 1.0},
        {"name": "a", "layers": ["tanh"], "scale": 1.0},
    ],
)
def test_a_file_that_lists_no_heads_is_refused(tmp_path: Path, entry: dict) -> None:
    write_archive(tmp_path / "h", {"x": np.zeros(1, np.float32)}, {"heads": [entry]})
    with pytest.raises(InputError, match=r"expected heads with name, layers|a\.0: expected linear, layernorm"):
        load_heads(tmp_path / "h", outputs())


@pytest.mark.parametrize("scale", [0.0, -1.0, float("inf")])
def test_a_scale_that_is_none_is_refused(tmp_path: Path, scale: float) -> None:
    save_heads(tmp_path / "h", {"clip": (nn.Sequential(nn.Linear(6, 4)), np.zeros(4), scale)})
    with pytest.raises(InputError, match="scale"):
        load_heads(tmp_path / "h", outputs())
