"""The parameters that are optimized: a splat with logarithms of scales and logits of opacities."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from gsencoder.geometry import colors_from_sh, normalize_quats, project_points, transform
from gsencoder.types import Cameras, Gaussians

OPACITY_MARGIN = 1e-3
"""Opacities begin at least so far from 0 and 1, where a logit has no slope."""
MAX_SIGMAS = 3.33
"""No splat reaches further than so many standard deviations: √(2 ln 255) at an opacity of 1."""

Parameters = dict[str, Tensor]
"""means [N, 3], quats [N, 4], log_scales [N, 3], logit_opacities [N], sh0 [N, 1, 3], shN [N, K − 1, 3], float32."""


def shapes_of(sh_degree: int) -> dict[str, tuple[int, ...]]:
    """The size of one row of each parameter."""
    rest = (sh_degree + 1) ** 2 - 1
    return {
        "means": (3,),
        "quats": (4,),
        "log_scales": (3,),
        "logit_opacities": (),
        "sh0": (1, 3),
        "shN": (rest, 3),
    }


def parameters_from(gaussians: Gaussians, sh_degree: int, device: torch.device | str = "cpu") -> Parameters:
    """The parameters of a splat; color coefficients above those that it has begin at zero, more are cut."""
    n, num_coefficients = len(gaussians), (sh_degree + 1) ** 2
    sh = np.zeros((n, num_coefficients, 3), np.float32)
    common = min(num_coefficients, gaussians.sh.shape[1])
    sh[:, :common] = gaussians.sh[:, :common]
    opacities = torch.from_numpy(gaussians.opacities.copy()).clamp(OPACITY_MARGIN, 1 - OPACITY_MARGIN)
    raw = {
        "means": torch.from_numpy(gaussians.means.copy()),
        "quats": torch.from_numpy(gaussians.quats.copy()),
        "log_scales": torch.from_numpy(gaussians.scales).log(),
        "logit_opacities": torch.logit(opacities),
        "sh0": torch.from_numpy(sh[:, :1].copy()),
        "shN": torch.from_numpy(sh[:, 1:].copy()),
    }
    return {name: value.to(device) for name, value in raw.items()}


def gaussians_of(raw: Parameters) -> Gaussians:
    """The splat in physical values."""
    values = {
        "means": raw["means"],
        "quats": normalize_quats(raw["quats"]),
        "scales": raw["log_scales"].exp(),
        "opacities": raw["logit_opacities"].sigmoid(),
        "sh": torch.cat((raw["sh0"], raw["shN"]), dim=1),
    }
    return Gaussians(**{name: value.detach().cpu().numpy().copy() for name, value in values.items()})


def seen_colors(raw: Parameters, degree: int, camera_center: Float[Tensor, "3"]) -> Float[Tensor, "N 3"]:
    """Colors from a camera with coefficients up to `degree`."""
    sh = torch.cat((raw["sh0"], raw["shN"][:, : (degree + 1) ** 2 - 1]), dim=1) if degree else raw["sh0"]
    return colors_from_sh(sh, raw["means"], camera_center)


def rows_in_view(
    raw: Parameters,
    cam_from_world: Float[Tensor, "4 4"],
    K: Float[Tensor, "3 3"],
    width: int,
    height: int,
    *,
    near: float,
    eps2d: float,
) -> Int64[Tensor, " n"]:
    """Rows that may touch the image: all that do, and few others.

    A splat's half width is at most REACH·√((f·s/z)²(1 + t²) + eps2d), where s is its largest scale and t the tangent
    at which geometry.project stops following it sideways.
    """
    local = transform(cam_from_world, raw["means"])
    z = local[:, 2]
    inside: Bool[Tensor, " N"] = z > near
    largest = raw["log_scales"].amax(dim=1).exp() / z.clamp(min=near)
    focals, middles, sizes = K.diagonal()[:2], K[:2, 2], (width, height)
    for position, focal, middle, size in zip(project_points(local, K).unbind(1), focals, middles, sizes, strict=True):
        tangent = torch.maximum(middle, size - middle) / focal + 0.15 * size / focal
        reach = MAX_SIGMAS * torch.sqrt((focal * largest).square() * (1 + tangent.square()) + eps2d)
        inside &= (position + reach > 0) & (position - reach < size)
    return inside.nonzero().squeeze(1)


def camera_of(cameras: Cameras, view: int, device: torch.device | str) -> tuple[Tensor, Tensor]:
    """cam_from_world and center of a camera as float32 tensors; its K depends on how small the photograph is."""
    center = torch.from_numpy(cameras.centers[view]).float()
    return torch.from_numpy(cameras.cam_from_world[view].copy()).to(device), center.to(device)
