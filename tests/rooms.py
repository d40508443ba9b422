"""A room of Gaussians with a cube in it, that tests of views stand on."""

import numpy as np
from splats import gaussians_at

from gsencoder.data.orbits import looking_cameras
from gsencoder.types import Cameras, Gaussians, Scene, Views

UP = np.array([0.0, 0.0, 1.0])
HALF, HEIGHT, STEP = 2.0, 2.5, 0.06
CUBE = 0.15


def sheet(
    center: tuple[float, float, float], across: tuple[int, int], half: tuple[float, float], step: float = STEP
) -> np.ndarray:
    """Points of a rectangle along two axes."""
    a, b = (np.arange(-size, size + step / 2, step) for size in half)
    points = np.tile(np.asarray(center, np.float64), (len(a) * len(b), 1))
    u, v = np.meshgrid(a, b)
    points[:, across[0]] += u.ravel()
    points[:, across[1]] += v.ravel()
    return points


def splat(means: np.ndarray, scale: float | np.ndarray = 0.6 * STEP) -> Gaussians:
    return gaussians_at(means, np.reshape(scale, (-1, 1)), 0.99, seed=0)


def merged(*parts: Gaussians) -> Gaussians:
    names = ("means", "quats", "scales", "opacities", "sh")
    return Gaussians(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


def cube(center: tuple[float, float, float], half: float = CUBE, step: float = 0.03) -> np.ndarray:
    """Points of the surface of a cube."""
    faces = []
    for axis in range(3):
        others = tuple(other for other in range(3) if other != axis)
        for side in (-half, half):
            middle = list(center)
            middle[axis] += side
            faces.append(sheet(tuple(middle), (others[0], others[1]), (half, half), step))  # type: ignore[arg-type]
    return np.concatenate(faces)


def walls(step: float = STEP) -> np.ndarray:
    """Four walls, a floor at z = 0 and a ceiling."""
    middle = HEIGHT / 2
    parts = [sheet((0, 0, z), (0, 1), (HALF, HALF), step) for z in (0.0, HEIGHT)]
    parts += [sheet((x, 0, middle), (1, 2), (HALF, middle), step) for x in (-HALF, HALF)]
    parts += [sheet((0, y, middle), (0, 2), (HALF, middle), step) for y in (-HALF, HALF)]
    return np.concatenate(parts)


def corner_cameras(count: int = 12, width: int = 64, height: int = 48) -> Cameras:
    """Cameras on a circle below the ceiling, that look at the middle of the room."""
    turns = 2 * np.pi * np.arange(count) / count
    centers = np.stack([1.7 * np.cos(turns), 1.7 * np.sin(turns), np.full(count, 1.6)], axis=1)
    forward = np.array([0, 0, 0.8]) - centers
    return looking_cameras(
        centers, forward / np.linalg.norm(forward, axis=1, keepdims=True), UP, 0.6 * width, width, height
    )


def room(
    *others: np.ndarray, center: tuple[float, float, float] = (0.3, 0.2, 0.8), step: float = STEP
) -> tuple[Scene, np.ndarray]:
    """The scene, and the rows of its cube; `others` are more points in the room, and `step` is between those of the
    walls."""
    target, around = cube(center), walls(step)
    means = np.concatenate([target, around, *others])
    cameras = corner_cameras()
    scales = np.full(len(means), 0.6 * STEP)
    scales[: len(target)] = 0.018
    scales[len(target) : len(target) + len(around)] = 0.6 * step
    views = Views(cameras=cameras, names=tuple(f"frame {number:02d}" for number in range(len(cameras))))
    scene = Scene(name="room", gaussians=splat(means, scales), views=views, up=UP, metres_per_unit=1.0)
    return scene, np.arange(len(target))
