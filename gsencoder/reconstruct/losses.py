"""The photometric loss of reconstruction, L1 + D-SSIM, and terms for measured depth and for space known to be empty."""

import torch
from jaxtyping import Float
from torch import Tensor

from gsencoder.data.photographs import ScaledPhotograph
from gsencoder.render.images import ssim
from gsencoder.render.rasterize import Raster


def losses_of(
    raster: Raster, photo: ScaledPhotograph, *, ssim_weight: float, depth_weight: float, empty_weight: float = 0.0
) -> dict[str, Float[Tensor, ""]]:
    """(1 − λ)·L1 + λ·(1 − SSIM) over the pixels of the mask, the relative error of depth where it is known, and the
    opacity where the photograph shows that nothing is there.

    Args:
        raster: a render of the view.
        photo: the photograph, with its mask and depth.
        ssim_weight: λ.
        depth_weight: of the depth term.
        empty_weight: of the opacity, which is summed as L1 is, per pixel of the mask.

    Returns:
        The weighted terms by name; a term of weight 0 is left out, except L1.
    """
    image = photo.image.to(raster.rgb.device)
    rgb = raster.rgb
    losses = {}
    if photo.mask is not None:
        # What is masked is made equal: it gives no gradient, and no edge to windows that reach over it.
        mask = photo.mask.to(rgb.device)
        image = torch.where(mask.unsqueeze(-1), image, rgb.detach())
        share = mask.float().mean().clamp(min=1e-6)
    else:
        share = torch.ones((), device=rgb.device)
    losses["l1"] = (1 - ssim_weight) * (rgb - image).abs().mean() / share
    if ssim_weight:
        losses["ssim"] = ssim_weight * (1 - ssim(rgb, image)) / share
    if empty_weight and photo.empty is not None:
        # The mask alone would let anything float there: what is masked has no gradient.
        empty = photo.empty.to(rgb.device)
        losses["empty"] = empty_weight * torch.where(empty, raster.alpha, 0).mean() / share
    if depth_weight and photo.depth is not None:
        depth = photo.depth.to(rgb.device)
        measured = (depth > 0) & (raster.alpha.detach() > 0.5)
        if photo.mask is not None:
            measured &= photo.mask.to(rgb.device)
        expected = raster.depth / raster.alpha.clamp(min=1e-3)
        error = ((expected - depth).abs() / depth.clamp(min=1e-6)).clamp(max=1)
        losses["depth"] = depth_weight * torch.where(measured, error, 0).mean()
    return losses
