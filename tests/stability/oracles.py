"""What routines should give: definitions written out in extended precision (64 bits of mantissa), for small cases.

They share no code with the package, and take float32 arrays as exact numbers.
"""

from typing import NamedTuple

import numpy as np

from gsencoder.types import Cameras, Gaussians

Wide = np.longdouble
ALPHA_MIN, ALPHA_MAX, STOP, EPS2D, NEAR = Wide(1) / 255, Wide("0.999"), Wide("1e-4"), Wide("0.3"), Wide("0.01")


class Plane(NamedTuple):
    """Gaussians on the image plane; see geometry.Projected."""

    means2d: np.ndarray
    conics: np.ndarray
    depths: np.ndarray
    extents: np.ndarray
    valid: np.ndarray


def rotations(quats: np.ndarray) -> np.ndarray:
    """Rotation matrices of quaternions wxyz of any length."""
    q = quats.astype(Wide)
    w, x, y, z = (q / np.sqrt((q * q).sum(-1, keepdims=True))).T
    rows = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    return np.moveaxis(np.array(rows, Wide), -1, 0)


def covariances(quats: np.ndarray, scales: np.ndarray) -> np.ndarray:
    half = rotations(quats) * scales.astype(Wide)[:, None, :]
    return half @ half.swapaxes(1, 2)


def project(g: Gaussians, cameras: Cameras, view: int = 0) -> Plane:
    """EWA splatting: J R Σ Rᵀ Jᵀ + EPS2D, with the Jacobian at clamped directions, and its inverse."""
    pose, K = cameras.cam_from_world[view].astype(Wide), cameras.Ks[view].astype(Wide)
    width, height = int(cameras.widths[view]), int(cameras.heights[view])
    local = g.means.astype(Wide) @ pose[:3, :3].T + pose[:3, 3]
    front = local[:, 2] > NEAR
    x, y, z = np.where(front[:, None], local, 1).T
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    slack_x, slack_y = Wide("0.15") * width / fx, Wide("0.15") * height / fy
    tx = np.clip(x / z, -(cx / fx + slack_x), (width - cx) / fx + slack_x)
    ty = np.clip(y / z, -(cy / fy + slack_y), (height - cy) / fy + slack_y)
    half = pose[:3, :3] @ (rotations(g.quats) * g.scales.astype(Wide)[:, None, :])
    u = (fx / z)[:, None] * (half[:, 0] - tx[:, None] * half[:, 2])
    v = (fy / z)[:, None] * (half[:, 1] - ty[:, None] * half[:, 2])
    xx, yy, xy = (u * u).sum(1) + EPS2D, (v * v).sum(1) + EPS2D, (u * v).sum(1)
    # Lagrange's identity: |u|²|v|² − (u·v)² is a sum of squares.
    wedge = sum((u[:, i] * v[:, j] - u[:, j] * v[:, i]) ** 2 for i, j in ((0, 1), (0, 2), (1, 2)))
    det = wedge + EPS2D * (xx + yy) - EPS2D**2
    opacity = g.opacities.astype(Wide)
    r2 = np.where(opacity > ALPHA_MIN, 2 * np.log(np.maximum(opacity, ALPHA_MIN) / ALPHA_MIN), 0)
    means2d = np.stack([fx * x / z + cx, fy * y / z + cy], axis=1)
    extents = np.sqrt(r2[:, None] * np.stack([xx, yy], axis=1))
    touches = ((means2d + extents > 0) & (means2d - extents < np.array([width, height]))).all(axis=1)
    valid = front & (opacity > ALPHA_MIN) & touches
    return Plane(means2d, np.stack([yy, -xy, xx], axis=1) / det[:, None], local[:, 2], extents, valid)


EDGE = 1e-4
"""Relative distance from a threshold of compositing within which float32 may fall to either side of it."""


