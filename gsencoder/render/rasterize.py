"""The rasterizer that is differentiable in the geometry, for photometric reconstruction.

Projection is plain torch (geometry.project), so autograd differentiates it; compositing has a backward of its own:
numba kernels on a CPU, gsplat on CUDA, and torch operations in any float type as their twin.

Compositing that is differentiable in the geometry, on a CPU: numba kernels; the plain twin is in reference.py.

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
from jaxtyping import Float, Float64, Int32, Int64
from torch import Tensor

from gsencoder import geometry
from gsencoder.core.errors import InputError
from gsencoder.core.settings import check_limits, option
from gsencoder.core.threads import PIECES, even_cuts, kernel, parallel
from gsencoder.geometry import ALPHA_MAX, ALPHA_MIN, Projected
from gsencoder.render import reference
from gsencoder.render.rays import pixel_lattice

RasterBackend = Literal["auto", "cpu", "reference", "gsplat"]


@dataclass(frozen=True, slots=True, kw_only=True)
class RasterConfig:
    """Accuracy knobs of differentiable rendering; as those of a Blend, with no smallest weight."""

    stop_transmittance: float = option(1e-4, "transmittance at which a ray ends; always 1e-4 with gsplat", gt=0, lt=1)
    near: float = option(0.01, "near plane in world units", gt=0)
    eps2d: float = option(0.3, "low-pass variance of projected Gaussians in pixels²", gt=0)
    backend: RasterBackend = option("auto", "cpu (numba), reference (torch), gsplat (CUDA), or auto")

    def __post_init__(self) -> None:
        check_limits(self)


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
        K: intrinsics in pixels.
        width: image width in pixels.
        height: image height in pixels.
        config: accuracy knobs and backend.
    """
    backend = _backend(config.backend, means)
    if backend == "gsplat":
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
        tiles = bin_splats(splats, depths.numpy(), width, height)
        colors = np.ascontiguousarray(values.numpy())
        out = composite(tiles, splats, colors, width, height, stop)
        ctx.saved = (tiles, splats, colors, stop, out)
        return torch.from_numpy(out).to(values.dtype)

    @staticmethod
    def backward(ctx: Any, grads: Float[Tensor, "H W 5"]) -> tuple[Tensor | None, ...]:
        tiles, splats, colors, stop, out = ctx.saved
        slopes = differentiate(tiles, splats, colors, stop, out, grads.contiguous().numpy())
        gradients = torch.from_numpy(slopes)
        return (
            gradients[:, :2],
            gradients[:, 2:5],
            gradients[:, 5],
            gradients[:, 6:],
            *(None,) * 6,
        )


TILE = 16
CHANNELS = 5
"""What is composited of each Gaussian: three colors, depth, and 1 (whose sum is alpha)."""
SPLAT = 9
"""Columns of a splat on the image plane: u, v, half width, half height, conic a, b, c, squared radius, opacity."""
PARTIAL = 10
"""Partial derivatives of a splat: by u, v, conic a, b, c, opacity, and the four values."""


class Tiles(NamedTuple):
    """Which splats touch which tiles, front to back.

    Attributes:
        starts: first entry of each tile in `members`, row-major, and the number of all.
        members: splats of each tile by depth.
        owners: first entry of each splat in `entries`, and the number of all.
        entries: where in `members` each splat stands.
    """

    starts: Int64[np.ndarray, " tiles_plus_1"]
    members: Int32[np.ndarray, " entries"]
    owners: Int64[np.ndarray, " M_plus_1"]
    entries: Int64[np.ndarray, " entries"]


