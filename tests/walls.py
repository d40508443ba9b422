"""A textured wall, what cameras see of it, and optimizations on it, that tests of reconstruction stand on."""

from typing import Any

import numpy as np

from gsencoder.data.photographs import Photographs
from gsencoder.data.seeding.depth import seed_from_depth
from gsencoder.reconstruct.optimize import OptimizeConfig, Optimizer, PruneConfig, RowAdam, parameters_from
from gsencoder.types import Cameras, Gaussians, Views

DEPTH, TILT = 3.0, 0.3
"""The wall is z = DEPTH + TILT·x in the world of the first camera."""


def texture(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """RGB in [0, 1] at places of the wall: smooth blotches of several sizes."""
    made = np.random.default_rng(0)
    total = np.zeros((*x.shape, 3))
    for _ in range(24):
        direction, phase = made.normal(size=2) * 12, made.uniform(0, 6.3, 3)
        total += np.sin(direction[0] * x + direction[1] * y)[..., None] * np.cos(phase)
    return 0.5 + 0.5 * np.tanh(total / 4)


def cameras(count: int = 4, width: int = 96, height: int = 72, step: float = 0.15) -> Cameras:
    """Side by side, all looking along +z."""
    poses = np.tile(np.eye(4, dtype=np.float32), (count, 1, 1))
    poses[:, 0, 3] = -step * np.arange(count)
    K = np.array([[80, 0, width / 2], [0, 80, height / 2], [0, 0, 1]], np.float32)
    sizes = (np.full(count, width, np.int32), np.full(count, height, np.int32))
    return Cameras(cam_from_world=poses, Ks=np.tile(K, (count, 1, 1)), widths=sizes[0], heights=sizes[1])


def seen(made: Cameras, view: int) -> tuple[np.ndarray, np.ndarray]:
    """Photograph uint8 [H, W, 3] and depth float32 [H, W] of a view."""
    K, center = made.Ks[view], made.centers[view]
    v, u = np.mgrid[: made.heights[view], : made.widths[view]] + 0.5
    dx, dy = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]
    depth = (DEPTH + TILT * center[0]) / (1 - TILT * dx)
    colors = texture(center[0] + depth * dx, depth * dy)
    return (255 * colors + 0.5).astype(np.uint8), depth.astype(np.float32)


def wall_views(count: int = 4, *, depth: bool = False) -> Views:
    made = cameras(count)
    pairs = [seen(made, view) for view in range(count)]
    names = tuple(f"view_{view}.png" for view in range(count))
    depths = [pair[1] for pair in pairs] if depth else None
    return Views(cameras=made, names=names, images=[pair[0] for pair in pairs], depths=depths)


def wall_points(count: int = 40) -> np.ndarray:
    """Points on the wall, as structure from motion would find some."""
    made = np.random.default_rng(1)
    x, y = made.uniform(-2.2, 3.2, count), made.uniform(-1.8, 1.8, count)
    return np.stack([x, y, DEPTH + TILT * x], axis=1).astype(np.float32)


NEVER = PruneConfig(at=())


def wall_optimizer(
    config: OptimizeConfig,
    start: Gaussians | float = 0.1,
    views: Views | None = None,
    training: tuple[int, ...] = (0, 1, 3),
    **options: Any,
) -> Optimizer:
    """An optimization before its first step; `start` is a splat, or the voxels of seeds on the wall."""
    gaussians = seed_from_depth(wall_views(depth=True), voxel=start) if isinstance(start, float) else start
    photographs = Photographs(views or wall_views(depth=True))
    adam = RowAdam(parameters_from(gaussians, config.sh_degree))
    return Optimizer(adam, photographs, training, config, **{"prune": NEVER, **options})
