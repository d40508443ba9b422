"""Cameras inside a bare splat of a room: from outside, one sees the backs of its walls, which no photograph shows."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError
from gsencoder.data.enclosure import enclosure_of
from gsencoder.data.orbits import CamerasOfSplat, looking_cameras, orbit_cameras, spiral_directions
from gsencoder.render import BlendConfig
from gsencoder.render.images import OPAQUE, RenderedImages, visible_shares
from gsencoder.types import Cameras, Gaussians, Scene, Views

FIELD_OF_VIEW = np.deg2rad(75.0)
"""Horizontal; wider than an orbit's, as photographs of rooms are."""
WIDTH, HEIGHT = 640, 480
JUDGED_WIDTH = 64
"""Candidates are judged at this width, pixels."""
EXTENT = (0.03, 0.97)
"""Quantiles of the coordinates between which cameras may stand."""
SAMPLES = 3000
MAX_OBSTACLES = 100_000
CLEARANCE = 0.1
"""Smallest distance to any Gaussian, in half diagonals of the extent."""
POSITIONS, DIRECTIONS = 96, 8
ELEVATIONS = (-35.0, -5.0)
"""Of the looks of level cameras, degrees above the horizon: people who photograph a room look down a little."""
FILLED = 0.7
"""A photograph of a room shows surfaces nearly everywhere: candidates that fill less of their picture are left out."""
DISTANCE = 0.3
"""Smallest mean distance of what a candidate shows, in half diagonals of the extent: photographs of rooms show objects
among others, and a picture of one surface from nearby tells no segmenter what it is."""
CELLS = 12
"""Cells along the longest side of the extent, whose coverage is what cameras are chosen for."""
ENOUGH = 0.01
"""Share of a picture, summed over cameras, at which a cell is covered."""
ROOM = 0.6
"""A splat is that of a room if cameras inside cover this share of its Gaussians: of kitchen and house rooms 0.77 to
0.94, of a guitar and a rider on a motorcycle 0.33 and 0.44."""


class InteriorViews(NamedTuple):
    """Cameras inside a splat.

    Attributes:
        cameras: in the order in which they were chosen.
        filled: mean share of their pictures that shows surfaces.
        covered: share of the Gaussians in cells that they cover.
    """

    cameras: Cameras
    filled: float
    covered: float


def interior_views(
    gaussians: Gaussians, count: int, *, up: Float64[np.ndarray, "3"] | None = None
) -> InteriorViews | None:
    """Up to `count` cameras in a splat's free space that cover most of it, among those whose pictures are filled; None
    where no camera stands free with its picture filled, as around an object.

    With `up`, cameras are level and look between 35° and 5° down; else in all directions, and -y is upward in the
    pictures, as in COLMAP's worlds.
    """
    rows = np.flatnonzero(gaussians.opacities >= OPAQUE)
    if not len(rows):
        return None
    means = gaussians.means[rows[even_indices(len(rows), MAX_OBSTACLES)]].astype(np.float64)
    low, high = np.quantile(means, EXTENT, axis=0)
    centers = _free_positions(means, low, high)
    if not len(centers):
        return None
    candidates = _candidates(centers, up)
    cell_of = _cells(gaussians.means[rows], low, high)
    groups = [rows, *(rows[cell_of == cell] for cell in range(cell_of.max() + 1))]
    shares = visible_shares(gaussians, candidates.resized(JUDGED_WIDTH), groups)
    filled, shares = shares[:, 0], shares[:, 1:]
    weights = np.bincount(cell_of) / len(cell_of)
    counts = np.bincount(cell_of)[:, None]
    middles = np.stack([np.bincount(cell_of, axis) for axis in gaussians.means[rows].T], axis=1) / counts
    distances = np.linalg.norm(candidates.centers[:, None] - middles, axis=2)
    mean_distance = (shares * distances).sum(axis=1) / np.maximum(shares.sum(axis=1), 1e-12)
    usable = (filled >= FILLED) & (mean_distance >= DISTANCE * np.linalg.norm(high - low) / 2)
    chosen = _cover(np.where(usable[:, None], shares, 0), weights, count)
    if not chosen:
        return None
    covered = float(weights[shares[chosen].sum(axis=0) >= ENOUGH].sum())
    return InteriorViews(candidates.select(np.array(chosen)), float(filled[chosen].mean()), covered)


