"""Adapter heads of a teacher on disk: small MLPs from the features of its backbone to other feature spaces.

RADIO's adapters map backbone features to those of CLIP, SigLIP, DINO or SAM. Distilled features must work with them as
the teacher's features do, so the render loss can be computed on the outputs of the heads (SplatDistill Eq. 4). For each
head a file holds its layers, and the mean and the scale of its outputs for the teacher's features. Both sides of the
loss are decoded from the dataset's basis first; if the basis drops components that a head needs, raise
`prepare.fusion.max_rank`.
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
from gsencoder.train.losses import AdapterHead

LAYER_TYPES: dict[str, tuple[type[nn.Module], tuple[str, ...]]] = {
    "linear": (nn.Linear, ("weight", "bias")),
    "layernorm": (nn.LayerNorm, ("weight", "bias")),
    "gelu": (nn.GELU, ()),
    "relu": (nn.ReLU, ()),
}
"""The layer types that a head may have, with the names of their parameters."""


class FeatureDecoder(nn.Module):
    """Decodes outputs of the encoder to vectors of the teacher's space; differentiable."""

    mean: Tensor
    components: Tensor

    def __init__(self, outputs: OutputSpace) -> None:
        super().__init__()
        rows = np.eye(outputs.channels, dtype=np.float32) if outputs.basis is None else outputs.basis.components
        mean = outputs.mean if outputs.centered else np.zeros_like(outputs.mean)
        self.register_buffer("mean", torch.from_numpy(mean.copy()))
        self.register_buffer("components", torch.from_numpy(rows * np.float32(outputs.unit)))

    def forward(self, standard: Float[Tensor, "n channels"]) -> Float[Tensor, "n D"]:
        out: Tensor = standard @ self.components + self.mean
        return out


class Residual(nn.Sequential):
    """A residual block: x + f(x), where f applies the layers in sequence."""

    def forward(self, x: Float[Tensor, "n C"]) -> Float[Tensor, "n C"]:
        out: Tensor = x + super().forward(x)
        return out


def save_heads(path: Path, heads: Mapping[str, tuple[nn.Sequential, np.ndarray, float]]) -> None:
    """Writes adapter heads to a file.

    Args:
        path: the file.
        heads: for each name, the layers (linear, layer norm, GELU, ReLU, or `Residual` blocks of these), and the mean
            [E] and scale of their outputs.

    Raises:
        InputError: a layer of another type, or the disk is full.
    """
    arrays: dict[str, np.ndarray] = {}
    header = []
    for name, (layers, mean, scale) in heads.items():
        arrays[f"{name}.mean"] = mean.astype(np.float32)
        header.append({"name": name, "layers": _describe_layers(layers, name, arrays), "scale": float(scale)})
    write_archive(path, arrays, {"heads": header})


def _describe_layers(layers: nn.Sequential, name: str, arrays: dict[str, np.ndarray]) -> list[Any]:
    """The names of the layers' types, residual blocks as nested lists; parameters are added to `arrays`."""
    layer_types: list[Any] = []
    for number, layer in enumerate(layers):
        key = f"{name}.{number}"
        if isinstance(layer, Residual):
            layer_types.append(_describe_layers(layer, key, arrays))
            continue
        layer_type = next((layer_type for layer_type, (cls, _) in LAYER_TYPES.items() if type(layer) is cls), None)
        if layer_type is None:
            raise InputError(f"heads: {key}: expected {', '.join(LAYER_TYPES)} or Residual, got {type(layer).__name__}")
        layer_types.append(layer_type)
        for parameter in LAYER_TYPES[layer_type][1]:
            arrays[f"{key}.{parameter}"] = getattr(layer, parameter).detach().float().numpy()
    return layer_types


def load_heads(path: Path, outputs: OutputSpace) -> list[tuple[AdapterHead, nn.Module]]:
    """Loads adapter heads for features of an output space.

    Returns:
        The heads, each with a decoder from standard units to its input.

    Raises:
        InputError: the file is missing or damaged, or is for features with another number of channels.
    """
    decode = FeatureDecoder(outputs)
    heads: list[tuple[AdapterHead, nn.Module]] = []
    with open_archive(path) as file:
        for entry in file.value("heads", list):
            name, layer_types, scale = entry.get("name"), entry.get("layers"), entry.get("scale")
            if (
                not isinstance(name, str)
                or not isinstance(layer_types, list)
                or not layer_types
                or not isinstance(scale, float)
            ):
                raise InputError(f"expected heads with name, layers and scale, got {str(entry)[:80]}")
            layers, width = _read_layers(file, layer_types, name, outputs.space.channels)
            mean = torch.from_numpy(file.array(f"{name}.mean", "float32", (width,)).copy())
            heads.append((AdapterHead(nn.Sequential(*layers), mean, scale), decode))
    return heads


def _read_layers(file: Archive, layer_types: Sequence[Any], name: str, width: int) -> tuple[list[nn.Module], int]:
    """Reads layers with inputs of `width` channels; returns them and the number of channels of their outputs."""
    layers: list[nn.Module] = []
    for number, layer_type in enumerate(layer_types):
        key = f"{name}.{number}"
        if isinstance(layer_type, list):
            inner, out = _read_layers(file, layer_type, key, width)
            if out != width:
                raise InputError(f"{key}: expected a residual block with {width} output channels, got {out}")
            layers.append(Residual(*inner))
        elif layer_type == "linear":
            weight = file.array(f"{key}.weight", "float32", (key, width))
            linear = nn.Linear(width, len(weight))
            width = len(weight)
            bias = file.array(f"{key}.bias", "float32", (width,))
            linear.weight.data, linear.bias.data = torch.from_numpy(weight.copy()), torch.from_numpy(bias.copy())
            layers.append(linear)
        elif layer_type == "layernorm":
            norm = nn.LayerNorm(width)
            for parameter in LAYER_TYPES[layer_type][1]:
                value = file.array(f"{key}.{parameter}", "float32", (width,))
                getattr(norm, parameter).data = torch.from_numpy(value.copy())
            layers.append(norm)
        elif layer_type in LAYER_TYPES:
            layers.append(LAYER_TYPES[layer_type][0]())
        else:
            raise InputError(
                f"{key}: expected {', '.join(LAYER_TYPES)} or a list of these, got {str(layer_type)[:20]!r}"
            )
    return layers, width
