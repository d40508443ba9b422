"""Flat Gaussians from oriented points: rotation from the normal, size from the spacing of the neighbors."""

import numpy as np
from jaxtyping import Float32, Int64

from gsencoder.core.process import thread_count
from gsencoder.types import Gaussians, sh_from_colors

SIZE = 0.6
"""In-plane standard deviation as a share of the spacing. Rendered against the photographs of RGB-D rooms 0.55 is
sharpest by PSNR (0.5: −0.2 dB, 0.6: −0.2, 0.7: −1.0), but lets 1.3 % of the light through against 0.8 % at 0.6, and
what passes takes its features to the surface behind."""
THICKNESS = 0.1
"""Standard deviation along the normal as a share of the in-plane one: about 1.2 mm at 2 cm."""
OPACITY = 0.95
"""A measured surface is opaque; what lies behind it must not take its features. The last 5 % leave a later
optimization a gradient, which a logit of 7 (0.999) would not."""
NEIGHBORS = 12
ENOUGH = 6
"""So many neighbors of the same surface settle the spacing."""
SAME_FACING_COS = 0.5
OVER_ANY = 1.5
"""… but it is at most so many times the spacing of all samples around, of whatever facing: two sheets make √2, and a
scrap of surface with no like neighbor must not swell over the others."""
STRETCH = 3.0
"""A spacing may be so many times the median of the neighbors' own: a stray point must not become a great blob."""


def flat_gaussians(
    points: Float32[np.ndarray, "n 3"],
    normals: Float32[np.ndarray, "n 3"],
    colors: Float32[np.ndarray, "n 3"],
    *,
    largest: float | Float32[np.ndarray, " n"],
    thickness: float | Float32[np.ndarray, " n"] = THICKNESS,
) -> Gaussians:
    """One Gaussian a point, flat along its normal, SH degree 0, opacity 0.95.

    Args:
        points: distinct positions in world units.
        normals: unit.
        colors: RGB in [0, 1].
        largest: upper limit of the spacing, which also holds where there is no neighbor.
        thickness: standard deviation along the normal as a share of the in-plane one.
    """
    size = (SIZE * surface_spacing(points, normals, largest)).astype(np.float32)
    scales = np.stack([size, size, size * thickness], axis=1).astype(np.float32)
    return Gaussians(
        means=points,
        quats=quats_from_normals(normals),
        scales=np.maximum(scales, np.float32(1e-12)),
        opacities=np.full(len(points), OPACITY, np.float32),
        sh=sh_from_colors(colors),
    )


def surface_spacing(
    points: Float32[np.ndarray, "n 3"],
    normals: Float32[np.ndarray, "n 3"],
    largest: float | Float32[np.ndarray, " n"],
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
