"""The layers of adapter heads, and how an archive holds them."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from gsencoder.core.archive import Archive
from gsencoder.core.errors import InputError

LAYER_TYPES: dict[str, tuple[type[nn.Module], tuple[str, ...]]] = {
    "linear": (nn.Linear, ("weight", "bias")),
    "layernorm": (nn.LayerNorm, ("weight", "bias")),
    "gelu": (nn.GELU, ()),
    "relu": (nn.ReLU, ()),
}
"""The layer types that a head may have, with the names of their parameters."""


class Residual(nn.Sequential):
    """A residual block: x + f(x), where f applies the layers in sequence."""

    def forward(self, x: Float[Tensor, "n C"]) -> Float[Tensor, "n C"]:
        out: Tensor = x + super().forward(x)
        return out


def describe_layers(layers: nn.Sequential, name: str, arrays: dict[str, np.ndarray]) -> list[Any]:
    """The names of the layers' types, residual blocks as nested lists.

    Args:
        layers: linear layers, layer norms, GELU, ReLU, or `Residual` blocks of these.
        name: prefix of the arrays.
        arrays: the parameters are added here, as NAME.NUMBER.PARAMETER.

    Raises:
        InputError: a layer of another type.
    """
    layer_types: list[Any] = []
    for number, layer in enumerate(layers):
        key = f"{name}.{number}"
        if isinstance(layer, Residual):
            layer_types.append(describe_layers(layer, key, arrays))
            continue
        layer_type = next((layer_type for layer_type, (cls, _) in LAYER_TYPES.items() if type(layer) is cls), None)
        if layer_type is None:
            raise InputError(f"heads: {key}: expected {', '.join(LAYER_TYPES)} or Residual, got {type(layer).__name__}")
        layer_types.append(layer_type)
        for parameter in LAYER_TYPES[layer_type][1]:
            arrays[f"{key}.{parameter}"] = getattr(layer, parameter).detach().float().numpy()
    return layer_types


def read_layers(file: Archive, layer_types: Sequence[Any], name: str, width: int) -> tuple[nn.Sequential, int]:
    """Reads layers that `describe_layers` described.

    Args:
        file: the archive.
        layer_types: what `describe_layers` returned.
        name: prefix of the arrays.
        width: number of channels of the first layer's input.

    Returns:
        The layers, and the number of channels of their outputs.

    Raises:
        InputError: an unknown type of layer, or parameters that are missing or do not fit each other.
    """
    layers: list[nn.Module] = []
    for number, layer_type in enumerate(layer_types):
        key = f"{name}.{number}"
        if isinstance(layer_type, list):
            inner, out = read_layers(file, layer_type, key, width)
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
        elif isinstance(layer_type, str) and layer_type in LAYER_TYPES:
            layers.append(LAYER_TYPES[layer_type][0]())
        else:
            raise InputError(
                f"{key}: expected {', '.join(LAYER_TYPES)} or a list of these, got {str(layer_type)[:20]!r}"
            )
    return nn.Sequential(*layers), width
