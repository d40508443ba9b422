"""The rasterizer that is differentiable in the geometry, for photometric reconstruction.

Projection is plain torch (geometry.project), so autograd differentiates it; compositing has a backward of its own:
numba kernels on a CPU, gsplat on CUDA, and torch operations in any float type as their twin (`blend_torch.composite`).

Unlike a Blend, nothing is stored a pixel: the backward pass walks the same tiles front to back again. With
v_i = Σ_c ∂L/∂out_c · value_ic and S = Σ_i w_i v_i over a ray, the color that comes from behind Gaussian i is
S − Σ_{j≤i} w_j v_j, and

    ∂L/∂α_i = T_i v_i − (S − Σ_{j≤i} w_j v_j) / (1 − α_i).

Along a line of pixels exp(−quadratic) is a product of two geometric sequences, as in blend_cpu.py.
"""

import math
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, no_type_check

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gsencoder.core.errors import InputError
from gsencoder.core.settings import CheckedConfig, option
from gsencoder.core.threads import PIECES, kernel, parallel
from gsencoder.geometry import ALPHA_MAX, ALPHA_MIN, project
from gsencoder.render import blend_torch
from gsencoder.render.blend_cpu import bin_tiles, even_cuts, strided_lattice

RasterBackend = Literal["auto", "cpu", "reference", "gsplat"]


