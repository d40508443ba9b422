"""The rasterizer that is differentiable in the geometry, for photometric reconstruction.

Projection is plain torch (geometry.project), so autograd differentiates it; compositing has a backward of its own:
numba kernels on a CPU (raster_cpu.py), gsplat on CUDA, and torch operations in any float type as their twin.
"""

import math
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gsencoder import geometry
from gsencoder.core.errors import InputError
from gsencoder.geometry import Projected
from gsencoder.render import reference
from gsencoder.render.rays import pixel_lattice

RasterBackend = Literal["auto", "cpu", "reference", "gsplat"]


@dataclass(frozen=True, slots=True, kw_only=True)
class RasterConfig:
    """Accuracy knobs of differentiable rendering; as those of a Blend, with no smallest weight."""

    stop_transmittance: float = field(
        default=1e-4, metadata={"help": "transmittance at which a ray ends; always 1e-4 with gsplat"}
    )
    near: float = field(default=0.01, metadata={"help": "near plane in world units"})
    eps2d: float = field(default=0.3, metadata={"help": "low-pass variance of projected Gaussians in pixels²"})
    backend: RasterBackend = field(
        default="auto", metadata={"help": "cpu (numba), reference (torch), gsplat (CUDA), or auto"}
    )

    def __post_init__(self) -> None:
        if not 0 < self.stop_transmittance < 1:
            raise InputError(f"stop_transmittance: expected a number in (0, 1), got {self.stop_transmittance}")
        for name in ("near", "eps2d"):
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"{name}: expected a positive number, got {getattr(self, name)}")


class Raster(NamedTuple):
    """One view of N Gaussians.

    Attributes:
        rgb: Σ w·color, without a background.
        alpha: Σ w.
        depth: Σ w·z in world units; divide by alpha for the expected depth.
        means2d: where the centers lie, in pixels; its gradient is what screen-space rules look at.
        radii: half the larger side of each Gaussian's box on the screen in pixels, 0 where it is not in view.
    """

    rgb: Float[Tensor, "H W 3"]
    alpha: Float[Tensor, "H W"]
    depth: Float[Tensor, "H W"]
    means2d: Float[Tensor, "N 2"]
    radii: Float[Tensor, " N"]


def rasterize(
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
    config: RasterConfig = RasterConfig(),
) -> Raster:
    """One view, differentiable in everything but the camera.

    Args:
        means: centers, world units.
        quats: rotations wxyz, normalized here.
        scales: standard deviations, world units.
        opacities: in [0, 1].
        colors: as seen from this camera.
        cam_from_world: rigid.
        K: intrinsics in pixels.
        width: image width in pixels.
        height: image height in pixels.
        config: accuracy knobs and backend.

    Raises:
        InputError: a backend that cannot compute on these tensors' device.
    """
    backend = _backend(config.backend, means)
    if backend == "gsplat":
        from gsencoder.render.raster_gsplat import rasterize_gsplat

        splat = (means, quats, scales, opacities, colors)
        stop = config.stop_transmittance
        return Raster(
            *rasterize_gsplat(
                *splat, cam_from_world, K, width, height, near=config.near, eps2d=config.eps2d, stop_transmittance=stop
            )
        )
    knobs = {"eps2d": config.eps2d, "near": config.near}
    projected = geometry.project(means, quats, scales, opacities, cam_from_world, K, width, height, **knobs)
    composite = _composite_cpu if backend == "cpu" else _composite_reference
    values = torch.cat((colors, projected.depths.unsqueeze(1)), dim=1)
    out = composite(projected, opacities, values, width, height, config.stop_transmittance)
    radii = torch.where(projected.valid, projected.extents.detach().amax(dim=1), 0)
    return Raster(out[..., :3], out[..., 4], out[..., 3], projected.means2d, radii)


def _backend(requested: RasterBackend, tensor: Tensor) -> RasterBackend:
    device = tensor.device.type
    if requested == "auto":
        return "cpu" if device == "cpu" else "gsplat" if device == "cuda" else "reference"
    if (requested == "cpu") != (device == "cpu") and requested != "reference":
        raise InputError(f"backend: {requested} cannot render tensors on {device}; use auto or reference")
    return requested


def _composite_reference(
    projected: Projected, opacities: Tensor, values: Tensor, width: int, height: int, stop: float
) -> Float[Tensor, "H W 5"]:
    values = torch.cat((values, torch.ones_like(values[:, :1])), dim=1)
    flat = reference.composite(projected, opacities, values, pixel_lattice(width, height), stop=stop)
    return flat.unflatten(0, (height, width))


def _composite_cpu(
    projected: Projected, opacities: Tensor, values: Tensor, width: int, height: int, stop: float
) -> Float[Tensor, "H W 5"]:
    rows = projected.valid.nonzero().squeeze(1)
    extents, limit = projected.extents.detach()[rows], projected.mahalanobis2.detach()[rows]
    shapes = (projected.means2d[rows], projected.conics[rows], opacities[rows], values[rows])
    return _Composite.apply(*shapes, extents, limit, projected.depths.detach()[rows], width, height, stop)


class _Composite(torch.autograd.Function):
    """Kernels of raster_cpu.py: differentiable in means2d, conics, opacities and values of the splats in view."""

    @staticmethod
    def forward(
        ctx: Any,
        means2d: Float[Tensor, "M 2"],
        conics: Float[Tensor, "M 3"],
        opacities: Float[Tensor, " M"],
        values: Float[Tensor, "M 4"],
        extents: Float[Tensor, "M 2"],
        limit: Float[Tensor, " M"],
        depths: Float[Tensor, " M"],
        width: int,
        height: int,
        stop: float,
    ) -> Float[Tensor, "H W 5"]:
        from gsencoder.render import raster_cpu

        splats = torch.cat((means2d, extents, conics, limit.unsqueeze(1), opacities.unsqueeze(1)), dim=1).numpy()
        tiles = raster_cpu.bin_splats(splats, depths.numpy(), width, height)
        colors = np.ascontiguousarray(values.numpy())
        out = raster_cpu.composite(tiles, splats, colors, width, height, stop)
        ctx.saved = (tiles, splats, colors, stop, out)
        return torch.from_numpy(out).to(values.dtype)

    @staticmethod
    def backward(ctx: Any, grads: Float[Tensor, "H W 5"]) -> tuple[Tensor | None, ...]:
        from gsencoder.render import raster_cpu

        tiles, splats, colors, stop, out = ctx.saved
        slopes = raster_cpu.differentiate(tiles, splats, colors, stop, out, grads.contiguous().numpy())
        gradients = torch.from_numpy(slopes)
        return (
            gradients[:, :2],
            gradients[:, 2:5],
            gradients[:, 5],
            gradients[:, 6:],
            None,
            None,
            None,
            None,
            None,
            None,
        )
