"""Rendered images of a splat: colors from SH, composited by a Blend, their PSNR and SSIM, the map of their colors to
those of a photograph, and how much of a view some Gaussians fill, roughly."""

import math
from collections.abc import Sequence
from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Integer, UInt8
from torch import Tensor

from gsencoder.core.errors import InputError
from gsencoder.core.threads import kernel, parallel
from gsencoder.geometry import colors_from_sh
from gsencoder.render.blend import Blend, BlendConfig, blend
from gsencoder.types import Cameras, Gaussians


def view_colors(gaussians: Gaussians, cameras: Cameras, view: int) -> Float[torch.Tensor, "N 3"]:
    """Colors of all Gaussians as this camera sees them, in [0, ∞)."""
    sh, means = torch.as_tensor(gaussians.sh), torch.as_tensor(gaussians.means)
    if gaussians.sh_degree == 0:
        # Degree 0 does not depend on the direction; one direction for all saves the rest.
        means = torch.zeros(1, 3).expand(len(gaussians), 3)
        return colors_from_sh(sh, means, torch.ones(3))
    return colors_from_sh(sh, means, torch.as_tensor(cameras.centers[view], dtype=torch.float32))


def render_image(
    gaussians: Gaussians,
    cameras: Cameras,
    view: int,
    *,
    blended: Blend | None = None,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    config: BlendConfig = BlendConfig(),
) -> UInt8[np.ndarray, "H W 3"]:
    """One view in color, over a background of RGB in [0, 1]; `blended` is its pixel blend, where there is one."""
    b = blended if blended is not None else blend(gaussians, cameras, view, config=config)
    rgb = b.render(view_colors(gaussians, cameras, view)) + (1 - b.alpha).unsqueeze(1) * torch.tensor(background)
    return (rgb.clamp(0, 1) * 255 + 0.5).to(torch.uint8).reshape(*b.shape, 3).numpy()


class RenderedImages(Sequence[UInt8[np.ndarray, "H W 3"]]):
    """Pictures of a splat through each of its cameras, rendered on access: photographs for a splat that has none."""

    def __init__(self, gaussians: Gaussians, cameras: Cameras, config: BlendConfig = BlendConfig()) -> None:
        self.gaussians, self.cameras, self.config = gaussians, cameras, config

    def __len__(self) -> int:
        return len(self.cameras)

    def __getitem__(self, view: int) -> UInt8[np.ndarray, "H W 3"]:  # type: ignore[override]
        if not -len(self) <= view < len(self):
            raise IndexError(view)
        return render_image(self.gaussians, self.cameras, view, config=self.config)


WINDOW, SIGMA = 11, 1.5
BLOCK = 32
C1, C2 = 0.01**2, 0.03**2


def psnr(
    picture: Float[Tensor, "H W 3"], truth: Float[Tensor, "H W 3"], mask: Bool[Tensor, "H W"] | None = None
) -> float:
    """Peak signal-to-noise ratio in dB of pictures in [0, 1]; over the pixels of `mask` where one is given."""
    error = (picture.clamp(0, 1) - truth).double().square()
    mean = float((error if mask is None else error[mask]).mean())
    return -10 * math.log10(max(mean, 1e-12))


def ssim_map(picture: Float[Tensor, "H W 3"], truth: Float[Tensor, "H W 3"]) -> Float[Tensor, "h w 3"]:
    """Structural similarity (Wang et al. 2004) of pictures in [0, 1]: 11 × 11 windows weighted by a Gaussian of 1.5
    pixels, at the H − 10 by W − 10 places where the window lies inside."""
    if min(picture.shape[:2]) < WINDOW:
        raise InputError(f"ssim: expected pictures of at least {WINDOW} pixels a side, got {tuple(picture.shape[:2])}")
    x, y = picture.permute(2, 0, 1), truth.permute(2, 0, 1)
    blurred = _blur(_blur(torch.cat((x, y, x * x, y * y, x * y))).mT).mT
    mean_x, mean_y, xx, yy, xy = blurred.split(3)
    product, squares = mean_x * mean_y, mean_x * mean_x + mean_y * mean_y
    structure = (2 * (xy - product) + C2) / (xx + yy - squares + C2)
    return ((2 * product + C1) / (squares + C1) * structure).permute(1, 2, 0)