@kernel
@no_type_check
def _bin_splats(splats, order, tiles_x, tiles_y, width, height):
    n = len(order)
    bounds = np.empty((n, 4), np.int32)
    starts = np.zeros(tiles_x * tiles_y + 1, np.int64)
    owners = np.zeros(n + 1, np.int64)
    for g in range(n):
        u, v, hu, hv = splats[g, 0], splats[g, 1], splats[g, 2], splats[g, 3]
        # Pixel i is hit at i + ½. Bounds are clipped as floats: what lies far outside overflows an integer.
        u0, u1 = max(np.ceil(u - hu - 0.5), 0.0), min(np.floor(u + hu - 0.5), width - 1.0)
        v0, v1 = max(np.ceil(v - hv - 0.5), 0.0), min(np.floor(v + hv - 0.5), height - 1.0)
        if not (u0 <= u1 and v0 <= v1):
            bounds[g, 0], bounds[g, 1], bounds[g, 2], bounds[g, 3] = 0, -1, 0, -1
            continue
        bounds[g, 0], bounds[g, 1] = int(u0) // TILE, int(u1) // TILE
        bounds[g, 2], bounds[g, 3] = int(v0) // TILE, int(v1) // TILE
        owners[g + 1] = (bounds[g, 1] - bounds[g, 0] + 1) * (bounds[g, 3] - bounds[g, 2] + 1)
        for y in range(bounds[g, 2], bounds[g, 3] + 1):
            for x in range(bounds[g, 0], bounds[g, 1] + 1):
                starts[y * tiles_x + x + 1] += 1
    for t in range(tiles_x * tiles_y):
        starts[t + 1] += starts[t]
    for g in range(n):
        owners[g + 1] += owners[g]
    where = starts[:-1].copy()
    members, entries = np.empty(starts[-1], np.int32), np.empty(starts[-1], np.int64)
    for k in range(n):
        g = order[k]
        at = owners[g]
        for y in range(bounds[g, 2], bounds[g, 3] + 1):
            for x in range(bounds[g, 0], bounds[g, 1] + 1):
                t = y * tiles_x + x
                members[where[t]] = g
                entries[at] = where[t]
                where[t] += 1
                at += 1
    return starts, members, owners, entries


def bin_splats(splats: Float[np.ndarray, "M 9"], depths: Float[np.ndarray, " M"], width: int, height: int) -> Tiles:
    """Sorts splats into the tiles that their ellipses may touch; equal depths keep their order."""
    order = np.argsort(depths, kind="stable").astype(np.int32)
    return Tiles(*_bin_splats(splats, order, -(-width // TILE), -(-height // TILE), float(width), float(height)))


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


def composite(
    tiles: Tiles,
    splats: Float[np.ndarray, "M 9"],
    values: Float[np.ndarray, "M 4"],
    width: int,
    height: int,
    stop: float,
) -> Float64[np.ndarray, "H W 5"]:
    """Σ w·value for each of the four values of the splats, and Σ w, at every pixel."""
    out = np.empty((height, width, CHANNELS), np.float64)
    cuts = even_cuts(tiles.starts)
    size = (width, height, -(-width // TILE))
    arrays = (tiles.starts, tiles.members, splats, values, size, stop, out)
    parallel(lambda piece: _composite(cuts[piece], cuts[piece + 1], *arrays), range(PIECES))
    return out


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


def differentiate(
    tiles: Tiles,
    splats: Float[np.ndarray, "M 9"],
    values: Float[np.ndarray, "M 4"],
    stop: float,
    out: Float64[np.ndarray, "H W 5"],
    grads: Float[np.ndarray, "H W 5"],
) -> Float[np.ndarray, "M 10"]:
    """Derivatives of a loss by u, v, a, b, c, opacity and the four values of each splat.

    Partial sums are kept for each tile that a splat touches, and added in one order, so that a rerun gives the same
    bits however many threads there are.

    Args:
        tiles: as `composite` had them.
        grads: derivatives of the loss by `out`.
    """
    height, width = out.shape[:2]
    partials = np.empty((len(tiles.members), PARTIAL), splats.dtype)
    cuts = even_cuts(tiles.starts)
    size = (width, height, -(-width // TILE))
    arrays = (tiles.starts, tiles.members, splats, values, size, stop, out, grads, partials)
    parallel(lambda piece: _differentiate(cuts[piece], cuts[piece + 1], *arrays), range(PIECES))
    sums = np.empty((len(splats), PARTIAL), splats.dtype)
    parts = even_cuts(tiles.owners)
    parallel(
        lambda piece: _gather(parts[piece], parts[piece + 1], tiles.owners, tiles.entries, partials, sums),
        range(PIECES),
    )
    return sums


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
    """The fields of a Raster; the arguments are those of `rasterize` and of `RasterConfig`."""
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
