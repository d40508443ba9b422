"""Candidates among the scene's own cameras, ranked by rays before any render."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64, Int64

from gsencoder.core.arrays import even_indices
from gsencoder.infer.views.constants import CONSTANTS
from gsencoder.infer.views.free_space import FreeSpace
from gsencoder.infer.views.targets import Target
from gsencoder.types import Cameras, Gaussians


def frames_on(
    cameras: Cameras, gaussians: Gaussians, targets: Sequence[Target], count: int, spaces: Sequence[FreeSpace]
) -> Int64[np.ndarray, " n"]:
    """The frames that show most of the targets as far as a few rays tell, ascending; at most so many.

    Targets take turns. Each takes its best frames for half of the places, and for the others some from all along the
    recording, so that the frames of a film are not all neighbors.

    Args:
        cameras: the scene's.
        gaussians: the splat.
        targets: one or more.
        count: frames.
        spaces: what rays meet, one for each target, which is itself left out.
    """
    ranked = [
        _rank_frames(cameras, gaussians, target, count, free) for target, free in zip(targets, spaces, strict=True)
    ]
    turns = np.stack(ranked, axis=1).reshape(-1)
    first = np.sort(np.unique(turns, return_index=True)[1])[:count]
    return np.sort(turns[first])


def _rank_frames(
    cameras: Cameras, gaussians: Gaussians, target: Target, count: int, free: FreeSpace
) -> Int64[np.ndarray, " n"]:
    """Frames in the order in which they are taken for a target, as many as are wanted."""
    count = min(count, len(cameras))
    half = (count + 1) // 2
    filled = _fill_shares(cameras, target)
    rows = target.rows[even_indices(len(target.rows), CONSTANTS.frame_rays)]
    points = gaussians.means[rows].astype(np.float64)
    shown = np.full(len(cameras), -1.0)

    blocked = CONSTANTS.blocked_frame_weight

    def judge(views: Int64[np.ndarray, " n"]) -> None:
        for start in range(0, len(views), CONSTANTS.frame_batch):
            block = views[start : start + CONSTANTS.frame_batch]
            shown[block] = filled[block] * (blocked + (1 - blocked) * _open_fraction(cameras, block, points, free))

    order = np.argsort(-filled, kind="stable")
    for start in range(0, len(order), CONSTANTS.frame_batch):
        block = order[start : start + CONSTANTS.frame_batch]
        # No frame shows more than it would if nothing stood between: the rest is not better than what there is.
        if start >= half and filled[block[0]] <= np.sort(shown)[-half]:
            break
        judge(block)
    best = np.argsort(-shown, kind="stable")
    enough = CONSTANTS.min_spread_share * shown[best[0]]
    others = np.setdiff1d(np.flatnonzero(filled >= enough), best[:half])
    others = others[even_indices(len(others), CONSTANTS.spread_frames * count)]
    judge(others[shown[others] < 0])
    others = others[shown[others] >= enough]
    photograph_at = np.concatenate([best[:half], others[even_indices(len(others), count - half)]])
    # Whatever is missing comes from those that show less, and at last from those that no ray was sent to.
    rest = np.lexsort((-filled, -shown))
    return np.concatenate([photograph_at, rest[~np.isin(rest, photograph_at)]])[:count]


def _fill_shares(cameras: Cameras, target: Target) -> Float64[np.ndarray, " V"]:
    """The share of each picture that a target's ball fills."""
    pixels, depths = (part[:, 0] for part in cameras.project(target.center[None], min_depth=CONSTANTS.min_frame_depth))
    radius = target.radius * cameras.Ks[:, 0, 0] / np.maximum(depths, CONSTANTS.min_frame_depth)
    radius = np.minimum(radius, cameras.widths + cameras.heights)
    filled = np.ones(len(cameras))
    for position, size in zip(pixels.T, (cameras.widths, cameras.heights), strict=True):
        filled *= np.clip(np.minimum(position + radius, size) - np.maximum(position - radius, 0), 0, None) / size
    return np.where(depths > -target.radius, filled, 0)


def _open_fraction(
    cameras: Cameras, views: Int64[np.ndarray, " n"], points: Float64[np.ndarray, "p 3"], free: FreeSpace
) -> Float64[np.ndarray, " n"]:
    """The share of points that are in each picture with nothing between."""
    chosen = cameras.select(views)
    inside = chosen.in_image(*chosen.project(points))
    towards = chosen.centers[:, None] - points
    distance = np.linalg.norm(towards, axis=-1)
    towards /= np.maximum(distance, 1e-12)[..., None]
    # Rays begin beyond the cells of what the target lies on, and end before those in which the camera is.
    begins = 2 * free.cell
    starts = points + begins * towards
    hits = free.first_hit(
        starts.reshape(-1, 3), towards.reshape(-1, 3), np.maximum(distance - begins - free.cell, 0).reshape(-1)
    )
    return np.asarray((inside & np.isinf(hits).reshape(inside.shape)).mean(axis=1))
