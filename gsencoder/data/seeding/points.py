"""Oriented surface samples and flat Gaussians from structure-from-motion points."""

import warnings

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.seeding.flat import NEIGHBORS, THICKNESS, flat_gaussians, nearest
from gsencoder.types import Gaussians, Views

LARGEST_ANGLE = 0.1
"""A point's spacing is at most this share of its distance to the nearest camera, so that strays near one stay small."""
LARGEST_SPACING = 30.0
"""… and at most this many times the median spacing of all points, where not told otherwise."""
PCA_CHUNK = 100_000


def seed_from_points(
    points: Float32[np.ndarray, "P 3"],
    colors: UInt8[np.ndarray, "P 3"] | None,
    *,
    views: Views | None = None,
    voxel: float | None = None,
    largest_spacing: float = LARGEST_SPACING,
) -> Gaussians:
    """Flat Gaussians on a point cloud, for example COLMAP's.

    Points are averaged in voxels, get a normal from the principal axes of their 12 nearest neighbors, turned towards
    the nearest camera, and a size from the spacing of those neighbors. Where the neighbors do not form a sheet
    the Gaussian is as thick as they are.

    Args:
        points: positions in world units relative to the scene's origin.
        colors: RGB beside them; None makes them mid-grey, with a warning.
        views: cameras, which orient the normals and limit the size of strays.
        voxel: edge of the grid in world units; None keeps every distinct point.
        largest_spacing: upper limit of a point's spacing, in median spacings of all points.

    Raises:
        InputError: no points, values that are not finite, colors of another length, a voxel that is not positive.
    """
    if not len(points):
        raise InputError("seeds: the scene has no points; seeds need points, depth images or a mesh")
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if bad.size:
        raise InputError(f"seeds: {bad.size} of {len(points)} points are not finite (first: row {bad[0]}); remove them")
    if colors is not None and len(colors) != len(points):
        raise InputError(f"seeds: expected {len(points)} colors, one a point, got {len(colors)}")
    points, tints = average_in_voxels(points, colors_or_grey(points, colors), voxel)
    normals, flatness = sheet_normals(points)
    centers = None if views is None or not len(views) else views.cameras.centers
    largest: float | Float32[np.ndarray, " n"] = largest_spacing * typical_spacing(points)
    if centers is None:
        outwards = points - np.median(points, axis=0)
    else:
        distance, camera = nearest(centers.astype(np.float32), points, 1)
        outwards = centers.astype(np.float32)[camera[:, 0]] - points
        largest = np.minimum(np.float32(largest), np.maximum(LARGEST_ANGLE * distance[:, 0], np.float32(1e-9)))
    normals = np.where(np.einsum("ij,ij->i", normals, outwards)[:, None] < 0, -normals, normals)
    thickness = np.maximum(np.float32(THICKNESS), flatness)
    return flat_gaussians(points, normals, tints, largest=largest, thickness=thickness)


def colors_or_grey(
    points: Float32[np.ndarray, "P 3"], colors: UInt8[np.ndarray, "P 3"] | None
) -> UInt8[np.ndarray, "P 3"]:
    """The points' colors; mid-grey, with a warning, where they have none."""
    if colors is not None:
        return colors
    warnings.warn(f"seeds: {len(points)} points without colors are made mid-grey", SceneWarning, stacklevel=3)
    return np.full((len(points), 3), 128, np.uint8)


def average_in_voxels(
    points: Float32[np.ndarray, "P 3"], colors: UInt8[np.ndarray, "P 3"], voxel: float | None
) -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n 3"]]:
    """Mean position and RGB in [0, 1] of each occupied voxel, in the order of the voxels; None joins equal points only.

    Raises InputError where the voxel is not positive or too small for the points' extent.
    """
    if voxel is None:
        cells: np.ndarray = points
    else:
        if not 0 < voxel < np.inf:
            raise InputError(f"seeds: voxel must be a positive length, got {voxel}")
        scaled = np.floor(points.astype(np.float64) / voxel)
        if np.abs(scaled).max() > 2**62:
            raise InputError(
                f"seeds: a voxel of {voxel:g} is too small for points {np.abs(points).max():g} from the origin"
            )
        cells = scaled.astype(np.int64)
    _, inverse, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    inverse = inverse.reshape(-1)
    sums = [np.bincount(inverse, column) / counts for column in (*points.T.astype(np.float64), *(colors.T / 255.0))]
    return np.stack(sums[:3], axis=1).astype(np.float32), np.stack(sums[3:], axis=1).astype(np.float32)


def typical_spacing(points: Float32[np.ndarray, "n 3"]) -> float:
    """Median distance from a point to the nearest other one; 1 where there is only one point."""
    if len(points) < 2:
        return 1.0
    distances = nearest(points, points, 2)[0][:, 1]
    distances = distances[distances > 0]
    return float(np.median(distances)) if distances.size else 1.0


def sheet_normals(
    points: Float32[np.ndarray, "n 3"],
) -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, " n"]]:
    """Unit normals from the principal axes of each point's nearest neighbors, and how flat these lie.

    Flatness is the ratio of the standard deviations along the normal and along the middle axis: 0 = a sheet, 1 = a
    ball. A lone pair or a line of points gives some perpendicular direction, and 1.
    """
    _, rows = nearest(points, points, NEIGHBORS + 1)
    normals = np.empty((len(points), 3), np.float32)
    flatness = np.empty(len(points), np.float32)
    for start in range(0, len(points), PCA_CHUNK):
        part = slice(start, start + PCA_CHUNK)
        around: Float64[np.ndarray, "n k 3"] = points[rows[part]].astype(np.float64)
        around -= around.mean(axis=1, keepdims=True)
        variances, axes = np.linalg.eigh(around.transpose(0, 2, 1) @ around)
        normals[part] = axes[:, :, 0]
        thin, middle, wide = np.maximum(variances, 0).T
        has_width = middle > 1e-9 * np.maximum(wide, 1e-300)
        flatness[part] = np.where(has_width, np.sqrt(thin / np.where(has_width, middle, 1)), 1)
    return normals, flatness
