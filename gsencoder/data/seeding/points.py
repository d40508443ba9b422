"""Oriented surface samples and flat Gaussians from structure-from-motion points."""

import warnings

import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.threads import thread_count
from gsencoder.types import Gaussians, Scene, Views, sh_from_colors

SIZE = 0.6
"""In-plane standard deviation as a share of the spacing. Rendered against the photographs of RGB-D rooms 0.55 is
sharpest by PSNR (0.5: −0.2 dB, 0.6: −0.2, 0.7: −1.0), but lets 1.3 % of the light through against 0.8 % at 0.6, and
what passes takes its features to the surface behind."""
THICKNESS = 0.1  # Standard deviation along the normal as a share of the in-plane one: about 1.2 mm at 2 cm
SEED_VOXEL = 0.02  # Distance of seeds in metres, unless a setting says otherwise
OPACITY = 0.95
"""A measured surface is opaque; what lies behind it must not take its features. The last 5 % leave a later
optimization a gradient, which a logit of 7 (0.999) would not."""
NEIGHBORS = 12
ENOUGH = 6  # Neighbors of the same surface that settle the spacing
SAME_FACING_COS = 0.5
OVER_ANY = 1.5
"""… but it is at most this many times the spacing of all samples around, of whatever facing: two sheets make √2, and a
scrap of surface with no like neighbor must not swell over the others."""
STRETCH = 3.0
"""A spacing is at most this many times the median of the neighbors' own: a stray point must not become a great blob."""


def flat_gaussians(
    points: Float32[np.ndarray, "n 3"],
    normals: Float32[np.ndarray, "n 3"],
    colors: Float32[np.ndarray, "n 3"],
    *,
    largest: float | Float32[np.ndarray, " n"],
    thickness: float | Float32[np.ndarray, " n"] = THICKNESS,
    measured: bool = True,
) -> Gaussians:
    """One Gaussian a point, flat along its normal, SH degree 0, opacity 0.95.

    Args:
        largest: upper limit of the spacing, which also holds where there is no neighbor.
        thickness: standard deviation along the normal as a share of the in-plane one.
        measured: False = the spacing is `largest` everywhere, as that of samples of a grid nearly is.
    """
    spacing = surface_spacing(points, normals, largest) if measured else np.broadcast_to(largest, len(points))
    size = (SIZE * spacing).astype(np.float32)
    scales = np.stack([size, size, size * thickness], axis=1).astype(np.float32)
    return Gaussians(
        means=points,
        quats=quats_from_normals(normals),
        scales=np.maximum(scales, np.float32(1e-12)),
        opacities=np.full(len(points), OPACITY, np.float32),
        sh=sh_from_colors(colors),
    )


def surface_spacing(
    points: Float32[np.ndarray, "n 3"], normals: Float32[np.ndarray, "n 3"], largest: float | Float32[np.ndarray, " n"]
) -> Float32[np.ndarray, " n"]:
    """Distance between samples of the same surface, √(area of a disc / samples in it), for each point.

    The disc reaches to the ENOUGHth neighbor that faces the same way, so the sheet below a thin plate or the next
    wall does not count. Limited to OVER_ANY times the spacing of all samples, STRETCH times the neighbors' median, and
    `largest`.
    """
    limit = np.broadcast_to(np.asarray(largest, np.float32), len(points))
    if len(points) < 2:
        return limit.copy()
    distances, rows = nearest(points, points, NEIGHBORS + 1)
    distances, rows = distances[:, 1:], rows[:, 1:]
    alike = np.einsum("nkc,nc->nk", normals[rows], normals) > SAME_FACING_COS
    on_sheet, on_any = _disc_spacing(distances, alike), _disc_spacing(distances, np.ones_like(alike))
    spacing = np.minimum(np.minimum(on_sheet, OVER_ANY * on_any), limit)
    around = np.median(spacing[rows], axis=1)
    return np.minimum(spacing, STRETCH * around).astype(np.float32)


