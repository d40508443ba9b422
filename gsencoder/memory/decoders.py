"""What M3 compares Gaussian memory attention with: low-dimensional features and a decoder, at the same width.

A linear decoder is that of Feature-3DGS (Zhou et al. 2024), a perceptron that of Feature-Splatting (Qiu et al. 2024).
"""

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

Decoder = Literal["linear", "mlp"]


def make_decoder(
    kind: Decoder, projection: Float[Tensor, "s C"], *, hidden: int = 64, generator: torch.Generator | None = None
) -> nn.Module:
    """A decoder from s channels to C.

    Args:
        kind: linear, or a perceptron of one hidden layer.
        projection: initial weights of the linear decoder.
        hidden: units of the perceptron.
        generator: of the perceptron's initial weights.
    """
    channels, width = projection.shape
    if kind == "linear":
        linear = nn.Linear(channels, width)
        with torch.no_grad():
            linear.weight.copy_(projection.T)
            linear.bias.zero_()
        return linear
    layers = nn.Sequential(nn.Linear(channels, hidden), nn.ReLU(), nn.Linear(hidden, width))
    with torch.no_grad():
        for layer in (layers[0], layers[2]):
            assert isinstance(layer, nn.Linear)
            bound = layer.in_features**-0.5
            for parameter in (layer.weight, layer.bias):
                parameter.uniform_(-bound, bound, generator=generator)
    return layers
