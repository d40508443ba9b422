"""Which way is up in a scene whose files do not say: from its cameras, and from its surfaces, most of which stand or
lie.

In rooms, floors, tables and ceilings have normals parallel to up, and walls and furniture perpendicular to it (a
Manhattan world, Coughlan and Yuille 1999). People hold cameras level: their right axes are horizontal, and their own
up directions say which end of the axis is up. Of a bare splat that end is the one from which the largest flat surface
at an end of the scene is seen, since things stand on floors.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

from gsencoder.core.errors import InputError
from gsencoder.types import Cameras, Gaussians

MAX_SAMPLES = 20_000
"""So many Gaussians are looked at."""
ALIGNED = np.deg2rad(6.0)
"""Width of the bell by which normals count as parallel or perpendicular."""
STANDING_WEIGHT = 0.5
"""A wall says less about up than a floor: it is perpendicular to many directions."""
MAX_TILT = np.deg2rad(40.0)
"""Up lies within this angle of what the cameras say."""
DIRECTIONS = 4000
"""Candidates on the sphere, about 3° apart."""
REFINEMENTS = 10
FLAT = 0.5
"""Gaussians whose thinnest axis is above this share of the middle one have no normal."""
FLOOR_THICKNESS = 0.01
"""Thickness of the slices in which floors are sought, as a share of the scene's extent along up."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Up:
    """An estimated direction.

    Attributes:
        direction: unit vector in the world.
        confidence: from 0 to 1: the share of the surfaces that lie or stand under it, above what a random direction
            would have, times the agreement of the cameras where there are any.
        from_cameras: angle in radians between it and what the cameras say; None without cameras.
    """

    direction: Float64[np.ndarray, "3"]
    confidence: float
    from_cameras: float | None


def up_of_cameras(cameras: Cameras) -> Float64[np.ndarray, "3"]:
    """The direction that is most nearly perpendicular to all right axes, on the side of the cameras' own up axes.

    If all right axes are nearly parallel, as of a camera that moves ahead, it is the mean of the up axes.
    """
    right = cameras.cam_from_world[:, 0, :3].astype(np.float64)
    mean_up = -cameras.cam_from_world[:, 1, :3].astype(np.float64).mean(axis=0)
    values, vectors = np.linalg.eigh(right.T @ right / len(right))
    axis = vectors[:, 0]
    if values[1] < 0.02 or abs(axis @ mean_up) < 0.3:
        axis = mean_up if np.linalg.norm(mean_up) > 1e-6 else vectors[:, 0]
    axis = axis / np.linalg.norm(axis)
    return axis if axis @ mean_up >= 0 else -axis


def surface_normals(
    gaussians: Gaussians, *, seed: int = 0
) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"], Float64[np.ndarray, " n"]]:
    """Positions, normals and areas (times opacity) of a random choice of the flat Gaussians."""
    from scipy.spatial.transform import Rotation

    rows = np.random.default_rng(seed).permutation(len(gaussians))[: 4 * MAX_SAMPLES]
    scales = gaussians.scales[rows].astype(np.float64)
    order = np.argsort(scales, axis=1)
    ordered = np.take_along_axis(scales, order, axis=1)
    flat = ordered[:, 0] <= FLAT * ordered[:, 1]
    rows, order, ordered = (array[flat][:MAX_SAMPLES] for array in (rows, order, ordered))
    quats = gaussians.quats[rows].astype(np.float64)
    matrices = Rotation.from_quat(np.roll(quats, -1, axis=1)).as_matrix() if len(rows) else np.empty((0, 3, 3))
    normals = np.take_along_axis(matrices, order[:, None, :1], axis=2)[..., 0]
    areas = ordered[:, 1] * ordered[:, 2] * gaussians.opacities[rows].astype(np.float64)
    # A few huge Gaussians, such as a sky's, must not outvote the scene.
    areas = np.minimum(areas, np.quantile(areas, 0.95)) if len(areas) else areas
    return gaussians.means[rows].astype(np.float64), normals, areas


def estimate_up(gaussians: Gaussians, cameras: Cameras | None = None, *, seed: int = 0) -> Up:
    """Up of a scene from its surfaces and, where there are any, its cameras.

    Args:
        gaussians: a splat or seeds, with normals where surfaces are flat.
        cameras: of the photographs; None for a bare splat.
        seed: of the choice of Gaussians.

    Raises:
        InputError: neither cameras nor flat Gaussians.
    """
    means, normals, areas = surface_normals(gaussians, seed=seed)
    prior = None if cameras is None or not len(cameras) else up_of_cameras(cameras)
    if areas.sum() <= 0:
        if prior is None:
            raise InputError("up: the splat has no flat Gaussians, and there are no cameras; give up=")
        return Up(direction=prior, confidence=0.0, from_cameras=0.0)
    areas = areas / areas.sum()
    candidates = _sphere(DIRECTIONS)
    if prior is not None:
        candidates = np.concatenate((prior[None], candidates[candidates @ prior >= np.cos(MAX_TILT)]))
    scores = _support(candidates, normals, areas)
    best = _refine(candidates[scores.argmax()], normals, areas)
    if prior is not None and best @ prior < np.cos(MAX_TILT):
        best = prior
    if prior is None:
        best = _upright_axis(best, means, normals, areas)
    elif best @ prior < 0:
        best = -best
    typical = float(np.median(_support(_sphere(200), normals, areas)))
    support = float(_support(best[None], normals, areas)[0])
    confidence = float(np.clip((support - typical) / (1 - typical), 0, 1))
    angle = None if prior is None else float(np.arccos(np.clip(best @ prior, -1, 1)))
    return Up(direction=best, confidence=confidence, from_cameras=angle)


