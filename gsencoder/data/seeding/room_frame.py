"""A frame that turns and moves with a room, so that seeds on a grid in it do not depend on the world's axes.

In most rooms surfaces face along three directions at right angles (a Manhattan world, Coughlan and Yuille 1999). The
axes are those with the largest Σ (n · axis)⁴ over the normals n of depth images; other scenes have such axes too, which
mean little there but turn with the scene.
"""

from itertools import permutations

import numpy as np
from jaxtyping import Float64

from gsencoder.core.arrays import even_indices
from gsencoder.data.seeding.depth import surface_pixels
from gsencoder.types import Views

MAX_VIEWS = 12
"""So many depth images are looked at, evenly spaced."""
MAX_SIDE = 240
"""Longer side in pixels of these depth images; of larger ones every second, third … row and column is taken."""
SAMPLES = 2000
"""So many normals of each are used."""
STARTS = 4
"""The axes of so many cameras are where the search begins."""
STEPS = 40


def room_frame(views: Views) -> Float64[np.ndarray, "4 4"] | None:
    """frame_from_world, rigid: the axes lie along walls, floor and furniture, the origin is the mean of the cameras.

    A grid of cubes is the same whichever axis comes first and whichever way it points. Each is the one nearest to the
    world's, so that rows that are sorted by cells come in the world's order.

    Args:
        views: with depth.

    Returns:
        The frame; None where no surface is seen, and without depth.
    """
    normals = _normals(views) if views.depths is not None and len(views) else np.empty((0, 3))
    if not len(normals):
        return None
    poses = views.cameras.cam_from_world.astype(np.float64)
    fits = [fit_axes(normals, poses[view, :3, :3]) for view in even_indices(len(views), STARTS)]
    axes = max(fits, key=lambda each: float(np.square(np.square(normals @ each.T)).sum()))
    frame = np.eye(4)
    frame[:3, :3] = _nearest_order(axes)
    frame[:3, 3] = -frame[:3, :3] @ views.cameras.centers.mean(axis=0, dtype=np.float64)
    return frame


def _normals(views: Views) -> Float64[np.ndarray, "n 3"]:
    """Unit normals in the world of the surfaces that some depth images show."""
    assert views.depths is not None
    parts = [np.empty((0, 3))]
    for view in even_indices(len(views), MAX_VIEWS):
        depth = views.depths[int(view)]
        step = -(-max(depth.shape) // MAX_SIDE)
        K = views.cameras.Ks[view] / np.array([[step], [step], [1]], np.float32)
        # Depth that cannot be is refused by whoever reads all of it.
        with np.errstate(all="ignore"):
            pixels = surface_pixels(np.ascontiguousarray(depth[::step, ::step]), K)
        local = pixels.normals[pixels.use].astype(np.float64)
        local = local[np.isfinite(local).all(axis=1)]
        local = local[even_indices(len(local), SAMPLES)] if len(local) else local
        parts.append(local @ views.cameras.cam_from_world[view, :3, :3])
    return np.concatenate(parts)


def fit_axes(normals: Float64[np.ndarray, "n 3"], axes: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, "3 3"]:
    """Orthonormal rows with a large Σ (n · axis)⁴, from a first guess. The sum is convex in the axes, so that the
    orthonormal matrix nearest to its gradient never has a smaller one."""
    for _ in range(STEPS):
        cosines = normals @ axes.T
        left, _, right = np.linalg.svd((cosines * cosines * cosines).T @ normals)
        axes = left @ right
    return axes


def _nearest_order(axes: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, "3 3"]:
    """The same three lines as rows of a rotation, each as near to its axis of the world as can be."""
    order = max(permutations(range(3)), key=lambda rows: float(np.abs(axes[list(rows)].diagonal()).sum()))
    rotation = axes[list(order)]
    rotation *= np.where(rotation.diagonal() < 0, -1, 1)[:, None]
    rotation[np.abs(rotation.diagonal()).argmin()] *= np.sign(np.linalg.det(rotation))
    return rotation
