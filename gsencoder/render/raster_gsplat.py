"""gsplat as the differentiable rasterizer on CUDA."""

from typing import TYPE_CHECKING

from jaxtyping import Float
from torch import Tensor

from gsencoder.core.errors import InputError

if TYPE_CHECKING:
    from gsencoder.render.rasterize import RasterConfig

STOP_TRANSMITTANCE = 1e-4
"""Compiled into gsplat's kernels."""


def rasterize_gsplat(
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    scales: Float[Tensor, "N 3"],
    opacities: Float[Tensor, " N"],
    colors: Float[Tensor, "N 3"],
    cam_from_world: Float[Tensor, "4 4"],
    K: Float[Tensor, "3 3"],
    width: int,
    height: int,
    config: "RasterConfig",
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """The fields of a Raster.

    Raises:
        InputError: gsplat is not installed, or a transmittance that it cannot be told.
    """
    if config.stop_transmittance != STOP_TRANSMITTANCE:
        raise InputError(
            f"stop_transmittance: gsplat ends rays at {STOP_TRANSMITTANCE:g} and cannot be told otherwise, "
            f"got {config.stop_transmittance:g}; leave it, or use device=cpu"
        )
    try:
        from gsplat import rasterization  # type: ignore[import-not-found]
    except ImportError as error:
        raise InputError(
            "reconstruction on CUDA needs gsplat: pip install 'gsencoder[gpu]' (it compiles its kernels with nvcc), "
            "or device=cpu"
        ) from error
    rendered, alphas, found = rasterization(
        *(means, quats, scales, opacities, colors, cam_from_world[None], K[None], width, height),
        near_plane=config.near,
        eps2d=config.eps2d,
        packed=False,
        render_mode="RGB+D",
    )
    radii = found["radii"][0].to(means.dtype)
    radii = radii.amax(dim=-1) if radii.ndim == 2 else radii
    return rendered[0, ..., :3], alphas[0, ..., 0], rendered[0, ..., 3], found["means2d"][0], radii
