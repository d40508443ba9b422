"""Small random splats and cameras that several test files stand on."""

from typing import Any

import numpy as np

from gsencoder.render import Blend
from gsencoder.types import Cameras, Gaussians


def random_gaussians(
    n: int = 300,
    seed: int = 0,
    *,
    center: tuple[float, float, float] = (0, 0, 3),
    log_scale: float = -2.5,
    degree: int = 0,
) -> Gaussians:
    """A ball of Gaussians in front of `front_camera`."""
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(n, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    return Gaussians(
        means=(rng.normal(size=(n, 3)) * (1, 1, 0.7) + center).astype(np.float32),
        quats=quats.astype(np.float32),
        scales=np.exp(rng.normal(size=(n, 3)) * 0.7 + log_scale).astype(np.float32),
        opacities=rng.uniform(size=n).astype(np.float32),
        sh=rng.normal(size=(n, (degree + 1) ** 2, 3)).astype(np.float32),
    )


def gaussians_at(means: np.ndarray, scales: Any = 0.01, opacities: Any = 1.0, *, seed: int | None = None) -> Gaussians:
    """Gaussians that are not turned, grey or (`seed`) of random colors."""
    n = len(means)
    sh = np.zeros((n, 1, 3)) if seed is None else np.random.default_rng(seed).normal(size=(n, 1, 3))
    return Gaussians(
        means=means.astype(np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
        scales=np.broadcast_to(np.asarray(scales, np.float32), (n, 3)).copy(),
        opacities=np.broadcast_to(np.asarray(opacities, np.float32), (n,)).copy(),
        sh=sh.astype(np.float32),
    )


def one_gaussian(
    mean: tuple[float, float, float] = (0, 0, 2), scale: float | tuple[float, float, float] = 0.1, opacity: float = 0.8
) -> Gaussians:
    return gaussians_at(np.array([mean]), scale, opacity)


def front_camera(width: int = 61, height: int = 43, focal: float = 50.0) -> Cameras:
    """One camera at the world's origin that looks along +z."""
    return Cameras(
        cam_from_world=np.eye(4, dtype=np.float32)[None],
        Ks=np.array([[[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]], np.float32),
        widths=np.array([width], np.int32),
        heights=np.array([height], np.int32),
    )


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    """A rotation matrix, uniform."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q


def random_cameras(count: int = 20, seed: int = 0, *, spread: float = 3.0) -> Cameras:
    """Cameras that look anywhere from centers `spread` around the origin, each of another size and field of view."""
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = [random_rotation(rng) for _ in range(count)]
    poses[:, :3, 3] = spread * rng.normal(size=(count, 3))
    sizes = rng.integers(40, 2000, (count, 2)).astype(np.int32)
    Ks = np.tile(np.eye(3), (count, 1, 1))
    Ks[:, [0, 1], [0, 1]] = sizes * rng.uniform(0.3, 3.0, (count, 2))
    Ks[:, :2, 2] = sizes * rng.uniform(0.2, 0.8, (count, 2))
    return Cameras(
        cam_from_world=poses.astype(np.float32), Ks=Ks.astype(np.float32), widths=sizes[:, 0].copy(),
        heights=sizes[:, 1].copy(),
    )  # fmt: skip


def dense(b: Blend) -> np.ndarray:
    out = np.zeros((b.rows, b.gaussians))
    row = np.repeat(np.arange(b.rows), b.crow.diff().numpy())
    out[row, b.col.numpy()] = b.weight.numpy()
    return out


EXTREMES = {
    "an empty view": random_gaussians(50, 0, center=(0, 0, -30)),
    "no Gaussians": random_gaussians(0),
    "one Gaussian": one_gaussian(),
    "scales of 1e-9": one_gaussian(scale=1e-9),
    "scales of 1e4": one_gaussian(scale=1e4),
    "opacity 0": one_gaussian(opacity=0.0),
    "opacity 1": one_gaussian(opacity=1.0),
    "on the camera": one_gaussian((0, 0, 0)),
    "at the near plane": one_gaussian((0, 0, 0.01001), scale=1.0),
    "a needle": one_gaussian((0.2, 0.1, 2), (1.0, 1e-6, 1e-6)),
    "a disc edge-on": one_gaussian((0.0, 0.0, 2), (1.0, 1e-6, 1.0)),
    "far away": one_gaussian((0, 0, 1e6), scale=1e4),
}
