"""Gaussian attributes as input channels: what does not change when the scene is moved, and no sign or order that the
file happened to choose.

A rotation is given as a quaternion and an order of axes, and the same ellipsoid has 48 such descriptions; a network
would have to learn that they are one. The logarithm of the covariance has one value for each ellipsoid, is linear in
log-scales, and stays within a few units where scales run from 1e-9 to 1e4. `rotation` is the part of it that has a
direction; `scale` the sorted log-scales themselves, so that either can be left out.
"""

import math
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from gsencoder.geometry import rotmats_from_quats
from gsencoder.types import SH_C0

Attribute = Literal["offset", "color", "opacity", "scale", "rotation"]

CHANNELS: dict[Attribute, int] = {"offset": 3, "color": 3, "opacity": 1, "scale": 3, "rotation": 6}

LOG_LIMIT = 12.0
"""Log-scales, counted from the voxel's edge, are cut off here: e^±12 voxels is dust or a continent."""


def channels_of(attributes: tuple[Attribute, ...]) -> int:
    """How many channels the chosen attributes have."""
    return sum(CHANNELS[name] for name in attributes)


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
    """Input channels, each of order one.

    offset: where in its voxel the center lies, −1 to 1. color: the degree-0 color, black −1, white 1, clipped at ±2.
    opacity: −1 to 1. scale: log standard deviations over the voxel's edge, largest first, a quarter of them. rotation:
    the six entries of R diag(log s − mean log s) Rᵀ, a quarter of them, the off-diagonal ones times √2, so that a
    distance between inputs is one between matrices.

    Args:
        means: world units.
        quats: wxyz; normalized here.
        scales: standard deviations > 0, world units.
        opacities: in [0, 1].
        sh_dc: degree-0 spherical-harmonic coefficients.
        voxel: edge of the token grid, world units; a tensor where it is known only when an exported graph runs.
        attributes: which of them, in this order.
    """
    parts: list[Tensor] = []
    logs = torch.log(scales.double() / voxel).clamp(-LOG_LIMIT, LOG_LIMIT).to(means.dtype)
    for name in attributes:
        if name == "offset":
            place = means.double() / voxel
            parts.append((2 * (place - torch.floor(place)) - 1).to(means.dtype))
        elif name == "color":
            parts.append((2 * SH_C0 * sh_dc).clamp(-2, 2))
        elif name == "opacity":
            parts.append(2 * opacities.unsqueeze(1) - 1)
        elif name == "scale":
            parts.append(logs.sort(dim=1, descending=True).values / 4)
        else:
            parts.append(_direction(quats, logs - logs.mean(dim=1, keepdim=True)) / 4)
    return torch.cat(parts, dim=1)


def _direction(quats: Float[Tensor, "N 4"], logs: Float[Tensor, "N 3"]) -> Float[Tensor, "N 6"]:
    """xx, yy, zz, √2·xy, √2·xz, √2·yz of R diag(logs) Rᵀ."""
    rotation = rotmats_from_quats(quats)
    x, y, z = rotation.unbind(dim=1)
    root = math.sqrt(2)
    rows = (x * x, y * y, z * z, root * x * y, root * x * z, root * y * z)
    return torch.stack([(row * logs).sum(dim=1) for row in rows], dim=1)
