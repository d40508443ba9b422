"""A teacher's adapter heads on disk: small perceptrons that lead from its backbone's features to other spaces.

RADIO's adapters turn backbone features into those of CLIP, SigLIP, DINO or SAM. Distilled features must serve them as
the teacher's own do, so the render loss may be taken behind them (SplatDistill Eq. 4). A file holds, for each head, its
layers, and mean and scale of what it gives for the teacher's features. Both sides of the loss are decoded from the
dataset's basis before: where the basis has dropped what a head looks at, a larger `prepare.fusion.max_rank` keeps it.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from gsencoder.core.errors import InputError
from gsencoder.core.files.archive import Archive, open_archive, write_archive
from gsencoder.models.output_space import OutputSpace
from gsencoder.train.losses import Head

KINDS: dict[str, tuple[type[nn.Module], tuple[str, ...]]] = {
    "linear": (nn.Linear, ("weight", "bias")),
    "layernorm": (nn.LayerNorm, ("weight", "bias")),
    "gelu": (nn.GELU, ()),
    "relu": (nn.ReLU, ()),
}
"""Layers that a head may have, and their parameters."""


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


class Residual(nn.Sequential):
    """x + f(x), f being the layers one after the other."""

    def forward(self, x: Float[Tensor, "n C"]) -> Float[Tensor, "n C"]:
        out: Tensor = x + super().forward(x)
        return out


def save_heads(path: Path, heads: Mapping[str, tuple[nn.Sequential, np.ndarray, float]]) -> None:
    """Writes heads: for each name its layers (linear, layer norms, GELU, ReLU, and `Residual` blocks of such), and the
    mean and the scale of its outputs.

    Raises:
        InputError: a layer of another kind, or the disk is full.
    """
    arrays: dict[str, np.ndarray] = {}
    header = []
    for name, (layers, mean, scale) in heads.items():
        arrays[f"{name}.mean"] = mean.astype(np.float32)
        header.append({"name": name, "layers": _describe(layers, name, arrays), "scale": float(scale)})
    write_archive(path, arrays, {"heads": header})


def _describe(layers: nn.Sequential, name: str, arrays: dict[str, np.ndarray]) -> list[Any]:
    """The kinds of layers, blocks as lists of such; parameters go into `arrays`."""
    kinds: list[Any] = []
    for number, layer in enumerate(layers):
        own = f"{name}.{number}"
        if isinstance(layer, Residual):
            kinds.append(_describe(layer, own, arrays))
            continue
        kind = next((kind for kind, (cls, _) in KINDS.items() if type(layer) is cls), None)
        if kind is None:
            raise InputError(f"heads: {own}: expected {', '.join(KINDS)} or Residual, got {type(layer).__name__}")
        kinds.append(kind)
        for parameter in KINDS[kind][1]:
            arrays[f"{own}.{parameter}"] = getattr(layer, parameter).detach().float().numpy()
    return kinds


def load_heads(path: Path, outputs: OutputSpace) -> list[tuple[Head, nn.Module]]:
    """Heads for features of an output space, each with what decodes standard units for it.

    Raises:
        InputError: missing, damaged, or for features of another width.
    """
    decode = Decode(outputs)
    found: list[tuple[Head, nn.Module]] = []
    with open_archive(path) as file:
        for entry in file.value("heads", list):
            name, kinds, scale = entry.get("name"), entry.get("layers"), entry.get("scale")
            if not isinstance(name, str) or not isinstance(kinds, list) or not kinds or not isinstance(scale, float):
                raise InputError(f"expected heads with name, layers and scale, got {str(entry)[:80]}")
            layers, width = _read(file, kinds, name, outputs.space.channels)
            mean = torch.from_numpy(file.array(f"{name}.mean", "float32", (width,)).copy())
            found.append((Head(nn.Sequential(*layers), mean, scale), decode))
    return found


def _read(file: Archive, kinds: Sequence[Any], name: str, width: int) -> tuple[list[nn.Module], int]:
    """The layers of a list of kinds, for inputs of a width, and the width of what they give."""
    layers: list[nn.Module] = []
    for number, kind in enumerate(kinds):
        own = f"{name}.{number}"
        if isinstance(kind, list):
            inner, out = _read(file, kind, own, width)
            if out != width:
                raise InputError(f"{own}: expected a residual block that gives {width} channels, got {out}")
            layers.append(Residual(*inner))
        elif kind == "linear":
            weight = file.array(f"{own}.weight", "float32", (own, width))
            linear = nn.Linear(width, len(weight))
            width = len(weight)
            bias = file.array(f"{own}.bias", "float32", (width,))
            linear.weight.data, linear.bias.data = torch.from_numpy(weight.copy()), torch.from_numpy(bias.copy())
            layers.append(linear)
        elif kind == "layernorm":
            norm = nn.LayerNorm(width)
            for parameter in KINDS[kind][1]:
                value = file.array(f"{own}.{parameter}", "float32", (width,))
                getattr(norm, parameter).data = torch.from_numpy(value.copy())
            layers.append(norm)
        elif kind in KINDS:
            layers.append(KINDS[kind][0]())
        else:
            raise InputError(f"{own}: expected {', '.join(KINDS)} or a list of such, got {str(kind)[:20]!r}")
    return layers, width
