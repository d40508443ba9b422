"""Pruning during the optimization of a splat; nothing is ever added (SplatDistill, sec. 3.1)."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

import torch
from jaxtyping import Int64
from torch import Tensor

from gsencoder.core.errors import InputError
from gsencoder.data.photographs import ScaledPhotograph
from gsencoder.reconstruct.optimize_config import OptimizeConfig
from gsencoder.reconstruct.parameters import Parameters, camera_of, rows_in_view
from gsencoder.render.rasterize import RasterConfig, rasterize
from gsencoder.types import Cameras


@dataclass(frozen=True, slots=True, kw_only=True)
class PruneConfig:
    """What is taken out, and when."""

    at: tuple[float, ...] = field(
        default=(0.3, 0.6, 0.9), metadata={"help": "shares of the steps after which is pruned"}
    )
    opacity: float = field(default=0.005, metadata={"help": "opacities below are taken out"})
    screen: float = field(
        default=1.0, metadata={"help": "wider than so many times the picture's longer side in some view"}
    )
    contribution: float = field(
        default=0.1, metadata={"help": "less than so many pixels' worth in every photograph, at its full size"}
    )

    def __post_init__(self) -> None:
        if any(not 0 < share <= 1 for share in self.at):
            raise InputError(f"at: expected shares in (0, 1], got {self.at}")
        for name in ("opacity", "screen", "contribution"):
            if not 0 <= getattr(self, name) < math.inf:
                raise InputError(f"{name}: expected 0 or more, got {getattr(self, name)}")

    def due(self, step: int, schedule: OptimizeConfig) -> bool:
        """Whether is pruned after `step` steps; small shares are of the first step."""
        return any(schedule.completes(share, step) for share in self.at)


def rows_to_keep(
    raw: Parameters,
    cameras: Cameras,
    views: Iterable[tuple[int, ScaledPhotograph]],
    config: PruneConfig,
    raster: RasterConfig,
    *,
    most: int | None = None,
) -> Int64[Tensor, " n"]:
    """Rows that are opaque enough, of sane size on every screen, and seen somewhere.

    A splat's contribution to a view is its column sum of B. Rendering is linear in the colors, so that is the
    gradient of the sum of a picture in which every color is 1.

    Args:
        raw: parameters.
        cameras: of all views.
        views: photographs that count, at any size, gone through once.
        config: settings.
        raster: accuracy of rendering.
        most: so many rows are left at most, those that contribute most to some view; None = no limit.

    Raises:
        InputError: nothing would be left.
    """
    means = raw["means"]
    opacities = raw["logit_opacities"].sigmoid()
    contributions, max_widths = torch.zeros_like(opacities), torch.zeros_like(opacities)
    for view, photo in views:
        pose, _ = camera_of(cameras, view, means.device)
        K = photo.K.to(means.device)
        pixels = float(cameras.Ks[view, 0, 0] / photo.K[0, 0]) ** 2
        rows = rows_in_view(raw, pose, K, photo.width, photo.height, near=raster.near, eps2d=raster.eps2d)
        if not len(rows):
            continue
        ones = torch.ones(len(rows), 3, device=means.device, requires_grad=True)
        shape = (means[rows], raw["quats"][rows], raw["log_scales"][rows].exp(), opacities[rows])
        seen = rasterize(*shape, ones, pose, K, photo.width, photo.height, config=raster)
        (sums,) = torch.autograd.grad(seen.rgb[..., 0].sum(), ones)
        contributions[rows] = torch.maximum(contributions[rows], pixels * sums[:, 0])
        max_widths[rows] = torch.maximum(max_widths[rows], seen.radii / max(photo.width, photo.height))
    rejected = {"opacity": opacities < config.opacity, "contribution": contributions < config.contribution}
    if config.screen:
        rejected["screen"] = max_widths > config.screen
    rows_left = (~torch.stack([*rejected.values()]).any(dim=0)).nonzero().squeeze(1)
    if not len(rows_left):
        why = ", ".join(
            f"{int(rows.sum())} by prune.{name}={getattr(config, name):g}"
            for name, rows in rejected.items()
            if rows.any()
        )
        raise InputError(f"reconstruct: pruning would leave none of {len(means)} Gaussians ({why}); change these")
    if most is not None and len(rows_left) > most:
        by_contribution = contributions[rows_left].argsort(descending=True, stable=True)
        rows_left = rows_left[by_contribution[:most]].sort().values
    return rows_left