def _free_positions(
    means: Float64[np.ndarray, "n 3"], low: Float64[np.ndarray, "3"], high: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "P 3"]:
    """Points of the extent that are clear of Gaussians and far from each other, the freest first."""
    from scipy.spatial import cKDTree

    size = float(np.linalg.norm(high - low)) / 2
    points = np.random.default_rng(0).uniform(low, high, (SAMPLES, 3))
    clearance, _ = cKDTree(means).query(points)
    points = points[np.argsort(-clearance, kind="stable")][: int((clearance >= CLEARANCE * size).sum())]
    chosen: list[int] = []
    distance = np.full(len(points), np.inf)
    while len(points) and len(chosen) < POSITIONS and distance.max() > CLEARANCE * size:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return points[chosen]


def _candidates(centers: Float64[np.ndarray, "P 3"], up: Float64[np.ndarray, "3"] | None) -> Cameras:
    """Cameras at each position, in directions that are spread over all of them together."""
    count = len(centers) * DIRECTIONS
    outward, vertical = spiral_directions(count, up, ELEVATIONS)
    # Neighbors of the spiral go to different positions.
    order = np.argsort(np.tile(np.arange(len(centers)), DIRECTIONS), kind="stable")
    focal = WIDTH / (2 * float(np.tan(FIELD_OF_VIEW / 2)))
    return looking_cameras(np.repeat(centers, DIRECTIONS, axis=0), outward[order], vertical, focal, WIDTH, HEIGHT)


def _cells(
    means: Float64[np.ndarray, "n 3"] | np.ndarray, low: np.ndarray, high: np.ndarray
) -> Int64[np.ndarray, " n"]:
    """The number of the cell that each mean lies in; means outside the extent count to the nearest."""
    edge = float((high - low).max()) / CELLS or 1.0
    index = np.clip(np.floor((means - low) / edge), 0, np.maximum(np.ceil((high - low) / edge) - 1, 0)).astype(np.int64)
    codes = (index[:, 0] * CELLS + index[:, 1]) * CELLS + index[:, 2]
    return np.unique(codes, return_inverse=True)[1].reshape(-1)


def _cover(shares: Float64[np.ndarray, "V C"], weights: Float64[np.ndarray, " C"], count: int) -> list[int]:
    """Greedy maximum of Σ_cells weight · (1 − exp(−share / enough)) with the share summed over the chosen views."""
    chosen: list[int] = []
    total = np.zeros(shares.shape[1])
    for _ in range(min(count, len(shares))):
        gains = (np.exp(-total / ENOUGH) - np.exp(-(total + shares) / ENOUGH)) @ weights
        gains[chosen] = 0
        best = int(gains.argmax())
        if gains[best] <= 0:
            break
        chosen.append(best)
        total += shares[best]
    return chosen


AROUND, INSIDE = "orbit", "inside"
"""What the names of views begin with."""


def with_views(
    scene: Scene, count: int, config: BlendConfig = BlendConfig(), *, cameras: CamerasOfSplat = "auto"
) -> tuple[Scene, str]:
    """The scene, and why its cameras stand where they do; a bare splat is seen by up to `count` cameras, whose pictures
    are rendered when asked for.

    They stand around the splat, inside it, or "auto": inside if it is a room (`gsencoder.data.enclosure`) and that
    shows most of it.
    """
    if scene.views is not None:
        return scene, "the scene has views"
    assert scene.gaussians is not None
    inside: InteriorViews | None = None
    reason = "cameras= says so"
    if cameras == "auto":
        enclosure = enclosure_of(scene.gaussians)
        cameras = "inside" if enclosure.is_room else "around"
        reason = enclosure.reason
        if enclosure.is_room:
            inside = interior_views(scene.gaussians, count, up=scene.up)
            if inside is None or inside.covered < ROOM:
                cameras, reason = "around", f"it looks like a room, but cameras inside cover less than {ROOM:.0%} of it"
    elif cameras == "inside":
        inside = interior_views(scene.gaussians, count, up=scene.up)
        if inside is None:
            raise InputError(f"cameras=inside: no camera in {scene.name} would see surfaces all over its picture")
    if cameras == "inside":
        assert inside is not None
        placed, kind = inside.cameras, INSIDE
    else:
        placed, kind = orbit_cameras(scene.gaussians, count=count, up=scene.up), AROUND
    names = tuple(f"{kind}_{view:03d}" for view in range(len(placed)))
    images = RenderedImages(scene.gaussians, placed, config)
    return replace(scene, views=Views(cameras=placed, names=names, images=images)), reason
