"""Rendered images of a splat: colors from SH, composited by a Blend, and depth maps."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8

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
    """One view in color.

    Args:
        gaussians: the splat.
        cameras: in the same world.
        view: which camera.
        blended: this view's pixel blend, where it has been made already.
        background: RGB in [0, 1] behind everything.
        config: accuracy knobs, where the blend must be made.
    """
    b = blended if blended is not None else blend(gaussians, cameras, view, config=config)
    rgb = b.render(view_colors(gaussians, cameras, view)) + (1 - b.alpha).unsqueeze(1) * torch.tensor(background)
    return (rgb.clamp(0, 1) * 255 + 0.5).to(torch.uint8).reshape(*b.shape, 3).numpy()


def depth_image(b: Blend, min_alpha: float = 0.5) -> Float32[np.ndarray, "H W"]:
    """Expected depth as a map in world units; 0 = none, where alpha is below `min_alpha`."""
    return torch.where(b.alpha >= min_alpha, b.depth, 0).reshape(b.shape).float().cpu().numpy()


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