def _blur(maps: Float[Tensor, "n h w"]) -> Float[Tensor, "n h w_minus_10"]:
    """Every line's inner products with the window. A line is cut into overlapping blocks, and all blocks multiplied by
    one small banded matrix: on a CPU that is some ten times faster than a convolution of one channel."""
    width = maps.shape[-1] - WINDOW + 1
    offsets = torch.arange(WINDOW, device=maps.device, dtype=maps.dtype) - WINDOW // 2
    weights = torch.exp(-0.5 * (offsets / SIGMA) ** 2)
    band = maps.new_zeros(BLOCK + WINDOW - 1, BLOCK)
    for shift, weight in enumerate(weights / weights.sum()):
        band.diagonal(-shift).fill_(weight)
    blocks = torch.nn.functional.pad(maps, (0, -width % BLOCK)).unfold(-1, BLOCK + WINDOW - 1, BLOCK)
    return (blocks.reshape(-1, BLOCK + WINDOW - 1) @ band).reshape(*maps.shape[:-1], -1)[..., :width]


def ssim(
    picture: Float[Tensor, "H W 3"], truth: Float[Tensor, "H W 3"], mask: Bool[Tensor, "H W"] | None = None
) -> Float[Tensor, ""]:
    """Mean structural similarity; over the windows whose middle is in `mask` where one is given."""
    similarity = ssim_map(picture, truth)
    if mask is None:
        return similarity.mean()
    return similarity[inner(mask)].mean()


def inner(mask: Bool[Tensor, "H W"]) -> Bool[Tensor, "h w"]:
    """The pixels that are the middle of a window inside the picture."""
    edge = WINDOW // 2
    return mask[edge:-edge, edge:-edge]


IDENTITY = torch.eye(3, 4)  # The affine map of colors that changes none
RIDGE = 1e-3
"""Pull toward the identity, as a variance of colors in [0, 1]: what a picture does not vary in is not fitted."""
COVERED = 0.5
"""Pixels of a render below this alpha show the background, and tell nothing."""


@torch.no_grad()
def fitted_colors(
    render: Float[Tensor, "H W 3"], image: Float[Tensor, "H W 3"], mask: Bool[Tensor, "H W"]
) -> Float[Tensor, "3 4"]:
    """The affine map A·c + b of the render's colors that is nearest to the photograph's in a mask, by ridge regression:
    A in the first three columns and b in the last, on the CPU; the identity where the mask is empty."""
    weights = mask.unsqueeze(-1).to(render.dtype)
    inputs = torch.cat((render, torch.ones_like(render[..., :1])), dim=-1) * weights
    rows, residuals = inputs.flatten(0, 1), ((image - render) * weights).flatten(0, 1)
    count = float(mask.sum().clamp(min=1))
    gram, moments = ((rows.T @ other).double().cpu() / count for other in (rows, residuals))
    change = torch.linalg.solve(gram + RIDGE * torch.eye(4, dtype=torch.float64), moments)
    return IDENTITY + change.T.float()


def apply_colors(colors: Float[Tensor, "H W 3"], affine: Float[Tensor, "3 4"]) -> Float[Tensor, "H W 3"]:
    """A·c + b for each pixel."""
    affine = affine.to(colors)
    return colors @ affine[:, :3].T + affine[:, 3]


def compared_pixels(alpha: Float[Tensor, "H W"], mask: Bool[Tensor, "H W"] | None) -> Bool[Tensor, "H W"]:
    """Pixels whose colors are compared: what the splat covers and the mask leaves."""
    covered = alpha > COVERED
    return covered if mask is None else covered & mask.to(covered.device)


OPAQUE = 0.3
"""Gaussians of less opacity hide nothing and fill nothing."""
RADIUS = 1.5
"""Radius of a disc in standard deviations along the Gaussian's middle axis."""
MAX_RADIUS = 8.0
"""… and at most this many pixels."""
BEHIND = 1.03
"""What lies behind the nearest disc of a pixel by less than this factor is seen there."""
MAX_HIDING = 250_000
"""Of more Gaussians, a random choice of this many hides what is behind them."""
NEAR = 1e-3
"""Share of the median distance from cameras to Gaussians within which nothing is drawn."""


def visible_shares(
    gaussians: Gaussians, cameras: Cameras, groups: Sequence[Integer[np.ndarray, "_n"]]
) -> Float64[np.ndarray, "V Q"]:
    """The share of the pixels of each view in which a Gaussian of each group is the nearest, or nearly, by discs in a
    small depth buffer instead of blended ellipses.

    A hundred views of a million Gaussians take a second, where blending them takes half a minute. It is good enough to
    tell which views are worth a closer look.
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
    centers = cameras.centers

    def work(view: int) -> np.ndarray:
        size = int(cameras.widths[view]), int(cameras.heights[view])
        distances = np.linalg.norm(gaussians.means[:: max(1, len(gaussians) // 1000)] - centers[view], axis=1)
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