@dataclass(frozen=True, slots=True, kw_only=True)
class RasterConfig(CheckedConfig):
    """Accuracy knobs of differentiable rendering; as those of a Blend, with no smallest weight."""

    stop_transmittance: float = option(1e-4, "transmittance at which a ray ends; always 1e-4 with gsplat", gt=0, lt=1)
    near: float = option(0.01, "near plane in world units", gt=0)
    eps2d: float = option(0.3, "low-pass variance of projected Gaussians in pixels²", gt=0)
    backend: RasterBackend = option("auto", "cpu (numba), reference (torch), gsplat (CUDA), or auto")


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
        quats: wxyz, normalized here.
        scales: standard deviations, world units.
        opacities: in [0, 1].
        colors: as seen from this camera.
    """
    backend = _backend(config.backend, means)
    if backend == "gsplat":
        return rasterize_gsplat(means, quats, scales, opacities, colors, cam_from_world, K, width, height, config)
    knobs, stop = {"eps2d": config.eps2d, "near": config.near}, config.stop_transmittance
    projected = project(means, quats, scales, opacities, cam_from_world, K, width, height, **knobs)
    values = torch.cat((colors, projected.depths.unsqueeze(1)), dim=1)
    if backend == "cpu":
        rows = projected.valid.nonzero().squeeze(1)
        extents, limit = projected.extents.detach()[rows], projected.mahalanobis2.detach()[rows]
        shapes = (projected.means2d[rows], projected.conics[rows], opacities[rows], values[rows])
        out = _Composite.apply(*shapes, extents, limit, projected.depths.detach()[rows], width, height, stop)
    else:
        values = torch.cat((values, torch.ones_like(values[:, :1])), dim=1)
        flat = blend_torch.composite(projected, opacities, values, strided_lattice(width, height, 1), stop=stop)
        out = flat.unflatten(0, (height, width))
    radii = torch.where(projected.valid, projected.extents.detach().amax(dim=1), 0)
    return Raster(out[..., :3], out[..., 4], out[..., 3], projected.means2d, radii)


def _backend(requested: RasterBackend, tensor: Tensor) -> RasterBackend:
    device = tensor.device.type
    if requested == "auto":
        return "cpu" if device == "cpu" else "gsplat" if device == "cuda" else "reference"
    if (requested == "cpu") != (device == "cpu") and requested != "reference":
        raise InputError(f"backend: {requested} cannot render tensors on {device}; use auto or reference")
    return requested


class _Composite(torch.autograd.Function):
    """The numba kernels: differentiable in means2d, conics, opacities and values of the splats in view."""

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
        splats = torch.cat((means2d, extents, conics, limit.unsqueeze(1), opacities.unsqueeze(1)), dim=1).numpy()
        # Equal depths keep their order.
        order = np.argsort(depths.numpy(), kind="stable").astype(np.int32)
        tiles_x, tiles_y, everything = -(-width // TILE), -(-height // TILE), np.arange(len(splats), dtype=np.int32)
        # Pixel i is hit at i + ½.
        last = (float(width - 1), float(height - 1))
        starts, members, *by_splat = bin_tiles(splats, everything, order, TILE, tiles_x, tiles_y, 0.5, *last)
        colors, out = np.ascontiguousarray(values.numpy()), np.empty((height, width, CHANNELS), np.float64)
        cuts, size = even_cuts(starts), (width, height, tiles_x)
        arrays = (starts, members, splats, colors, size, stop, out)
        parallel(lambda piece: _composite(cuts[piece], cuts[piece + 1], *arrays), range(PIECES))
        ctx.saved = (cuts, arrays, by_splat)
        return torch.from_numpy(out).to(values.dtype)

    @staticmethod
    def backward(ctx: Any, grads: Float[Tensor, "H W 5"]) -> tuple[Tensor | None, ...]:
        """Partial sums are kept for each tile that a splat touches, and added in one order, so that a rerun gives the
        same bits however many threads there are."""
        cuts, arrays, (owners, entries) = ctx.saved
        members, splats, slopes = arrays[1], arrays[2], grads.contiguous().numpy()
        partials = np.empty((len(members), PARTIAL), splats.dtype)
        parallel(lambda piece: _differentiate(cuts[piece], cuts[piece + 1], *arrays, slopes, partials), range(PIECES))
        sums, parts = np.empty((len(splats), PARTIAL), splats.dtype), even_cuts(owners)
        parallel(lambda piece: _gather(parts[piece], parts[piece + 1], owners, entries, partials, sums), range(PIECES))
        by = torch.from_numpy(sums)
        return by[:, :2], by[:, 2:5], by[:, 5], by[:, 6:], *(None,) * 6


TILE = 16
CHANNELS = 5
"""What is composited of each Gaussian: three colors, depth, and 1 (whose sum is alpha)."""
SPLAT = 9
"""Columns of a splat on the image plane: u, v, half width, half height, conic a, b, c, squared radius, opacity."""
PARTIAL = 10
"""Partial derivatives of a splat: by u, v, conic a, b, c, opacity, and the four values."""


@kernel
@no_type_check
def _row_span(a, b, c, u, dv, limit, last):
    """First and last pixel of a row `dv` below a center at `u` that lie in the ellipse; first > last if none does."""
    root = b * b * dv * dv - a * (c * dv * dv - limit)
    if not root >= 0:
        return 0, -1
    half, middle = math.sqrt(root) / a, u - b * dv / a
    first, final = max(np.ceil(middle - half), 0.0), min(np.floor(middle + half), last)
    if not first <= final:
        return 0, -1
    return int(first), int(final)


@kernel
@no_type_check
def _composite(first, last, starts, members, splats, values, size, stop, out):
    """out[y, x] = Σ w·(values, 1) in tiles [first, last), front to back."""
    width, height, tiles_x = size
    transmittance = np.empty((TILE, TILE), np.float64)
    sums = np.empty((TILE, TILE, CHANNELS), np.float64)
    for t in range(first, last):
        left, top = (t % tiles_x) * TILE, (t // tiles_x) * TILE
        end_u, end_v = min(TILE, width - left), min(TILE, height - top)
        transmittance[:] = 1.0
        sums[:] = 0.0
        open_rays = end_u * end_v
        for m in range(starts[t], starts[t + 1]):
            g = members[m]
            u, v, hv = splats[g, 0] - left - 0.5, splats[g, 1] - top - 0.5, splats[g, 3]
            a, b, c, limit, opacity = splats[g, 4], splats[g, 5], splats[g, 6], splats[g, 7], splats[g, 8]
            low, high = max(np.ceil(v - hv), 0.0), min(np.floor(v + hv), end_v - 1.0)
            if not low <= high:
                continue
            v0, v1, v2, v3 = values[g, 0], values[g, 1], values[g, 2], values[g, 3]
            falloff = math.exp(-a)
            for j in range(int(low), int(high) + 1):
                dv = j - v
                u0, u1 = _row_span(a, b, c, u, dv, limit, end_u - 1.0)
                if u0 > u1:
                    continue
                du = u0 - u
                value = opacity * math.exp(-0.5 * (a * du * du + c * dv * dv) - b * du * dv)
                ratio = math.exp(-a * (du + 0.5) - b * dv) if u1 > u0 else 0.0
                for i in range(u0, u1 + 1):
                    alpha = min(value, ALPHA_MAX)
                    value *= ratio
                    ratio *= falloff
                    before = transmittance[j, i]
                    # A negative transmittance marks a ray that has stopped.
                    if alpha < ALPHA_MIN or before < 0:
                        continue
                    after = before * (1.0 - alpha)
                    if after <= stop:
                        transmittance[j, i] = -1.0
                        open_rays -= 1
                        continue
                    transmittance[j, i] = after
                    w = alpha * before
                    cell = sums[j, i]
                    cell[0] += w * v0
                    cell[1] += w * v1
                    cell[2] += w * v2
                    cell[3] += w * v3
                    cell[4] += w
            if open_rays == 0:
                break
        for j in range(end_v):
            for i in range(end_u):
                for k in range(CHANNELS):
                    out[top + j, left + i, k] = sums[j, i, k]


@kernel
@no_type_check
def _differentiate(first, last, starts, members, splats, values, size, stop, out, grads, partials):
    """partials[entry] = derivatives of the loss by the splat of each entry of tiles [first, last)."""
    width, height, tiles_x = size
    transmittance = np.empty((TILE, TILE), np.float64)
    behind = np.empty((TILE, TILE), np.float64)
    pixel_grad = np.empty((TILE, TILE, CHANNELS), np.float64)
    for t in range(first, last):
        left, top = (t % tiles_x) * TILE, (t // tiles_x) * TILE
        end_u, end_v = min(TILE, width - left), min(TILE, height - top)
        transmittance[:] = 1.0
        for j in range(end_v):
            for i in range(end_u):
                total = 0.0
                for k in range(CHANNELS):
                    pixel_grad[j, i, k] = grads[top + j, left + i, k]
                    total += pixel_grad[j, i, k] * out[top + j, left + i, k]
                behind[j, i] = total
        open_rays = end_u * end_v
        for m in range(starts[t], starts[t + 1]):
            if open_rays == 0:
                partials[m] = 0.0
                continue
            g = members[m]
            u, v, hv = splats[g, 0] - left - 0.5, splats[g, 1] - top - 0.5, splats[g, 3]
            a, b, c, limit, opacity = splats[g, 4], splats[g, 5], splats[g, 6], splats[g, 7], splats[g, 8]
            v0, v1, v2, v3 = values[g, 0], values[g, 1], values[g, 2], values[g, 3]
            low, high = max(np.ceil(v - hv), 0.0), min(np.floor(v + hv), end_v - 1.0)
            falloff = math.exp(-a)
            by_u = by_v = by_a = by_b = by_c = by_opacity = 0.0
            by_0 = by_1 = by_2 = by_3 = 0.0
            for j in range(int(low), int(high) + 1):
                dv = j - v
                u0, u1 = _row_span(a, b, c, u, dv, limit, end_u - 1.0)
                if u0 > u1:
                    continue
                du = u0 - u
                value = opacity * math.exp(-0.5 * (a * du * du + c * dv * dv) - b * du * dv)
                ratio = math.exp(-a * (du + 0.5) - b * dv) if u1 > u0 else 0.0
                # Sums of ∂L/∂(−quadratic) over the row, alone and times du and du².
                s0 = s1 = s2 = 0.0
                for i in range(u0, u1 + 1):
                    alpha = min(value, ALPHA_MAX)
                    clamped = value > ALPHA_MAX
                    value *= ratio
                    ratio *= falloff
                    before = transmittance[j, i]
                    if alpha < ALPHA_MIN or before < 0:
                        continue
                    after = before * (1.0 - alpha)
                    if after <= stop:
                        transmittance[j, i] = -1.0
                        open_rays -= 1
                        continue
                    transmittance[j, i] = after
                    w = alpha * before
                    line = pixel_grad[j, i]
                    weight_grad = line[0] * v0 + line[1] * v1 + line[2] * v2 + line[3] * v3 + line[4]
                    by_0 += w * line[0]
                    by_1 += w * line[1]
                    by_2 += w * line[2]
                    by_3 += w * line[3]
                    rest = behind[j, i] - w * weight_grad
                    behind[j, i] = rest
                    if not clamped:
                        change = alpha * (before * weight_grad - rest / (1.0 - alpha))
                        du = i - u
                        s0 += change
                        s1 += change * du
                        s2 += change * du * du
                by_u += a * s1 + b * dv * s0
                by_v += b * s1 + c * dv * s0
                by_a -= 0.5 * s2
                by_b -= dv * s1
                by_c -= 0.5 * dv * dv * s0
                by_opacity += s0
            line = partials[m]
            line[0], line[1], line[2], line[3], line[4] = by_u, by_v, by_a, by_b, by_c
            line[5] = by_opacity / opacity
            line[6], line[7], line[8], line[9] = by_0, by_1, by_2, by_3


@kernel
@no_type_check
def _gather(first, last, owners, entries, partials, sums):
    for g in range(first, last):
        line = sums[g]
        line[:] = 0.0
        for e in range(owners[g], owners[g + 1]):
            part = partials[entries[e]]
            for k in range(PARTIAL):
                line[k] += part[k]


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
    config: RasterConfig,
) -> Raster:
    """`rasterize` on CUDA."""
    if config.stop_transmittance != STOP_TRANSMITTANCE:
        raise InputError(
            f"stop_transmittance: gsplat ends rays at {STOP_TRANSMITTANCE:g} and takes no other value, "
            f"got {config.stop_transmittance:g}; leave it, or use device=cpu"
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
        near_plane=config.near,
        eps2d=config.eps2d,
        packed=False,
        render_mode="RGB+D",
    )
    radii = info["radii"][0].to(means.dtype)
    radii = radii.amax(dim=-1) if radii.ndim == 2 else radii
    return Raster(rendered[0, ..., :3], alphas[0, ..., 0], rendered[0, ..., 3], info["means2d"][0], radii)
