"""Views whose poses do not fit the others: each depth image is moved until it lies on the others' surfaces."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from gsencoder.data.check.depth_agreement import CLIP, DepthViews, residuals, world_samples
from gsencoder.types.checks import invert_rigid, transform
from gsencoder.types.scene import project_points

REACHES = (0.15,) * 4 + (0.1,) * 4 + (0.07,) * 3 + (0.05, 0.04, 0.03, 0.03, 0.03)
"""Samples are matched to the surface on their pixel's ray in another view if its depth differs by at most this share,
one for each step: at first far, then near, so that what is hidden there is left out."""
HUBER = 0.01
"""Distances beyond this share of the depth count linearly."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoseFit:
    """How far a view would have to move to lie on the others' surfaces.

    Attributes:
        moved: distance in world units.
        turned: angle in radians.
        before: mean clipped residual of the view, as `Agreement.spread`.
        after: the same once it is moved.
    """

    moved: float
    turned: float
    before: float
    after: float


def view_spreads(residual: Float64[np.ndarray, "V V n"]) -> Float64[np.ndarray, " V"]:
    """The spread of each view's comparisons in both directions; NaN for a view that nothing compares with."""
    clipped = np.minimum(np.abs(residual), CLIP)
    total = np.nansum(clipped, axis=(1, 2)) + np.nansum(clipped, axis=(0, 2))
    count = np.isfinite(residual).sum(axis=(1, 2)) + np.isfinite(residual).sum(axis=(0, 2))
    return np.divide(total, count, out=np.full(len(total), np.nan), where=count > 0)


def surface_normals(views: DepthViews, view: int) -> Float64[np.ndarray, "h w 3"]:
    """Unit normals of a depth image in the world, from differences between neighboring pixels; NaN beside pixels
    without depth."""
    depth = views.depths[view].astype(np.float64) * views.scale
    depth[depth <= 0] = np.nan
    height, width = depth.shape
    K = views.Ks[view]
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    points = np.stack(((columns - K[0, 2]) / K[0, 0] * depth, (rows - K[1, 2]) / K[1, 1] * depth, depth), axis=2)
    normals = np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0))
    with np.errstate(invalid="ignore"):
        normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    return normals @ views.cam_from_world[view, :3, :3]


def fit_pose(views: DepthViews, view: int, normals: list[Float64[np.ndarray, "h w 3"]]) -> PoseFit:
    """Moves one view by point-to-plane steps (Chen and Medioni 1992) onto the surfaces of the others, which stay.

    Args:
        views: under the reading that fits best.
        view: to be moved.
        normals: of all views, by `surface_normals`.
    """
    from scipy.spatial.transform import Rotation

    points = world_samples(views)[view]
    points = points[views.values[view] > 0]
    center = invert_rigid(views.cam_from_world[view])[:3, 3]
    motion = np.eye(4)
    height, width = views.depths.shape[1:]
    for reach in REACHES:
        here = transform(motion, points)
        normal_matrix, normal_vector = np.zeros((6, 6)), np.zeros(6)
        for other in range(len(views)):
            if other == view:
                continue
            local = transform(views.cam_from_world[other], here)
            pixels = project_points(local, views.Ks[other])
            inside = (local[:, 2] > 0) & (pixels >= 0).all(axis=1) & (pixels < (width, height)).all(axis=1)
            columns, rows = np.floor(pixels[inside]).astype(np.int64).T
            measured = views.depths[other][rows, columns] * views.scale
            z = local[inside, 2]
            good = (measured > 0) & (np.abs(z - measured) <= reach * measured)
            normal = normals[other][rows[good], columns[good]]
            finite = np.isfinite(normal).all(axis=1)
            normal, observed = normal[finite], here[inside][good][finite]
            # Along the ray of the pixel the surface lies at the measured depth.
            eye = invert_rigid(views.cam_from_world[other])[:3, 3]
            target = eye + (observed - eye) * (measured[good] / z[good])[finite, None]
            distance = np.einsum("ni,ni->n", observed - target, normal)
            scale = HUBER * measured[good][finite]
            weight = np.minimum(1, scale / np.maximum(np.abs(distance), 1e-12)) / np.square(scale)
            jacobian = np.hstack((np.cross(observed - center, normal), normal))
            normal_matrix += (jacobian * weight[:, None]).T @ jacobian
            normal_vector -= jacobian.T @ (weight * distance)
        step = (
            np.linalg.solve(normal_matrix + 1e-6 * np.trace(normal_matrix) / 6 * np.eye(6), normal_vector)
            if normal_matrix.any()
            else np.zeros(6)
        )
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_rotvec(step[:3]).as_matrix()
        turn[:3, 3] = center + step[3:] - turn[:3, :3] @ center
        motion = turn @ motion
    poses = views.cam_from_world.copy()
    poses[view] = poses[view] @ invert_rigid(motion)
    before, after = (view_spreads(residuals(each))[view] for each in (views, replace(views, cam_from_world=poses)))
    moved_center = transform(motion, center[None])[0] - center
    return PoseFit(
        moved=float(np.linalg.norm(moved_center)),
        turned=float(np.linalg.norm(Rotation.from_matrix(motion[:3, :3]).as_rotvec())),
        before=float(before),
        after=float(after),
    )
