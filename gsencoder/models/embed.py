"""Input channels of the encoder, computed from Gaussian attributes.

The channels do not depend on where the scene lies, nor on the sign and the axis order that a file chose. A quaternion
and three scales describe the same ellipsoid in 48 ways, and a network would have to learn that they are equal. The
logarithm of the covariance has one value for each ellipsoid, is linear in log-scales, and stays within a few units for
scales from 1e-9 to 1e4. `rotation` is its trace-free part and `scale` the sorted log-scales, so that either can be left
out.
"""

import math
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from gsencoder.geometry import rotmats_from_quats
from gsencoder.types import SH_C0

Attribute = Literal["offset", "color", "opacity", "scale", "rotation"]

ATTRIBUTE_CHANNELS: dict[Attribute, int] = {"offset": 3, "color": 3, "opacity": 1, "scale": 3, "rotation": 6}

MAX_ABS_LOG_SCALE = 12.0
"""Limit to which log-scales relative to the voxel are clamped: no useful Gaussian is smaller or larger than e^±12
voxels."""


def input_channels(attributes: tuple[Attribute, ...]) -> int:
    """The number of channels that attributes have in total."""
    return sum(ATTRIBUTE_CHANNELS[name] for name in attributes)


def embed(
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    scales: Float[Tensor, "N 3"],
    opacities: Float[Tensor, " N"],
    sh_dc: Float[Tensor, "N 3"],
    *,
    voxel: float | Float[Tensor, ""],
    attributes: tuple[Attribute, ...],
) -> Float[Tensor, "N C"]:
    """Computes the input channels, all of order one.

    offset: position of the center in its voxel, −1 to 1. color: degree-0 color, −1 for black to 1 for white, clamped to
    ±2. opacity: −1 to 1. scale: ¼ of log(scale / voxel), largest first. rotation: ¼ of the six distinct entries of
    R diag(log s − mean log s) Rᵀ, the off-diagonal ones times √2, so that distances between inputs are Frobenius
    distances between matrices.

    Args:
        means: world units.
        quats: wxyz; normalized here.
        scales: standard deviations > 0, world units.
        opacities: in [0, 1].
        sh_dc: degree-0 spherical-harmonic coefficients.
        voxel: edge length of the token grid's cells, world units; a tensor in an exported graph, where it is an input.
        attributes: the attributes to embed; their channels are concatenated in this order.
    """
    channels: list[Tensor] = []
    log_scales = torch.log(scales.double() / voxel).clamp(-MAX_ABS_LOG_SCALE, MAX_ABS_LOG_SCALE).to(means.dtype)
    for name in attributes:
        if name == "offset":
            scaled = means.double() / voxel
            channels.append((2 * (scaled - torch.floor(scaled)) - 1).to(means.dtype))
        elif name == "color":
            channels.append((2 * SH_C0 * sh_dc).clamp(-2, 2))
        elif name == "opacity":
            channels.append(2 * opacities.unsqueeze(1) - 1)
        elif name == "scale":
            channels.append(log_scales.sort(dim=1, descending=True).values / 4)
        else:
            channels.append(_symmetric_matrix(quats, log_scales - log_scales.mean(dim=1, keepdim=True)) / 4)
    return torch.cat(channels, dim=1)


def _symmetric_matrix(quats: Float[Tensor, "N 4"], eigenvalues: Float[Tensor, "N 3"]) -> Float[Tensor, "N 6"]:
    """The entries xx, yy, zz, √2·xy, √2·xz, √2·yz of R diag(eigenvalues) Rᵀ."""
    rotation = rotmats_from_quats(quats)
    x, y, z = rotation.unbind(dim=1)
    root = math.sqrt(2)
    entries = (x * x, y * y, z * z, root * x * y, root * x * z, root * y * z)
    return torch.stack([(entry * eigenvalues).sum(dim=1) for entry in entries], dim=1)
