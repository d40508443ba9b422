"""Cameras around a bare splat, for splats that come without views."""

import math
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64

from gsencoder.core.errors import InputError
from gsencoder.types import Cameras, Gaussians
from gsencoder.types.scene import intrinsic_matrix, look_at, perpendicular

CamerasOfSplat = Literal["auto", "around", "inside"]
"""Where cameras of a splat without views stand; "auto" = inside a room (`gsencoder.fusion.cameras`)."""
COVERED = 0.95  # Opacity-weighted share of the Gaussians that must fit into the picture
MAX_COVERED = 3.0
"""Largest radius that must fit, in opacity-weighted median distances from the center; farther Gaussians are floaters.
"""
MARGIN = 1.1
MIN_DISTANCE = 0.05  # Smallest distance of cameras from the center, since renderers clip everything nearer than 0.01
GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


def orbit_cameras(
    gaussians: Gaussians,
    *,
    count: int = 24,
    width: int = 640,
    height: int = 480,
    fov_degrees: float = 60.0,
    up: Float64[np.ndarray, "3"] | None = None,
) -> Cameras:
    """Cameras on a sphere around a splat, looking at its center.

    The center is the opacity-weighted median of the means, coordinate by coordinate, and the radius 1.1 times the
    opacity-weighted 95 % quantile of the distance from it, at most 3.3 times its median, so that floaters change
    neither much (and at least 3 median standard deviations, for a single Gaussian). The distance is the one at which a
    ball of that radius fits into the smaller field of view. Directions follow a golden-angle spiral.

    Args:
        up: if known, cameras are between 15° below and 60° above the horizon. If None, cameras surround the splat on
            all sides, and -y is upward in the pictures, as in COLMAP's worlds.
    """
    if not len(gaussians):
        raise InputError("orbit cameras need at least one Gaussian, got none")
    center, radius = robust_ball(gaussians)
    focal = width / (2 * math.tan(math.radians(fov_degrees) / 2))
    half_field = math.atan(min(width, height) / 2 / focal)
    distance = max(radius / math.sin(half_field), MIN_DISTANCE)
    outward, vertical = spiral_directions(count, up)
    return looking_cameras(center + distance * outward, -outward, vertical, focal, width, height)


def spiral_directions(
    count: int, up: Float64[np.ndarray, "3"] | None, elevations: tuple[float, float] = (-15.0, 60.0)
) -> tuple[Float64[np.ndarray, "V 3"], Float64[np.ndarray, "3"]]:
    """Unit vectors from the center to the cameras, evenly spread, and the vertical.

    Args:
        up: if known, they are between two elevations; else they cover all directions except the poles of -y.
        elevations: lowest and highest angle above the horizon, degrees.
    """
    vertical = np.array([0.0, -1.0, 0.0]) if up is None else np.asarray(up, np.float64)
    vertical = vertical / np.linalg.norm(vertical)
    # Equal steps of the sine of the elevation sample the sphere evenly.
    low, high = (-0.9, 0.9) if up is None else (math.sin(math.radians(degrees)) for degrees in elevations)
    steps = (np.arange(count) + 0.5) / count
    sines, turns = low + (high - low) * steps, GOLDEN_ANGLE * np.arange(count)
    east = perpendicular(vertical)
    north = np.cross(vertical, east)
    level = np.sqrt(1 - sines**2)[:, None] * (np.cos(turns)[:, None] * east + np.sin(turns)[:, None] * north)
    return level + sines[:, None] * vertical, vertical


def looking_cameras(
    centers: Float64[np.ndarray, "V 3"],
    forward: Float64[np.ndarray, "V 3"],
    up: Float64[np.ndarray, "3"],
    focal: float,
    width: int,
    height: int,
) -> Cameras:
    """Cameras at `centers` that look along unit vectors, level with `up`, which must not be parallel to any of them.

    All have the same focal length and size in pixels; the principal point is the center of the image.
    """
    count = len(centers)
    K = intrinsic_matrix(focal, focal, width / 2, height / 2).astype(np.float32)
    return Cameras(
        cam_from_world=look_at(centers, forward, up).astype(np.float32),
        Ks=np.tile(K, (count, 1, 1)),
        widths=np.full(count, width, np.int32),
        heights=np.full(count, height, np.int32),
    )


def robust_ball(gaussians: Gaussians) -> tuple[Float64[np.ndarray, "3"], float]:
    """The opacity-weighted median center, and the radius that `orbit_cameras` fits into its pictures."""
    means = gaussians.means.astype(np.float64)
    weights = gaussians.opacities.astype(np.float64)
    if not weights.sum() > 0:
        weights = np.ones(len(means))
    weighted: Any = {"weights": weights, "method": "inverted_cdf"}
    center = np.quantile(means, 0.5, axis=0, **weighted)
    middle, far = np.quantile(np.linalg.norm(means - center, axis=1), (0.5, COVERED), **weighted)
    size = np.quantile(gaussians.scales.max(axis=1).astype(np.float64), 0.5, **weighted)
    return center, float(max(MARGIN * min(far, MAX_COVERED * middle), 3 * size))
