"""Rotations, covariances, projection and spherical harmonics: pure functions of torch tensors, in any float type.

Frames are named in the arguments (`target_from_source`). Camera axes are OpenCV's, quaternions are wxyz, pixel centers
lie at .5, scales are standard deviations. Every function keeps the dtype and device that it is given. The pinhole and
rigid transforms of numpy arrays, which need no torch, are those of gsencoder.types.scene.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gsencoder.types import SH_C0

ALPHA_MIN = 1 / 255  # Below this a Gaussian does not mark a pixel (Kerbl et al. 2023; gsplat).
ALPHA_MAX = 0.999  # One Gaussian never closes a ray completely, so that log1p(-alpha) stays finite


class Projected(NamedTuple):
    """Gaussians on one image plane."""

    means2d: Float[Tensor, "N 2"]  # centers in pixels
    conics: Float[Tensor, "N 3"]  # a, b, c of the inverse 2D covariance [[a, b], [b, c]], in 1/pixel²
    depths: Float[Tensor, " N"]  # z in the camera, world units
    mahalanobis2: Float[Tensor, " N"]  # squared Mahalanobis radius at which alpha falls to ALPHA_MIN; 0 = it is fainter
    extents: Float[Tensor, "N 2"]  # half width and half height in pixels of the ellipse of that radius
    valid: Bool[Tensor, " N"]  # in front of the near plane, not too faint, and touching the image


def normalize_quats(quats: Float[Tensor, "*n 4"], eps: float = 1e-18) -> Float[Tensor, "*n 4"]:
    """Unit quaternions of those of any length from 1e-14 to 1e18; the eps stands inside the root, so that a zero
    quaternion has a finite gradient."""
    return quats / torch.sqrt((quats * quats).sum(dim=-1, keepdim=True) + eps * eps)


def rotmats_from_quats(quats: Float[Tensor, "*n 4"]) -> Float[Tensor, "*n 3 3"]:
    """Rotation matrices of quaternions wxyz, which are normalized first."""
    w, x, y, z = normalize_quats(quats).unbind(dim=-1)
    rows = (
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def covariances(quats: Float[Tensor, "*n 4"], scales: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3 3"]:
    """Σ = R S Sᵀ Rᵀ (SplatDistill sec. 3.1), in squared world units."""
    half = rotmats_from_quats(quats) * scales.unsqueeze(-2)
    return half @ half.mT


def transform(target_from_source: Float[Tensor, "4 4"], points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
    """Rigid motion of points, R x + t, summed in float64: where the scene is far from the origin, or the field of view
    a tenth of a degree, the terms are many times what is left of them."""
    rotation, translation = target_from_source[:3, :3].double(), target_from_source[:3, 3].double()
    return (points.double() @ rotation.T + translation).to(points.dtype)


def invert_rigid(target_from_source: Float[Tensor, "*n 4 4"]) -> Float[Tensor, "*n 4 4"]:
    """source_from_target of a rigid transform: [Rᵀ | −Rᵀt]."""
    rotation = target_from_source[..., :3, :3].mT
    inverse = torch.zeros_like(target_from_source)
    inverse[..., :3, :3] = rotation
    inverse[..., :3, 3] = -(rotation @ target_from_source[..., :3, 3:]).squeeze(-1)
    inverse[..., 3, 3] = 1
    return inverse


def project_points(
    points: Float[Tensor, "*n 3"], K: Float[Tensor, "3 3"], *, min_depth: float | None = None
) -> Float[Tensor, "*n 2"]:
    """Pixels (fx·x/z + cx, fy·y/z + cy) of points in camera axes; not finite where z = 0.

    A point behind the camera has the pixel of its mirror image −x in front of it, so that `unproject_points` with its
    negative depth gives it back. With `min_depth` z is raised to it first: such points leave the image sideways.
    """
    x, y, z = points.unbind(dim=-1)
    if min_depth is not None:
        z = z.clamp(min=min_depth)
    # Rows of u and of v, several times faster to write and to read than pairs.
    return torch.stack((K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2])).movedim(0, -1)


def unproject_points(
    pixels: Float[Tensor, "*n 2"], depths: Float[Tensor, "*n"], K: Float[Tensor, "3 3"]
) -> Float[Tensor, "*n 3"]:
    """Points in camera axes of pixels at depths z: the inverse of `project_points`."""
    u, v = pixels.unbind(dim=-1)
    return torch.stack(((u - K[0, 2]) / K[0, 0] * depths, (v - K[1, 2]) / K[1, 1] * depths, depths), dim=-1)


def project(
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    scales: Float[Tensor, "N 3"],
    opacities: Float[Tensor, " N"],
    cam_from_world: Float[Tensor, "4 4"],
    K: Float[Tensor, "3 3"],
    width: int,
    height: int,
    *,
    eps2d: float = 0.3,
    near: float = 0.01,
) -> Projected:
    """Perspective EWA splatting (Zwicker et al. 2001) with gsplat's conventions.

    The Jacobian is taken at x/z and y/z clamped to 30 % of the half field of view beyond the image: without that, a
    Gaussian just next to the camera covers the whole image. `eps2d` pixels² are added to both variances. Depths up to
    `near` are left out.
    """
    rotation = cam_from_world[:3, :3]
    x, y, z = transform(cam_from_world, means).unbind(dim=-1)
    front = z > near
    # Rows behind the near plane are masked out; a harmless depth keeps their arithmetic, and its gradient, finite.
    z = torch.where(front, z, torch.ones_like(z))
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    slack_x, slack_y = 0.15 * width / fx, 0.15 * height / fy
    tx = torch.minimum(torch.maximum(x / z, -(cx / fx + slack_x)), (width - cx) / fx + slack_x)
    ty = torch.minimum(torch.maximum(y / z, -(cy / fy + slack_y)), (height - cy) / fy + slack_y)
    inv_z = 1 / z
    # Rows of J R S', where S' = R_g diag(s): the two image-plane rows of the square root of the 2D covariance.
    half = rotation @ (rotmats_from_quats(quats) * scales.unsqueeze(-2))
    row_x = (fx * inv_z).unsqueeze(-1) * (half[:, 0] - tx.unsqueeze(-1) * half[:, 2])
    row_y = (fy * inv_z).unsqueeze(-1) * (half[:, 1] - ty.unsqueeze(-1) * half[:, 2])
    xx = (row_x * row_x).sum(-1) + eps2d
    yy = (row_y * row_y).sum(-1) + eps2d
    xy = (row_x * row_y).sum(-1)
    # |row_x × row_y|² = det without the cancellation of xx·yy − xy², which a needle of aspect 10⁶ would not survive.
    # All is divided by the sum of the variances: the determinant of a Gaussian of 10¹⁰ pixels is beyond float32.
    total = xx + yy
    cross = torch.linalg.cross(row_x, row_y / total.sqrt().unsqueeze(-1))
    det = (cross * cross).sum(-1) + eps2d * (((xx - eps2d) + (yy - eps2d)) / total) + eps2d * eps2d / total
    conics = torch.stack((yy / total / det, -(xy / total) / det, xx / total / det), dim=-1)
    means2d = torch.stack((fx * x * inv_z + cx, fy * y * inv_z + cy), dim=-1)
    visible = opacities > ALPHA_MIN
    mahalanobis2 = torch.where(visible, 2 * torch.log(opacities.clamp(min=ALPHA_MIN) / ALPHA_MIN), 0)
    extents = torch.sqrt(mahalanobis2.unsqueeze(-1) * torch.stack((xx, yy), dim=-1))
    limit = torch.tensor([width, height], dtype=means.dtype, device=means.device)
    inside = ((means2d + extents > 0) & (means2d - extents < limit)).all(dim=-1)
    return Projected(means2d, conics, z, mahalanobis2, extents, front & visible & inside)


def sh_basis(directions: Float[Tensor, "n 3"], degree: int) -> Float[Tensor, "n K"]:
    """Real spherical harmonics of unit directions from the camera, in world axes, up to `degree` ≤ 3, in the order and
    signs of the INRIA files."""
    x, y, z = directions.unbind(dim=-1)
    pi = math.pi
    columns = [torch.full_like(x, SH_C0)]
    if degree >= 1:
        c = math.sqrt(3 / (4 * pi))
        columns += [-c * y, c * z, -c * x]
    if degree >= 2:
        c = math.sqrt(15 / (4 * pi))
        zz = math.sqrt(5 / (16 * pi)) * (3 * z * z - 1)
        columns += [c * x * y, -c * y * z, zz, -c * x * z, c / 2 * (x * x - y * y)]
    if degree >= 3:
        c33, c32 = math.sqrt(35 / (32 * pi)), math.sqrt(105 / (4 * pi))
        c31, c30 = math.sqrt(21 / (32 * pi)), math.sqrt(7 / (16 * pi))
        columns += [
            -c33 * y * (3 * x * x - y * y),
            c32 * x * y * z,
            -c31 * y * (5 * z * z - 1),
            c30 * z * (5 * z * z - 3),
            -c31 * x * (5 * z * z - 1),
            c32 / 2 * z * (x * x - y * y),
            -c33 * x * (x * x - 3 * y * y),
        ]
    return torch.stack(columns, dim=-1)


def colors_from_sh(
    sh: Float[Tensor, "n K 3"], means: Float[Tensor, "n 3"], camera_center: Float[Tensor, "3"]
) -> Float[Tensor, "n 3"]:
    """View-dependent colors in [0, ∞): Σ_k Y_k(direction)·sh_k + ½, negative values cut at 0."""
    directions = means - camera_center
    directions = directions / torch.sqrt((directions * directions).sum(-1, keepdim=True) + 1e-24)
    basis = sh_basis(directions, math.isqrt(sh.shape[1]) - 1)
    return ((basis.unsqueeze(-1) * sh).sum(dim=1) + 0.5).clamp(min=0)
