"""How much of each view some Gaussians fill, roughly: discs in a small depth buffer instead of blended ellipses.

A hundred views of a million Gaussians take a second, where blending them takes half a minute. It is good enough to tell
which views are worth a closer look.
"""

import math
from collections.abc import Sequence
from typing import no_type_check

import numpy as np
from jaxtyping import Float64, Integer

from gsencoder.core.process import kernel, parallel
from gsencoder.types import Cameras, Gaussians

OPAQUE = 0.3
"""Gaussians of less opacity hide nothing and fill nothing."""
RADIUS = 1.5
"""Radius of a disc in standard deviations along the Gaussian's middle axis."""
MAX_RADIUS = 8.0
"""… and at most so many pixels."""
BEHIND = 1.03
"""What lies behind the nearest disc of a pixel by less than this factor is seen there."""
MAX_HIDING = 250_000
"""Of more Gaussians, a random choice of so many hides what is behind them."""
NEAR = 1e-3
"""Share of the median distance from cameras to Gaussians within which nothing is drawn."""


def visible_shares(
    gaussians: Gaussians, cameras: Cameras, groups: Sequence[Integer[np.ndarray, "_n"]]
) -> Float64[np.ndarray, "V Q"]:
    """The share of the pixels of each view in which a Gaussian of each group is the nearest, or nearly.

    Args:
        gaussians: the splat.
        cameras: small pictures; the cost is one pass over all Gaussians for each.
        groups: rows of Gaussians.
    """
    radii = (RADIUS * np.median(gaussians.scales, axis=1)).astype(np.float32)
    opaque = gaussians.opacities >= OPAQUE
    rows = np.flatnonzero(opaque)
    if len(rows) > MAX_HIDING:
        # Fewer, larger discs hide the same.
        rows = np.sort(np.random.default_rng(0).choice(rows, MAX_HIDING, replace=False))
        growth = math.sqrt(opaque.sum() / MAX_HIDING)
    else:
        growth = 1.0
    chosen = [np.asarray(group, np.int64)[opaque[group]] for group in groups]
    starts = np.concatenate(([0], np.cumsum([len(group) for group in chosen]))).astype(np.int64)
    members = np.concatenate([np.empty(0, np.int64), *chosen])
    poses, Ks = cameras.cam_from_world.astype(np.float64), cameras.Ks.astype(np.float64)

    def work(view: int) -> np.ndarray:
        size = int(cameras.widths[view]), int(cameras.heights[view])
        distances = np.linalg.norm(gaussians.means[:: max(1, len(gaussians) // 1000)] - cameras.centers[view], axis=1)
        near = NEAR * float(np.median(distances)) if len(distances) else 0.0
        return np.asarray(
            _shares(gaussians.means, radii, rows, growth, members, starts, poses[view], Ks[view], size, near)
        )

    return np.stack([np.zeros(len(groups)), *parallel(work, range(len(cameras)))])[1:]


@kernel
@no_type_check
def _shares(means, radii, rows, growth, members, starts, pose, K, size, near):
    width, height = size
    nearest = np.full((height, width), np.inf)
    for k in range(len(rows)):
        z, left, right, top, bottom = _disc(means, growth * radii[rows[k]], rows[k], pose, K, width, height, near)
        for y in range(top, bottom + 1):
            for x in range(left, right + 1):
                nearest[y, x] = min(nearest[y, x], z)
    shares = np.zeros(len(starts) - 1)
    for group in range(len(starts) - 1):
        filled = np.zeros((height, width), np.bool_)
        for k in range(starts[group], starts[group + 1]):
            z, left, right, top, bottom = _disc(means, radii[members[k]], members[k], pose, K, width, height, near)
            for y in range(top, bottom + 1):
                for x in range(left, right + 1):
                    if z <= BEHIND * nearest[y, x]:
                        filled[y, x] = True
        shares[group] = filled.sum() / (width * height)
    return shares


@kernel
@no_type_check
def _disc(means, radius, row, pose, K, width, height, near):
    """Depth and pixel bounds of the square around a disc; empty bounds where it is not in the picture."""
    x, y, z = np.float64(means[row, 0]), np.float64(means[row, 1]), np.float64(means[row, 2])
    depth = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
    if not depth > near:
        return depth, 0, -1, 0, -1
    u = K[0, 0] * (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]) / depth + K[0, 2]
    v = K[1, 1] * (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]) / depth + K[1, 2]
    reach = min(K[0, 0] * radius / depth, MAX_RADIUS)
    if not (u + reach >= 0 and v + reach >= 0 and u - reach < width and v - reach < height):
        return depth, 0, -1, 0, -1
    # A pixel is covered if the disc's square holds its center; the smallest covers the one that it lies in.
    left, right = math.ceil(u - reach - 0.5), math.floor(u + reach - 0.5)
    top, bottom = math.ceil(v - reach - 0.5), math.floor(v + reach - 0.5)
    if left > right:
        left = right = math.floor(u)
    if top > bottom:
        top = bottom = math.floor(v)
    return depth, max(left, 0), min(right, width - 1), max(top, 0), min(bottom, height - 1)
