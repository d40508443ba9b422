"""What is missing where an object was taken out of a scene."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool

from gsencoder.core.process import Track, untracked
from gsencoder.infer.select.votes import DOMINANT, Sampling
from gsencoder.types import Cameras, Gaussians

OPAQUE = 0.5
"""Alpha below which a pixel counts as empty."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Hole:
    """Pixels of one view that are empty after the removal and were not before.

    Attributes:
        view: row number.
        pixels: how many.
        removed: how many pixels the removed Gaussians dominated.
        area: of the hole at the depth of the surface that was there, in world units².
    """

    view: int
    pixels: int
    removed: int
    area: float


def find_holes(
    gaussians: Gaussians,
    cameras: Cameras,
    removed: Bool[np.ndarray, " N"],
    chosen: Sampling,
    *,
    track: Track = untracked,
) -> list[Hole]:
    """The hole in each view that shows what is removed.

    A pixel is a part of the hole if more than half of its opacity was of the removed Gaussians, its alpha was one half
    or more, and is less without them. It covers z² / (fx·fy) of a surface at depth z that faces the camera.

    Args:
        gaussians: the whole splat.
        cameras: in the same world.
        removed: which Gaussians are taken out.
        chosen: which pixels are looked at; numbers are those of the whole view.
        track: progress over the views.
    """
    rest = gaussians.select(~removed)
    values = torch.from_numpy(removed.astype(np.float32))
    holes = []
    for view in track(chosen.views, "views without the object"):
        before = chosen.blend(gaussians, cameras, view)
        gone = (before.render(values) > DOMINANT * before.alpha) & (before.alpha >= OPAQUE)
        if not gone.any():
            continue
        after = chosen.blend(rest, cameras, view)
        empty = gone & (after.alpha < OPAQUE)
        each = chosen.stride(cameras, view) ** 2
        K = cameras.Ks[view].astype(np.float64)
        z = before.median_depth[empty].double()
        holes.append(
            Hole(
                view=view,
                pixels=int(empty.sum()) * each,
                removed=int(gone.sum()) * each,
                area=float((z**2).sum()) * each / float(K[0, 0] * K[1, 1]),
            )
        )
    return holes
