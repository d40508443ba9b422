"""gsplat as the differentiable rasterizer on CUDA."""

from jaxtyping import Float
from torch import Tensor

from gsencoder.core.errors import InputError

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
    *,
    near: float,
    eps2d: float,
    stop_transmittance: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """The fields of a Raster; the arguments are those of `rasterize` and of `RasterConfig`.

    Raises:
        InputError: gsplat is not installed, or a transmittance other than that of its kernels.
    """
    if stop_transmittance != STOP_TRANSMITTANCE:
        raise InputError(
            f"stop_transmittance: gsplat ends rays at {STOP_TRANSMITTANCE:g} and takes no other value, "
            f"got {stop_transmittance:g}; leave it, or use device=cpu"
        )
    try:
        from gsplat import rasterization  # type: ignore[import-not-found]
    except ImportError as error:
        raise InputError(
            "reconstruction on CUDA needs gsplat: pip install 'gsencoder[gpu]' (it compiles its kernels with nvcc), "
            "or device=cpu"
        ) from error
    rendered, alphas, info = rasterization(
        *(means, quats, scales, opacities, colors, cam_from_world[None], K[None], width, height),
        near_plane=near,
        eps2d=eps2d,
        packed=False,
        render_mode="RGB+D",
    )
    radii = info["radii"][0].to(means.dtype)
    radii = radii.amax(dim=-1) if radii.ndim == 2 else radii
    return rendered[0, ..., :3], alphas[0, ..., 0], rendered[0, ..., 3], info["means2d"][0], radii