def _disc_spacing(distances: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Spacing by the disc that reaches to the ENOUGHth neighbor that counts, or the last one; infinite without any."""
    count = np.minimum(counts.cumsum(axis=1), ENOUGH)
    last = count.argmax(axis=1)  # The first place where the largest count is reached.
    neighbors_within = np.take_along_axis(count, last[:, None], 1)[:, 0]
    radius = np.take_along_axis(distances, last[:, None], 1)[:, 0]
    # The disc's rim passes through its last sample, which is half inside; the point itself is wholly inside.
    # Coincident points have no spacing of their own.
    return np.where((neighbors_within > 0) & (radius > 0), radius * np.sqrt(np.pi / (neighbors_within + 0.5)), np.inf)


def nearest(
    points: Float32[np.ndarray, "n 3"], queries: Float32[np.ndarray, "m 3"], count: int
) -> tuple[Float32[np.ndarray, "m k"], Int64[np.ndarray, "m k"]]:
    """Distances and rows of the `count` nearest points (fewer where there are fewer points), nearest first."""
    from scipy.spatial import cKDTree

    count = min(count, len(points))
    tree = cKDTree(points, balanced_tree=False, compact_nodes=False)
    distances, rows = tree.query(queries, k=count, workers=thread_count())
    shape = (len(queries), count)
    return np.reshape(distances, shape).astype(np.float32), np.reshape(rows, shape).astype(np.int64)


def quats_from_normals(normals: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 4"]:
    """The shortest rotation that takes the z axis to the normal, wxyz: (1 + n_z, −n_y, n_x, 0) normalized.

    The disc is round, so the turn about the normal is free. Normals of the lower half are negated first, which is the
    same disc and keeps away from the half turn, where the rotation is not defined.
    """
    up = np.where(normals[:, 2:] < 0, -normals, normals)
    quats = np.stack([1 + up[:, 2], -up[:, 1], up[:, 0], np.zeros_like(up[:, 0])], axis=1)
    return (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32)


LARGEST_ANGLE = 0.1
"""A point's spacing is at most this share of its distance to the nearest camera, so that strays near one stay small."""
LARGEST_SPACING = 30.0  # … and at most this many times the median spacing of all points, by default
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
        points: world units, relative to the scene's origin.
        colors: RGB; None makes them mid-grey, with a warning.
        views: cameras, which orient the normals and limit the size of strays.
        voxel: edge of the grid in world units; None keeps every distinct point.
        largest_spacing: upper limit of a point's spacing, in median spacings of all points.
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
    """Mean position and RGB in [0, 1] of each occupied voxel, in their order; None joins equal points only."""
    if voxel is None:
        cells: np.ndarray = points
    else:
        if not 0 < voxel < np.inf:
            raise InputError(f"seeds: voxel must be a positive length, got {voxel}")
        scaled = np.floor(points.astype(np.float64) / voxel)
        if np.abs(scaled).max() > 2**62:
            raise InputError(f"seeds: a voxel of {voxel:g} is too small for points up to {np.abs(points).max():g}")
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


def sheet_normals(points: Float32[np.ndarray, "n 3"]) -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, " n"]]:
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


SPACING_SAMPLE = 100_000
NEIGHBOR = 4  # Neighbors of a point of a square grid at one step


def scene_spacing(means: Float32[np.ndarray, "N 3"]) -> float:
    """Median distance from a point to its fourth nearest neighbor: the step of a grid laid on surfaces.

    The nearest one alone would not do: where two scans of one surface lie a little apart, points come in close pairs.
    Above 100,000 points, a sample of about that many asks (all answer); it is drawn by a hash of the coordinates, so
    the order of the points does not matter. Points in one place count once; 0 where all coincide.
    """
    from scipy.spatial import cKDTree

    if len(means) < 2:
        return 0.0
    queries = means
    every = len(means) // SPACING_SAMPLE
    if every > 1:
        # -0.0 and 0.0 are one place and must hash alike, hence the addition.
        bits = (means + np.float32(0)).view(np.uint32).astype(np.uint64)
        mixed = bits @ np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
        sample = (mixed >> np.uint64(33)) % np.uint64(every) == 0
        queries = means[sample] if sample.any() else means
    # Column 0 is the point itself.
    tree = cKDTree(means, balanced_tree=False, compact_nodes=False)
    distances = np.asarray(tree.query(queries, k=min(NEIGHBOR, len(means) - 1) + 1, workers=thread_count())[0])
    if (distances[:, 1] == 0).any():
        distinct = np.unique(means, axis=0)
        return scene_spacing(distinct) if len(distinct) < len(means) else 0.0
    return float(np.median(distances[:, -1]))


def unit_of(scene: Scene) -> float:
    """Metres per unit of a scene with Gaussians. Where the scene does not say, these are taken, with a warning, to lie
    as far apart as seeds do."""
    if scene.metres_per_unit is not None:
        return scene.metres_per_unit
    assert scene.gaussians is not None
    spacing = scene_spacing(scene.gaussians.means)
    unit = SEED_VOXEL / spacing if spacing else 1.0
    found = f"lie {spacing:.4g} units apart, which is taken for {SEED_VOXEL:g} m" if spacing else "all lie in one place"
    warnings.warn(
        f"the unit of scene {scene.name!r} is unknown; its Gaussians {found}, so a unit for {unit:.4g} m; "
        "give data.metres_per_unit= if you know better",
        SceneWarning,
        stacklevel=3,
    )
    return unit