def _sphere(count: int) -> Float64[np.ndarray, "n 3"]:
    """Directions spread evenly over the sphere (Fibonacci spiral)."""
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    turn = np.pi * (1 + 5**0.5) * index
    radius = np.sqrt(1 - z * z)
    return np.stack((radius * np.cos(turn), radius * np.sin(turn), z), axis=1)


def _bells(cosine: Float[np.ndarray, "*n"]) -> tuple[Float[np.ndarray, "*n"], Float[np.ndarray, "*n"]]:
    """How far normals at these cosines lie (parallel to up) and stand (perpendicular), each from 0 to 1."""
    angle = np.arccos(np.minimum(np.abs(cosine), 1))
    return np.exp(-np.square(angle / ALIGNED)), np.exp(-np.square((np.pi / 2 - angle) / ALIGNED))


def _support(
    directions: Float64[np.ndarray, "d 3"], normals: Float64[np.ndarray, "n 3"], areas: Float64[np.ndarray, " n"]
) -> Float64[np.ndarray, " d"]:
    """The share of the surfaces that lie, and half of that which stands, for each direction."""
    support = []
    for block in np.array_split(directions, max(1, len(directions) // 256)):
        lying, standing = _bells((block @ normals.T).astype(np.float32))
        support.append((lying + STANDING_WEIGHT * standing) @ areas)
    return np.concatenate(support)


def _refine(
    direction: Float64[np.ndarray, "3"], normals: Float64[np.ndarray, "n 3"], areas: Float64[np.ndarray, " n"]
) -> Float64[np.ndarray, "3"]:
    """The direction that normals near it and normals across it agree on, by reweighted least squares."""
    for _ in range(REFINEMENTS):
        lying, standing = _bells(normals @ direction)
        lie, stand = lying * areas, STANDING_WEIGHT * standing * areas
        # Σ w |n × d|² + Σ w (n · d)² is smallest for the eigenvector of the smallest eigenvalue.
        outer = np.einsum("n,ni,nj->ij", stand - lie, normals, normals) + lie.sum() * np.eye(3)
        nearest = np.linalg.eigh(outer)[1][:, 0]
        direction = nearest if nearest @ direction >= 0 else -nearest
    return direction


def _upright_axis(
    direction: Float64[np.ndarray, "3"],
    means: Float64[np.ndarray, "n 3"],
    normals: Float64[np.ndarray, "n 3"],
    areas: Float64[np.ndarray, " n"],
) -> Float64[np.ndarray, "3"]:
    """Of the three axes of a Manhattan world and their opposites, the one with the largest floor."""
    across = np.linalg.svd(direction[None])[2][1:]
    turns = np.deg2rad(np.arange(0, 90, 3.0))
    circle = np.cos(turns)[:, None] * across[0] + np.sin(turns)[:, None] * across[1]
    second = _refine(circle[_support(circle, normals, areas).argmax()], normals, areas)
    third = np.cross(direction, second)
    axes = [sign * axis for axis in (direction, second, third / np.linalg.norm(third)) for sign in (1.0, -1.0)]
    return max(axes, key=lambda axis: _floor_area(axis, means, normals, areas))


def _floor_area(
    up: Float64[np.ndarray, "3"],
    means: Float64[np.ndarray, "n 3"],
    normals: Float64[np.ndarray, "n 3"],
    areas: Float64[np.ndarray, " n"],
) -> float:
    """The area that lies in the fullest slice of the lowest fifth of the scene, less that in its highest fifth / 2.

    Ceilings are as large as floors where they were photographed; they mostly were not.
    """
    heights = means @ up
    low, high = np.quantile(heights, (0.01, 0.99))
    if high <= low:
        return 0.0
    lying = _bells(normals @ up)[0] * areas
    slices = ((heights - low) / (high - low) / FLOOR_THICKNESS).astype(np.int64)
    count = round(1 / FLOOR_THICKNESS)
    area = np.bincount(slices.clip(0, count), lying, count + 1)
    fifth = count // 5
    return float(area[:fifth].max() - 0.5 * area[-fifth:].max())
