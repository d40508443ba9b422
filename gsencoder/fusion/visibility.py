"""Occlusion tests: whether a Gaussian is at the depth of a depth map, or behind it."""

from dataclasses import dataclass, field, replace
from typing import Literal, no_type_check

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int32, Int64

from gsencoder.core.errors import InputError
from gsencoder.core.process import kernel
from gsencoder.render import Blend
from gsencoder.render.rays import Lattice
from gsencoder.types import Views

Source = Literal["auto", "sensor", "rendered"]


@dataclass(frozen=True, slots=True, kw_only=True)
class VisibilityConfig:
    """Which depth maps a Gaussian is held against, and how near it must be; all chosen tests must pass."""

    against: tuple[Source, ...] = field(
        default=("auto",),
        metadata={
            "help": "depth maps to test against: sensor, rendered; auto = sensor if there, else rendered if lift=center"
        },
    )
    relative: float = field(default=0.02, metadata={"help": "largest |d − z| as a share of d; 0 = not tested"})
    absolute: float = field(default=0.0, metadata={"help": "largest |d − z| in world units; 0 = not tested"})

    def __post_init__(self) -> None:
        for name in ("relative", "absolute"):
            if not 0 <= getattr(self, name) <= 1e12:
                raise InputError(f"{name}: expected a tolerance from 0 to 1e12, got {getattr(self, name)}")
        if self.against and not (self.relative or self.absolute):
            raise InputError("against: a test against a depth map needs relative or absolute above 0; [] = no test")


def resolve(config: VisibilityConfig, views: Views, lift: str) -> VisibilityConfig:
    """The same with "auto" replaced: sensor depth where there is one; else rendered depth for centers, which see
    through walls without a test, and none for B, whose weights are what is left behind other Gaussians.

    Raises:
        InputError: a test against sensor depth in a scene without.
    """
    has_depth = views.depths is not None
    if "sensor" in config.against and not has_depth:
        raise InputError(
            "visibility.against=sensor: the scene has no sensor depth; test against rendered depth instead"
        )
    automatic: tuple[Source, ...] = ("sensor",) if has_depth else ("rendered",) if lift == "center" else ()
    against = [name for source in config.against for name in (automatic if source == "auto" else (source,))]
    return replace(config, against=tuple(dict.fromkeys(against)))


def _interval(
    low: np.ndarray, high: np.ndarray, config: VisibilityConfig
) -> tuple[Float32[np.ndarray, " n"], Float32[np.ndarray, " n"]]:
    """The depths that pass beside measured ones from `low` to `high`.

    Depth 0 means none: such rays say nothing was measured there, and nothing passes (as in OpenScene).
    """
    least, most = np.zeros(low.shape), np.full(low.shape, np.inf)
    if config.relative:
        least, most = low * (1.0 - config.relative), high * (1.0 + config.relative)
    if config.absolute:
        least, most = np.maximum(least, low - config.absolute), np.minimum(most, high + config.absolute)
    most = np.where(high > 0, most, -np.inf)
    return least.astype(np.float32), most.astype(np.float32)


def visible_points(
    z: Float32[np.ndarray, " n"],
    pixels: Int64[np.ndarray, "n 2"],
    depth: Float32[np.ndarray, "H W"],
    config: VisibilityConfig,
) -> Bool[np.ndarray, " n"]:
    """Tests Gaussians' centers at their own pixel (x, y), which must lie inside the map."""
    d = depth[pixels[:, 1], pixels[:, 0]]
    least, most = _interval(d, d, config)
    return (z >= least) & (z <= most)


def visible_depths(
    depth: Float32[np.ndarray, "H W"], lattice: Lattice, config: VisibilityConfig
) -> tuple[Float32[np.ndarray, " P"], Float32[np.ndarray, " P"]]:
    """The smallest and the largest depth that pass in each row: entries are held against the depths that the row's rays
    meet, from the nearest to the farthest of them."""
    return _interval(*_row_range(depth, lattice), config)


def keep_visible(b: Blend, depth: Float32[np.ndarray, "H W"], config: VisibilityConfig) -> Blend:
    """B without the entries that fail (`visible_depths`)."""
    least, most = visible_depths(depth, b.lattice, config)
    device = b.weight.device
    return b.keep_between(torch.from_numpy(least).to(device), torch.from_numpy(most).to(device))


def ray_pixels(lattice: Lattice, width: int, height: int) -> tuple[Int32[np.ndarray, " j"], Int32[np.ndarray, " i"]]:
    """Pixel row and column that each line of rays falls into, clipped to the image."""
    y = np.floor(lattice.y0 + lattice.dy * np.arange(lattice.height * lattice.side)).clip(0, height - 1)
    x = np.floor(lattice.x0 + lattice.dx * np.arange(lattice.width * lattice.side)).clip(0, width - 1)
    return y.astype(np.int32), x.astype(np.int32)


def _row_range(
    depth: Float32[np.ndarray, "H W"], lattice: Lattice
) -> tuple[Float32[np.ndarray, " P"], Float32[np.ndarray, " P"]]:
    """The nearest and the farthest depth that was measured on the rays of each row; 0 where none was."""
    y, x = ray_pixels(lattice, depth.shape[1], depth.shape[0])
    low, high = np.empty(lattice.rows, np.float32), np.empty(lattice.rows, np.float32)
    _measured_range(depth, y, x, lattice.width, lattice.side, low, high)
    return low, high


@kernel
@no_type_check
def _measured_range(depth, y, x, width, side, low, high):
    for row in range(len(low)):
        first_y, first_x = row // width * side, row % width * side
        nearest, farthest = np.float32(np.inf), np.float32(0)
        for i in range(first_y, first_y + side):
            for j in range(first_x, first_x + side):
                d = depth[y[i], x[j]]
                if d > 0:
                    nearest, farthest = min(nearest, d), max(farthest, d)
        low[row], high[row] = nearest if farthest > 0 else np.float32(0), farthest


def row_mask(mask: Bool[np.ndarray, "H W"], lattice: Lattice) -> Float32[np.ndarray, " P"]:
    """Share of each row's rays that a pixel mask lets through."""
    y, x = ray_pixels(lattice, mask.shape[1], mask.shape[0])
    rays = mask[np.ix_(y, x)].reshape(lattice.height, lattice.side, lattice.width, lattice.side)
    return rays.mean(axis=(1, 3), dtype=np.float32).ravel()
