"""On whose pixels the blending weight of each Gaussian falls.

With the matrix B of a view and the labels of all Gaussians, the pixels have the label that more than half of their
opacity is of. Bᵀ then sums, for each Gaussian, its blending weight over the pixels of each label. A half-transparent
Gaussian before an object, or one of a rim, has all its weight in the pixels of the object; so has the table below a
cup, in the little weight that is left behind the cup. Entries that lie behind the surface of their pixel are therefore
left out.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Int32

from gsencoder.core.arrays import even_indices
from gsencoder.core.process import Track, untracked
from gsencoder.infer.select.selection import Votes
from gsencoder.render import Blend, BlendConfig, blend
from gsencoder.types import Cameras, Gaussians

DOMINANT = 0.5
"""A pixel is of a label if more than this share of its opacity is."""
BEHIND = 0.02
"""Share of the depth of a pixel's surface by which an entry may lie behind it, beside one spacing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Sampling:
    """Which pixels of a scene are looked at.

    Attributes:
        views: row numbers of the views.
        pixels: most pixels of a view.
    """

    views: tuple[int, ...]
    pixels: int

    def stride(self, cameras: Cameras, view: int) -> int:
        """The step between pixels of a view, in both directions."""
        return max(1, math.ceil(math.sqrt(int(cameras.widths[view]) * int(cameras.heights[view]) / self.pixels)))

    def blend(self, gaussians: Gaussians, cameras: Cameras, view: int, config: BlendConfig = BlendConfig()) -> Blend:
        """B of a view's pixels."""
        return blend(gaussians, cameras, view, stride=self.stride(cameras, view), config=config)


def sampling(cameras: Cameras, *, views: int, pixels: int) -> Sampling:
    """`views` views, evenly spaced, with at most about `pixels` pixels each."""
    rows = even_indices(len(cameras), views) if views and len(cameras) else np.zeros(0, np.int64)
    return Sampling(views=tuple(int(row) for row in rows), pixels=pixels)


def label_masses(b: Blend, labels: Int32[np.ndarray, " N"], count: int) -> torch.Tensor:
    """How much of each pixel's opacity is of each label from 1 to `count`: [P, count]."""
    # Gaussians of the label 0 are most of a scene, and have no column.
    one_hot = torch.zeros(len(labels), count)
    labeled = np.flatnonzero(labels)
    one_hot[torch.from_numpy(labeled), torch.from_numpy(labels[labeled].astype(np.int64) - 1)] = 1
    return b.render(one_hot)


def pixel_labels(b: Blend, labels: Int32[np.ndarray, " N"], count: int) -> Int32[torch.Tensor, " P"]:
    """The label that dominates each pixel of a view, 0 = none of them."""
    mass, best = label_masses(b, labels, count).max(dim=1)
    return torch.where(mass > DOMINANT * b.alpha, best + 1, 0).int()


def votes(
    gaussians: Gaussians,
    cameras: Cameras,
    labels: Int32[np.ndarray, " N"],
    count: int,
    chosen: Sampling,
    *,
    spacing: float,
    track: Track = untracked,
) -> Votes:
    """Where the blending weight of each Gaussian falls.

    Args:
        gaussians: the splat.
        cameras: in the same world.
        labels: of the Gaussians, 0 to `count`.
        count: the largest label there can be.
        chosen: which pixels are looked at; a pixel of every second line and column counts four times.
        spacing: entries that lie farther behind a pixel's surface than this, and a share of its depth, do not count.
        track: progress over the views.

    Returns:
        Weights over labels 0 to `count`; rows of zeros for Gaussians that no view shows.
    """
    left = np.flatnonzero(labels == 0)
    rest = gaussians.select(left)
    present = torch.zeros(len(gaussians), count + 1)
    removed = torch.zeros(len(rest), count + 1)
    for view in track(chosen.views, "views of the objects"):
        b = chosen.blend(gaussians, cameras, view)
        surface = b.median_depth
        farthest = torch.where(surface > 0, surface * (1 + BEHIND) + spacing, torch.inf)
        codes = pixel_labels(b, labels, count)
        seen = _lifted(b, farthest, codes, count) * chosen.stride(cameras, view) ** 2
        present += seen
        if codes.any():
            without = chosen.blend(rest, cameras, view)
            removed += _lifted(without, farthest, codes, count) * chosen.stride(cameras, view) ** 2
        else:
            removed += seen[torch.from_numpy(left)]
    spread = np.zeros_like(present.numpy())
    spread[left] = removed.numpy()
    return Votes(present=present.numpy(), removed=spread)


def _lifted(b: Blend, farthest: torch.Tensor, codes: torch.Tensor, count: int) -> torch.Tensor:
    sums = torch.zeros(b.gaussians, count + 1)
    b.keep_between(torch.zeros_like(farthest), farthest).lift_codes_into(codes, sums)
    return sums
