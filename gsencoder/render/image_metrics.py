"""Image metrics: PSNR, and SSIM as a differentiable function."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gsencoder.core.errors import InputError

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
    pixels, at the H − 10 by W − 10 places where the window lies inside.

    Raises:
        InputError: a picture smaller than the window.
    """
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
