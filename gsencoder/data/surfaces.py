"""Oriented pieces of a scene's surfaces, from its Gaussians or its depth images."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from gsencoder.core.arrays import even_indices
from gsencoder.data.check.depth_agreement import SAMPLES, depth_views
from gsencoder.types import Gaussians, Views
from gsencoder.types.checks import invert_rigid, transform
from gsencoder.types.scene import unproject_points

MAX_SAMPLES = 20_000
"""So many Gaussians are looked at."""
FLAT = 0.5
"""Gaussians whose thinnest axis is above this share of the middle one have no normal."""
PLANE_NEIGHBORS = 32
"""Means through which a plane is laid."""
PLANE_THICKNESS = 0.5
"""Largest thickness of a plane, as a share of its smaller width (standard deviations of the means)."""
MIN_OPACITY = 0.3
"""Means of fainter Gaussians are left out of planes."""
MAX_PLANE_MEANS = 400_000
"""Means among which neighbors are looked for."""


class Surfaces(NamedTuple):
    """Oriented pieces of surfaces.

    Attributes:
        means: positions in the world.
        normals: unit; either side.
        areas: in any unit.
        rest: area of what has no normal, in the same unit; it lowers the confidence of an estimate.
    """

    means: Float64[np.ndarray, "n 3"]
    normals: Float64[np.ndarray, "n 3"]
    areas: Float64[np.ndarray, " n"]
    rest: float = 0.0


def surfaces_of_gaussians(gaussians: Gaussians, *, seed: int = 0) -> Surfaces:
    """A random choice of the flat Gaussians; areas are times opacity.

    Args:
        gaussians: a splat or seeds.
        seed: of the choice.
    """
    from scipy.spatial.transform import Rotation

    rows = np.random.default_rng(seed).permutation(len(gaussians))[: 4 * MAX_SAMPLES]
    scales = gaussians.scales[rows].astype(np.float64)
    order = np.argsort(scales, axis=1)
    ordered = np.take_along_axis(scales, order, axis=1)
    flat = ordered[:, 0] <= FLAT * ordered[:, 1]
    rows, order, ordered = rows[flat][:MAX_SAMPLES], order[flat][:MAX_SAMPLES], ordered[flat][:MAX_SAMPLES]
    if not len(rows):
        return Surfaces(np.empty((0, 3)), np.empty((0, 3)), np.empty(0))
    matrices = Rotation.from_quat(gaussians.quats[rows].astype(np.float64), scalar_first=True).as_matrix()
    normals = np.take_along_axis(matrices, order[:, None, :1], axis=2)[..., 0]
    areas = ordered[:, 1] * ordered[:, 2] * gaussians.opacities[rows].astype(np.float64)
    return Surfaces(gaussians.means[rows].astype(np.float64), normals, areas)


def planes_of_gaussians(gaussians: Gaussians, *, seed: int = 0) -> Surfaces:
    """Planes through the neighbors of a random choice of the means; areas are squared distances to the last neighbor.

    Args:
        gaussians: a splat or seeds.
        seed: of the choice.
    """
    from scipy.spatial import cKDTree

    opaque = np.flatnonzero(gaussians.opacities >= MIN_OPACITY)
    opaque = np.random.default_rng(seed).permutation(opaque)[:MAX_PLANE_MEANS]
    if len(opaque) < PLANE_NEIGHBORS:
        return Surfaces(np.empty((0, 3)), np.empty((0, 3)), np.empty(0))
    means = gaussians.means[opaque].astype(np.float64)
    distances, neighbors = cKDTree(means).query(means[:MAX_SAMPLES], k=PLANE_NEIGHBORS)
    local = means[neighbors]
    local -= local.mean(axis=1, keepdims=True)
    variances, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", local, local))
    flat = variances[:, 0] < PLANE_THICKNESS**2 * variances[:, 1]
    # Neighbors of a lone mean are far away, and say nothing about a surface of that size.
    areas = np.square(distances[:, -1])
    areas = np.minimum(areas, np.quantile(areas, 0.95))
    return Surfaces(means[:MAX_SAMPLES][flat], axes[flat, :, 0], areas[flat], float(areas[~flat].sum()))


def surfaces_of_depth(views: Views, *, limit: int = 16, seed: int = 0) -> Surfaces:
    """Samples of the surfaces that depth images show.

    Args:
        views: with depth.
        limit: largest number of views to look at, evenly spaced.
        seed: of the choice of samples.
    """
    # Its kernels load numba, which a scene that states its up does without.
    from gsencoder.data.seeding.depth import surface_pixels

    depth = depth_views(views, even_indices(len(views), limit), seed=seed)
    rng = np.random.default_rng(seed)
    world_from_cam = invert_rigid(depth.cam_from_world)
    parts = []
    for view in range(len(depth)):
        pixels = surface_pixels(depth.depths[view], depth.Ks[view].astype(np.float32))
        rows, columns = np.nonzero(pixels.use)
        sample = rng.permutation(len(rows))[:SAMPLES]
        rows, columns = rows[sample], columns[sample]
        z, normals = pixels.depth[rows, columns].astype(np.float64), pixels.normals[rows, columns].astype(np.float64)
        local = unproject_points(np.stack((columns, rows), axis=1) + 0.5, z, depth.Ks[view])
        facing = np.abs(np.einsum("ni,ni->n", local, normals)) / np.linalg.norm(local, axis=1)
        areas = np.square(z) / np.prod(depth.Ks[view].diagonal()[:2]) / np.maximum(facing, 0.1)
        parts.append((transform(world_from_cam[view], local), normals @ depth.cam_from_world[view, :3, :3], areas))
    means, directions, sizes = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return Surfaces(means, directions, sizes)
