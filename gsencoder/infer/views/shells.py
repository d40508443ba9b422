"""Candidate cameras on shells around a target."""

import math

import numpy as np
from jaxtyping import Float64

from gsencoder.core.arrays import even_indices
from gsencoder.data.orbits import looking_cameras, spiral_directions
from gsencoder.infer.views.constants import CONSTANTS
from gsencoder.infer.views.free_space import FreeSpace
from gsencoder.infer.views.targets import Target
from gsencoder.types import Cameras, Gaussians, Scene
from gsencoder.types.checks import look_rotation


def shell_cameras(
    gaussians: Gaussians,
    target: Target,
    count: int,
    free: FreeSpace,
    *,
    up: Float64[np.ndarray, "3"] | None = None,
    width: int = 640,
    height: int = 480,
    fov_degrees: float = 60.0,
    between: tuple[float, float] = (0.0, 1.0),
) -> Cameras:
    """Cameras around a target from which nothing stands between: SplatDistill sec. 3.4, "viewpoints around".

    Directions lie on a spiral. Along each the distance is the one at which the target's outline fills a share of the
    picture, its frame permitting, or nearer where a surface would stand between. Directions are left out from which
    the camera would be too near to a surface, where no known camera has looked, or so near that little else is seen.
    Of those that remain the ones are kept with most of the scene behind and around the target, evenly spread.

    Args:
        gaussians: the splat.
        target: what is looked at.
        count: at most so many.
        free: where a camera can stand.
        up: of the world, where known.
        width: of the pictures, pixels.
        height: of the pictures, pixels.
        fov_degrees: horizontal field of view.
        between: shares of the picture that the target is to fill at least, and at most.

    Returns:
        Cameras relative to the scene's origin; none where there is no room.
    """
    focal = width / (2 * math.tan(math.radians(fov_degrees) / 2))
    outward, vertical = spiral_directions(max(CONSTANTS.tried_directions * count, CONSTANTS.min_tried_directions), up)
    preferred, least, reach = _distances(gaussians, target, outward, vertical, focal, width, height, between)
    # Up to the first surface beyond the target itself and the cells of what it lies on, with room to stand before it.
    begins = reach + 2 * free.cell
    starts = target.center + begins[:, None] * outward
    clearance = CONSTANTS.clearance_share
    open_until = begins + free.first_hit(starts, outward, np.maximum(preferred * (1 + clearance) - begins, 0))
    distance = np.minimum(preferred, open_until / (1 + clearance))
    centers = target.center + distance[:, None] * outward
    good = (distance >= least) & (free.clearance(centers) >= clearance * np.minimum(distance, target.radius))
    if free.observers is not None:
        good &= free.seen_empty(centers)
    tried = np.flatnonzero(good)
    if not len(tried):
        return looking_cameras(centers[tried], -outward[tried], vertical, focal, width, height)
    background = _background_fraction(target, centers[tried], vertical, free)
    enough = np.sort(background)[::-1][min(count, len(background)) - 1]
    chosen = tried[background >= enough]
    chosen = chosen[even_indices(len(chosen), count)]
    return looking_cameras(centers[chosen], -outward[chosen], vertical, focal, width, height)


def _background_fraction(
    target: Target, centers: Float64[np.ndarray, "n 3"], vertical: Float64[np.ndarray, "3"], free: FreeSpace
) -> Float64[np.ndarray, " n"]:
    """Share of the rays through a target, and beside it, that end at something, for each camera. They begin before the
    target, so that what it hangs on or lies on counts from either side."""
    forward = target.center - centers
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right, down, _ = np.moveaxis(look_rotation(forward, vertical), 1, 0)
    hits = np.zeros(len(centers))
    length = np.full(len(centers), CONSTANTS.max_ray_cells * free.cell)
    beside = CONSTANTS.background_radii * target.radius
    for across in (-1.0, 0.0, 1.0):
        for along in (-1.0, 0.0, 1.0):
            through = target.center + beside * (across * right + along * down)
            ray = through - centers
            ray /= np.linalg.norm(ray, axis=1, keepdims=True)
            hits += np.isfinite(free.first_hit(through - beside * ray, ray, length))
    return hits / 9


def _distances(
    gaussians: Gaussians,
    target: Target,
    outward: Float64[np.ndarray, "n 3"],
    vertical: Float64[np.ndarray, "3"],
    focal: float,
    width: int,
    height: int,
    between: tuple[float, float],
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Along each direction how far a camera should be, how far at least, and how far the target itself reaches."""
    rows = target.rows[even_indices(len(target.rows), CONSTANTS.outline_sample)]
    offsets = gaussians.means[rows].astype(np.float64) - target.center
    # A Gaussian fills a cell of its own size.
    margin = CONSTANTS.fill_margin
    shares = np.clip(CONSTANTS.fill_shares, between[0] * margin, between[1] / margin)
    cell = max(target.radius / CONSTANTS.outline_cells, 2 * float(np.median(gaussians.scales[rows].max(axis=1))))
    preferred, least, reach = (np.empty(len(outward)) for _ in range(3))
    for index, (right, down, direction) in enumerate(look_rotation(outward, vertical)):
        plane = np.stack((offsets @ right, offsets @ down), axis=1)
        area = len(np.unique(np.floor(plane / cell).astype(np.int64), axis=0)) * cell**2
        reach[index] = max(float((offsets @ direction).max()), 0.0)
        # Distance at which an area fills a share of the picture: area · focal² / distance² = share · pixels.
        fills = [
            focal * math.sqrt(area / (share * width * height))
            for share in (shares[index % len(shares)], CONSTANTS.max_fill_share, CONSTANTS.thin_fill_share)
        ]
        wide, high = np.abs(plane).max(axis=0)
        framed = 2 * focal / CONSTANTS.framed_share * max(wide / width, high / height)
        preferred[index] = reach[index] + max(fills[0], min(framed, fills[2]))
        least[index] = reach[index] + fills[1]
    return preferred, least, reach


def up_of(scene: Scene) -> Float64[np.ndarray, "3"] | None:
    """The scene's up, else the mean of the upward directions of its views where these agree, else None."""
    if scene.up is not None or scene.views is None:
        return scene.up
    mean = -scene.views.cameras.cam_from_world[:, 1, :3].astype(np.float64).mean(axis=0)
    length = float(np.linalg.norm(mean))
    return mean / length if length > 0.5 else None
