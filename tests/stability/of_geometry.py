"""Rotations, covariances, projection, spherical harmonics, boxes."""

import numpy as np
import torch
from stability import oracles
from stability.extremes import NEAR, Case
from stability.registry import routine, worst

from gsencoder import geometry
from gsencoder.infer.localize import box_around
from gsencoder.types import Cameras, Gaussians


def tensors(g: Gaussians, dtype: torch.dtype = torch.float32) -> list[torch.Tensor]:
    return [torch.from_numpy(each).to(dtype) for each in (g.means, g.quats, g.scales, g.opacities)]


def view_of(cameras: Cameras, dtype: torch.dtype = torch.float32) -> tuple[torch.Tensor, torch.Tensor, int, int]:
    pose, K = torch.from_numpy(cameras.cam_from_world[0]).to(dtype), torch.from_numpy(cameras.Ks[0]).to(dtype)
    return pose, K, int(cameras.widths[0]), int(cameras.heights[0])


@routine("rotations of quaternions", "vectors")
def rotation_error(case: Case) -> float:
    quats = case.vectors[:, :4].copy()
    return worst(geometry.rotmats_from_quats(torch.from_numpy(quats)), oracles.rotations(quats), 1)


@routine("covariances", "splat")
def covariance_error(case: Case) -> float:
    g = case.gaussians
    want = oracles.covariances(g.quats, g.scales)
    got = geometry.covariances(torch.from_numpy(g.quats), torch.from_numpy(g.scales))
    return worst(got, want, np.abs(want).max(axis=(1, 2), keepdims=True))


@routine("projection of Gaussians (geometry.project, float32)", "splat", "camera")
def projection_error(case: Case) -> float:
    want = oracles.project(case.gaussians, case.cameras)
    got = geometry.project(*tensors(case.gaussians), *view_of(case.cameras))
    width, height = int(case.cameras.widths[0]), int(case.cameras.heights[0])
    # Whether a Gaussian that touches the border by rounding is in view has no right answer.
    slack = 1e-4 * (1 + np.abs(want.means2d) + want.extents)
    near = (want.means2d + want.extents > -slack) & (want.means2d - want.extents < np.array([width, height]) + slack)
    inner = (want.means2d + want.extents > slack) & (want.means2d - want.extents < np.array([width, height]) - slack)
    seen = want.valid & inner.all(axis=1)
    unseen = ~want.valid & ~(near.all(axis=1) & (want.depths > NEAR))
    valid = got.valid.numpy()
    if (seen & ~valid).any() or (unseen & valid).any():
        return 1.0
    rows = seen
    return max(
        worst(got.means2d.numpy()[rows], want.means2d[rows], 1 + np.abs(want.means2d[rows])),
        worst(got.depths.numpy()[rows], want.depths[rows], want.depths[rows]),
        worst(got.extents.numpy()[rows], want.extents[rows], 1 + want.extents[rows].max(axis=1, keepdims=True)),
        worst(got.conics.numpy()[rows], want.conics[rows], np.abs(want.conics[rows]).max(axis=1, keepdims=True)),
        0.0 if bool(got.conics.isfinite().all() and got.extents.isfinite().all()) else np.inf,
    )


@routine("projection of points (Cameras.project, float32)", "splat", "camera")
def points_error(case: Case) -> float:
    want = oracles.project(case.gaussians, case.cameras)
    front = want.depths > NEAR
    pixels, depths = case.cameras.project(case.gaussians.means, 0)
    pose, focal = case.cameras.cam_from_world[0].astype(oracles.Wide), case.cameras.Ks[0, 0, 0]
    local = case.gaussians.means.astype(oracles.Wide) @ pose[:3, :3].T + pose[:3, 3]
    away = np.abs(local).max(axis=1)[front]
    scale = np.abs(want.means2d[front]).max(axis=1) + focal * away / want.depths[front]
    # A depth that is off moves the pixel as far as the point is from the axis.
    scale = scale * (away / want.depths[front])
    return max(
        worst(pixels[front], want.means2d[front], scale[:, None]), worst(depths[front], want.depths[front], away)
    )


@routine("unprojection (Cameras.unproject, float32)", "splat", "camera")
def unprojection_error(case: Case) -> float:
    want = oracles.project(case.gaussians, case.cameras)
    front = want.depths > NEAR
    pixels, depths = want.means2d[front].astype(np.float32), want.depths[front].astype(np.float32)
    pose, K = case.cameras.cam_from_world[0].astype(oracles.Wide), case.cameras.Ks[0].astype(oracles.Wide)
    z = depths.astype(oracles.Wide)
    local = np.stack([(pixels[:, 0] - K[0, 2]) / K[0, 0] * z, (pixels[:, 1] - K[1, 2]) / K[1, 1] * z, z], axis=1)
    points = local @ pose[:3, :3] - pose[:3, 3] @ pose[:3, :3]
    scale = np.maximum(np.abs(points).max(axis=1), np.abs(local).max(axis=1))[:, None]
    return worst(case.cameras.unproject(pixels, depths, 0), points, scale)


@routine("colors from spherical harmonics", "splat", "camera")
def colors_error(case: Case) -> float:
    g, center = case.gaussians, case.cameras.centers[0].astype(np.float32)
    basis = oracles.harmonics(g.means.astype(oracles.Wide) - center)
    want = np.maximum((basis[:, :, None] * g.sh).sum(axis=1) + 0.5, 0)
    return worst(geometry.colors_from_sh(*map(torch.from_numpy, (g.sh, g.means, center))), want, 1)


@routine("boxes around Gaussians", "splat")
def boxes_error(case: Case) -> float:
    g, rows = case.gaussians, np.arange(len(case.gaussians))
    got = box_around(g, rows, extent="sigma")
    spread = np.sqrt(np.einsum("nii->ni", oracles.covariances(g.quats, g.scales)))
    low, high = (g.means - spread).min(axis=0), (g.means + spread).max(axis=0)
    scale = max(float(np.abs(low).max()), float(np.abs(high).max()))
    means = box_around(g, rows, extent="means")
    local = (g.means.astype(oracles.Wide) - means.center) @ means.rotation
    outside = float((np.abs(local) - means.size / 2).max())
    distance = max(float(np.linalg.norm(means.size)), 1e-9 * float(np.abs(g.means).max()))
    return max(worst(got.aabb_min, low, scale), worst(got.aabb_max, high, scale), outside / distance)
