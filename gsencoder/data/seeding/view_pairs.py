"""Which posed views show the same surfaces, from the cameras alone: no points and no depth are known yet."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from gsencoder.types import Cameras

DEPTHS = (0.25, 0.5, 1.0, 2.0, 4.0)
"""Depths of the points that stand for what a view may show, as multiples of the typical distance."""
RAYS = 5
"""Rows and columns of the rays on which these points lie."""
MAX_ANGLE = np.deg2rad(75.0)
"""Views of a surface from directions that differ more are not matched: their features look different."""
FORWARD_BASELINES = 10.0
"""Parallel cameras are taken to look at something this many times as far away as the nearest other camera."""


class DepthRange(NamedTuple):
    """Depths z at which a view may show something, world units."""

    near: float
    far: float


def typical_distance(cameras: Cameras) -> float:
    """How far away what the cameras look at may be, world units; 1 for one camera and for cameras at one point.

    Cameras around something look at one point, the nearest one to all optical axes, and the result is their median
    distance from it along the axes. Where the axes run parallel or apart it is ten times the median distance between
    neighboring cameras.
    """
    centers = cameras.centers.astype(np.float64)
    forward = cameras.cam_from_world[:, 2, :3].astype(np.float64)
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    normal_matrix = across.sum(axis=0)
    if len(cameras) > 1 and np.linalg.eigvalsh(normal_matrix)[0] > 1e-3 * len(cameras):
        point = np.linalg.solve(normal_matrix, np.einsum("vij,vj->i", across, centers))
        along = np.einsum("vi,vi->v", point - centers, forward)
        if np.mean(along > 0) > 0.75 and np.median(along) > 0:
            return float(np.median(along))
    apart = nearest_distances(centers)
    return FORWARD_BASELINES * float(np.median(apart)) if len(apart) and np.median(apart) > 0 else 1.0


def nearest_distances(centers: Float64[np.ndarray, "V 3"]) -> Float64[np.ndarray, " n"]:
    """The distance from each center to the nearest one elsewhere; nothing for a center that has none."""
    from scipy.spatial import cKDTree

    unique = np.unique(centers, axis=0)
    if len(unique) < 2:
        return np.empty(0)
    return np.asarray(cKDTree(unique).query(unique, k=2)[0])[:, 1]


def overlaps(cameras: Cameras, distance: float) -> Float64[np.ndarray, "V V"]:
    """The share of points before view i that view j shows too, from directions up to 75° apart; 0 on the diagonal.

    Args:
        cameras: of the views.
        distance: of `typical_distance`.
    """
    count = len(cameras)
    steps = (np.arange(RAYS) + 0.5) / RAYS
    shares = np.zeros((count, count))
    centers = cameras.centers.astype(np.float64)
    for view in range(count):
        columns, rows = np.meshgrid(steps * cameras.widths[view], steps * cameras.heights[view])
        rays = cameras.rays(view, np.stack([columns.ravel(), rows.ravel()], axis=1))
        points = (centers[view] + distance * np.array(DEPTHS)[:, None, None] * rays).reshape(-1, 3)
        pixels, depths = cameras.project(points)
        in_view = cameras.in_image(pixels, depths)
        directions, other_directions = points - centers[view], points - centers[:, None]
        norms = np.linalg.norm(directions, axis=1) * np.linalg.norm(other_directions, axis=2)
        in_view &= np.einsum("pi,vpi->vp", directions, other_directions) > np.cos(MAX_ANGLE) * norms
        shares[view] = in_view.mean(axis=1)
    np.fill_diagonal(shares, 0)
    return shares


def choose_pairs(cameras: Cameras, count: int) -> list[tuple[int, int]]:
    """Pairs of views to match: for each view the `count` others that overlap most with it, each pair once, sorted."""
    shares = overlaps(cameras, typical_distance(cameras))
    both = shares + shares.T
    pairs = set()
    for view in range(len(cameras)):
        order = np.argsort(-both[view], kind="stable")[:count]
        pairs |= {(min(view, int(other)), max(view, int(other))) for other in order if both[view, other] > 0}
    return sorted(pairs)


def depth_range_of_cameras(cameras: Cameras) -> DepthRange:
    """Depths to sweep where nothing is known but the cameras: a fifth to four times the typical distance."""
    distance = typical_distance(cameras)
    return DepthRange(distance / 5, 4 * distance)