def blend(g: Gaussians, cameras: Cameras, pixels: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Weights [pixels, N] of single rays at pixel centers, row-major and dense; and which pixels are on no edge of a
    threshold."""
    plane = project(g, cameras)
    width, height = int(cameras.widths[0]), int(cameras.heights[0])
    if pixels is None:
        pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1).reshape(-1, 2)
    weights = np.zeros((len(pixels), len(g)), Wide)
    through = np.ones(len(pixels), Wide)
    open_, clear = np.ones(len(pixels), bool), np.ones(len(pixels), bool)
    rows = np.flatnonzero(plane.valid)
    for i in rows[np.argsort(plane.depths[rows], kind="stable")]:
        a, b, c = plane.conics[i]
        du, dv = (pixels.astype(Wide) - plane.means2d[i]).T
        falloff = np.exp(-(a * du * du + c * dv * dv) / 2 - b * du * dv)
        alpha = np.minimum(g.opacities[i].astype(Wide) * falloff, ALPHA_MAX)
        met = open_ & (alpha >= ALPHA_MIN)
        clear &= ~open_ | (np.abs(alpha / ALPHA_MIN - 1) > EDGE)
        clear &= ~met | (np.abs(through * (1 - alpha) / STOP - 1) > EDGE)
        closes = met & (through * (1 - alpha) <= STOP)
        open_ &= ~closes
        met &= ~closes
        weights[met, i] = (alpha * through)[met]
        through[met] *= (1 - alpha)[met]
    return weights, clear


def harmonics(directions: np.ndarray) -> np.ndarray:
    """Real spherical harmonics to degree 3 of directions of any length but 0, from their cartesian definition."""
    d = directions.astype(Wide)
    x, y, z = (d / np.sqrt((d * d).sum(1, keepdims=True))).T
    pi = Wide("3.14159265358979323846")
    root = np.sqrt
    columns = [
        np.full_like(x, root(1 / (4 * pi))),
        *(-root(3 / (4 * pi)) * y, root(3 / (4 * pi)) * z, -root(3 / (4 * pi)) * x),
        *(root(15 / (4 * pi)) * x * y, -root(15 / (4 * pi)) * y * z),
        root(5 / (16 * pi)) * (2 * z * z - x * x - y * y),
        *(-root(15 / (4 * pi)) * x * z, root(15 / (16 * pi)) * (x * x - y * y)),
        -root(35 / (32 * pi)) * y * (3 * x * x - y * y),
        root(105 / (4 * pi)) * x * y * z,
        -root(21 / (32 * pi)) * y * (4 * z * z - x * x - y * y),
        root(7 / (16 * pi)) * z * (2 * z * z - 3 * x * x - 3 * y * y),
        -root(21 / (32 * pi)) * x * (4 * z * z - x * x - y * y),
        root(105 / (16 * pi)) * z * (x * x - y * y),
        -root(35 / (32 * pi)) * x * (x * x - 3 * y * y),
    ]
    return np.stack(columns, axis=1)


def softmax_mean(scores: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Σ softmax(scores)·values over the last axis of the scores."""
    scores = scores.astype(Wide)
    weights = np.exp(scores - scores.max(axis=-1, keepdims=True))
    return weights @ values.astype(Wide) / weights.sum(axis=-1, keepdims=True)


def close(points: np.ndarray, eps: float) -> np.ndarray:
    """Which pairs of float32 points are within a distance: differences are exact in longdouble."""
    p = points.astype(Wide)
    return sum((p[:, None, axis] - p[None, :, axis]) ** 2 for axis in range(3)) <= Wide(eps) ** 2


def dbscan(points: np.ndarray, eps: float, min_samples: int) -> np.ndarray:
    """Labels by comparing all pairs; clusters are numbered in the order of their first core points."""
    near = close(points, eps)
    core = near.sum(1) >= min_samples
    labels = np.full(len(points), -1)
    for start in np.flatnonzero(core):
        if labels[start] >= 0:
            continue
        label, queue = labels.max(initial=-1) + 1, [start]
        labels[start] = label
        while queue:
            for other in np.flatnonzero(near[queue.pop()]):
                if labels[other] < 0:
                    labels[other] = label
                    if core[other]:
                        queue.append(other)
    return labels


def interleave(cell: tuple[int, int, int]) -> int:
    """Morton code of a cell, a bit at a time."""
    return sum(((cell[axis] >> bit) & 1) << (3 * bit + 2 - axis) for bit in range(21) for axis in range(3))
