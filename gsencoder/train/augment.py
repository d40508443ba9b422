"""Random augmentation of splats: rotation, mirroring, scaling, jitter of the centers, and changes of color."""

import math
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float32, Float64
from scipy.spatial.transform import Rotation

from gsencoder.core.errors import InputError
from gsencoder.geometry import sh_basis
from gsencoder.types import SH_C0, Gaussians
from gsencoder.types.checks import perpendicular

_DIRECTIONS = 64
"""Directions over which harmonics are turned: more than enough for the 16 coefficients of degree 3."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AugmentConfig:
    """Strengths of the random changes to a training sample; 0 = none."""

    turn: float = field(
        default=180.0, metadata={"help": "largest rotation about the up axis in either direction, degrees"}
    )
    tilt: float = field(default=3.0, metadata={"help": "standard deviation of the tilt of the up axis, degrees"})
    mirror: float = field(default=0.5, metadata={"help": "probability of mirroring"})
    scale: float = field(default=0.1, metadata={"help": "largest relative change of size"})
    jitter: float = field(default=0.1, metadata={"help": "standard deviation of the shift of each center, voxels"})
    drop: float = field(default=0.2, metadata={"help": "largest share of Gaussians that is dropped at random"})
    light: float = field(default=0.2, metadata={"help": "largest relative change of brightness"})
    tint: float = field(
        default=0.08, metadata={"help": "largest relative change of each color channel, and largest shift of black"}
    )
    noise: float = field(
        default=0.02, metadata={"help": "standard deviation of the noise added to each Gaussian's color; white = 1"}
    )

    def __post_init__(self) -> None:
        for name in ("turn", "tilt", "jitter", "noise"):
            if not 0 <= getattr(self, name) < math.inf:
                raise InputError(f"{name}: expected 0 or more, got {getattr(self, name)}")
        for name in ("turn", "tilt"):
            if getattr(self, name) > 360:
                raise InputError(f"{name}: expected at most 360 degrees, got {getattr(self, name)}")
        for name in ("mirror", "drop", "scale", "light", "tint"):
            if not 0 <= getattr(self, name) <= (1 if name == "mirror" else 0.9):
                limit = 1 if name == "mirror" else 0.9
                raise InputError(f"{name}: expected a number from 0 to {limit}, got {getattr(self, name)}")


def augment(
    gaussians: Gaussians,
    rng: np.random.Generator,
    config: AugmentConfig,
    *,
    voxel: float,
    up: Float64[np.ndarray, "3"] | None = None,
) -> Gaussians:
    """Applies random changes to a splat; row i of the result is Gaussian i.

    Args:
        gaussians: the splat, world units.
        rng: source of all random numbers.
        config: strengths of the changes; `drop` is applied by `samples.make_sample`, since it removes rows.
        voxel: unit of `jitter`, world units.
        up: axis of `turn`, a unit vector; None = the z axis of the world.
    """
    axis = np.array([0.0, 0.0, 1.0]) if up is None else up / np.linalg.norm(up)
    rotation = Rotation.from_rotvec(axis * math.radians(rng.uniform(-config.turn, config.turn)))
    horizontal = Rotation.from_rotvec(axis * rng.uniform(0, 2 * math.pi)).apply(perpendicular(axis))
    rotation = Rotation.from_rotvec(horizontal * math.radians(rng.normal(0, config.tilt))) * rotation
    to_from = rotation.as_matrix()
    if rng.random() < config.mirror:
        to_from = to_from @ (np.eye(3) - 2 * np.outer(horizontal, horizontal))
    turned = turn(gaussians, to_from, float(rng.uniform(1 - config.scale, 1 + config.scale)))
    shift = rng.uniform(0, voxel, 3) + rng.normal(0, config.jitter * voxel, turned.means.shape)
    return replace(
        turned,
        means=(turned.means + shift).astype(np.float32),
        sh=_relight(turned.sh, rng, config),
    )


def turn(gaussians: Gaussians, to_from: Float64[np.ndarray, "3 3"], scale: float = 1.0) -> Gaussians:
    """The splat after x → scale · to_from · x: means, quats, scales and harmonics together.

    Args:
        gaussians: world units.
        to_from: a rotation, or a rotation with a mirror: any orthonormal matrix.
        scale: > 0.

    Raises:
        InputError: not orthonormal, or a scale that is not positive.
    """
    if np.abs(to_from @ to_from.T - np.eye(3)).max() > 1e-6 or not 0 < scale < math.inf:
        raise InputError("turn: expected an orthonormal matrix and a positive scale")
    mirrored = np.linalg.det(to_from) < 0
    # A Gaussian looks the same mirrored through its center, so −M turns its axes as M does, and is a rotation.
    rotation = Rotation.from_matrix(-to_from if mirrored else to_from)
    # A product of quaternions is linear in each: those with 1, i, j and k make its matrix. For many Gaussians that is
    # ten times faster than scipy's product with each.
    units = Rotation.from_quat(np.eye(4), scalar_first=True)
    quats = gaussians.quats @ (rotation * units).as_quat(scalar_first=True)
    return Gaussians(
        means=(gaussians.means.astype(np.float64) @ (scale * to_from.T)).astype(np.float32),
        quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        scales=(gaussians.scales * np.float32(scale)).astype(np.float32),
        opacities=gaussians.opacities,
        sh=_turn_sh(gaussians.sh, to_from),
    )


def _turn_sh(sh: Float32[np.ndarray, "N K 3"], to_from: np.ndarray) -> Float32[np.ndarray, "N K 3"]:
    """Coefficients of the turned function, f'(d) = f(to_fromᵀ d), from its values in many directions: exact, since a
    turned harmonic is a sum of harmonics of its degree."""
    degree = math.isqrt(sh.shape[1]) - 1
    if degree == 0:
        return sh
    i = np.arange(_DIRECTIONS) + 0.5
    z, azimuth = 1 - 2 * i / _DIRECTIONS, i * math.pi * (1 + 5**0.5)
    radius = np.sqrt(1 - z * z)
    directions = np.stack((radius * np.cos(azimuth), radius * np.sin(azimuth), z), axis=1)
    basis = sh_basis(torch.from_numpy(directions), degree).numpy()
    unturned_basis = sh_basis(torch.from_numpy(directions @ to_from), degree).numpy()
    matrix = np.linalg.lstsq(basis, unturned_basis, rcond=None)[0]
    return np.einsum("kj,njc->nkc", matrix, sh).astype(np.float32)


def _relight(
    sh: Float32[np.ndarray, "N K 3"], rng: np.random.Generator, config: AugmentConfig
) -> Float32[np.ndarray, "N K 3"]:
    """Changes brightness and tint and adds noise; colors are ½ + SH_C0·dc, and all degrees are scaled equally."""
    gain = rng.uniform(1 - config.light, 1 + config.light) * rng.uniform(1 - config.tint, 1 + config.tint, 3)
    relit = sh * gain
    black_shift = 0.5 * gain - 0.5 + rng.uniform(-config.tint, config.tint)
    relit[:, 0] += (black_shift + rng.normal(0, config.noise, (len(sh), 3))) / SH_C0
    return relit.astype(np.float32)
