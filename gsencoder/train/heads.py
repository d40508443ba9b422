"""A teacher's adapter heads on disk: small perceptrons that lead from its backbone's features to other spaces.

RADIO's adapters turn backbone features into those of CLIP, SigLIP, DINO or SAM. Distilled features must serve them as
the teacher's own do, so the render loss may be taken behind them (SplatDistill Eq. 4). A file holds, for each head, its
layers (linear, with GELU between), and mean and scale of what it gives for the teacher's features.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from gsencoder.data.archive import open_archive, write_archive
from gsencoder.errors import InputError
from gsencoder.models.output_space import OutputSpace
from gsencoder.train.losses import Head


class Decode(nn.Module):
    """From standard units to the teacher's own vectors, differentiable."""

    mean: Tensor
    components: Tensor

    def __init__(self, outputs: OutputSpace) -> None:
        super().__init__()
        rows = np.eye(outputs.channels, dtype=np.float32) if outputs.basis is None else outputs.basis.components
        self.register_buffer("mean", torch.from_numpy(outputs.mean.copy()))
        self.register_buffer("components", torch.from_numpy(rows * np.float32(outputs.unit)))

    def forward(self, standard: Float[Tensor, "n channels"]) -> Float[Tensor, "n D"]:
        out: Tensor = standard @ self.components + self.mean
        return out


def save_heads(path: Path, heads: Mapping[str, tuple[Sequence[nn.Linear], np.ndarray, float]]) -> None:
    """Writes heads: for each name its layers, and the mean and the scale of its outputs.

    Raises:
        InputError: the disk is full.
    """
    arrays: dict[str, np.ndarray] = {}
    header = []
    for name, (layers, mean, scale) in heads.items():
        for number, layer in enumerate(layers):
            arrays[f"{name}.{number}.weight"] = layer.weight.detach().float().numpy()
            arrays[f"{name}.{number}.bias"] = layer.bias.detach().float().numpy()
        arrays[f"{name}.mean"] = mean.astype(np.float32)
        header.append({"name": name, "layers": len(layers), "scale": float(scale)})
    write_archive(path, arrays, {"heads": header})


def load_heads(path: Path, outputs: OutputSpace) -> list[tuple[Head, nn.Module]]:
    """Heads for features of an output space, each with what decodes standard units for it.

    Raises:
        InputError: missing, damaged, or for features of another width.
    """
    decode = Decode(outputs)
    found: list[tuple[Head, nn.Module]] = []
    with open_archive(path) as file:
        for entry in file.value("heads", list):
            name, count, scale = entry.get("name"), entry.get("layers"), entry.get("scale")
            if not isinstance(name, str) or not isinstance(count, int) or count < 1 or not isinstance(scale, float):
                raise InputError(f"expected heads with name, layers and scale, got {str(entry)[:80]}")
            width = outputs.space.channels
            layers: list[nn.Module] = []
            for number in range(count):
                weight = file.array(f"{name}.{number}.weight", "float32", (f"{name}{number}", width))
                bias = file.array(f"{name}.{number}.bias", "float32", (len(weight),))
                layer = nn.Linear(width, len(weight))
                layer.weight.data, layer.bias.data = torch.from_numpy(weight.copy()), torch.from_numpy(bias.copy())
                layers += [layer, nn.GELU()]
                width = len(weight)
            mean = torch.from_numpy(file.array(f"{name}.mean", "float32", (width,)).copy())
            found.append((Head(nn.Sequential(*layers[:-1]), mean, scale), decode))
    return found
