"""Blend: the sparse matrix B (rays or patches × Gaussians) of front-to-back compositing weights for one view.

With the geometry frozen, rendering anything is `B @ values`, lifting maps onto Gaussians is `Bᵀ @ maps`, and each is
the other's gradient. B depends on geometry and camera alone; it is made once per view and kept.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, Float32, Int32, Int64
from torch import Tensor

from gsencoder.core.errors import InputError
from gsencoder.core.settings import CheckedConfig, option
from gsencoder.geometry import project
from gsencoder.render import blend_cpu, blend_torch
from gsencoder.render.blend_cpu import Lattice, grid_lattice, patch_lattice, strided_lattice
from gsencoder.types import Cameras, FeatureMap, Gaussians

Backend = Literal["auto", "cpu", "torch", "reference"]


@dataclass(frozen=True, slots=True, kw_only=True)
class BlendConfig(CheckedConfig):
    """The accuracy knobs of B, each an explicit bound: a row loses at most (entries dropped) × min_weight. The backend
    "auto" is "cpu" on a CPU in float32, else "torch"."""

    rays_per_patch: int = option(64, "rays averaged into one patch: 1, 4, 9, 16, …")
    min_weight: float = option(0.0, "smallest blending weight that is stored", ge=0, lt=1)
    stop_transmittance: float = option(1e-4, "transmittance at which a ray ends", gt=0, lt=1)
    near: float = option(0.01, "near plane in world units", gt=0)
    eps2d: float = option(0.3, "low-pass variance of projected Gaussians in pixels²", gt=0)
    backend: Backend = option("auto", "cpu (numba), torch, reference (its twin), or auto")


class Blend:
    """B in compressed rows: `weight[crow[p]:crow[p+1]]` belong to Gaussians `col[crow[p]:crow[p+1]]`, front to back.

    Attributes:
        crow: row starts, P + 1 of them; rows are pixels or patches, row-major.
        weight: T·α of each entry, averaged over the row's rays.
        depths: z of each Gaussian in this camera, world units; only entries of `col` are meaningful.
        config: the knobs it was made with.
    """

    def __init__(
        self,
        crow: Int64[Tensor, " P_plus_1"],
        col: Int32[Tensor, " nnz"],
        weight: Float[Tensor, " nnz"],
        depths: Float[Tensor, " N"],
        lattice: Lattice,
        config: BlendConfig,
    ) -> None:
        self.crow, self.col, self.weight = crow, col, weight
        self.depths, self.lattice, self.config = depths, lattice, config

    @property
    def rows(self) -> int:
        """Number of rows P."""
        return len(self.crow) - 1

    @property
    def gaussians(self) -> int:
        """Number of columns N."""
        return len(self.depths)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows as a grid: (height, width)."""
        return self.lattice.height, self.lattice.width

    @cached_property
    def transposed(self) -> tuple[Int64[Tensor, " M"], Int64[Tensor, " M_plus_1"], Int32[Tensor, " nnz"], Tensor]:
        """The M Gaussians that this view sees, ascending, and Bᵀ restricted to them: (columns, crow, row, weight)."""
        if self._on_numba:
            arrays = (self.crow.numpy(), self.col.numpy(), self.weight.numpy())
            columns, crow, row, weight = map(torch.from_numpy, blend_cpu.transpose(*arrays, self.gaussians))
            return columns, crow, row, weight
        return blend_torch.transpose(self.crow, self.col, self.weight)

    @property
    def _on_numba(self) -> bool:
        """Whether products are numba's; with the backend "torch" they are torch's on a CPU as well."""
        return self.weight.device.type == "cpu" and self.config.backend != "torch"

    def to(self, device: str | torch.device) -> "Blend":
        """The blend with its tensors on a device."""
        crow, col, weight, depths = (each.to(device) for each in (self.crow, self.col, self.weight, self.depths))
        return Blend(crow, col, weight, depths, self.lattice, self.config)

    @cached_property
    def alpha(self) -> Float[Tensor, " P"]:
        """Row sums of B: how opaque each ray or patch is."""
        return self.render(torch.ones_like(self.depths))

    @cached_property
    def depth(self) -> Float[Tensor, " P"]:
        """Expected depth Σ w·z / Σ w in world units; 0 where nothing is hit."""
        return self.render(self.depths) / self.alpha.clamp(min=torch.finfo(self.alpha.dtype).tiny)

    def depth_map(self, min_alpha: float = 0.5) -> Float32[np.ndarray, "H W"]:
        """Expected depth as a map; 0 = none, where alpha is below `min_alpha`."""
        return torch.where(self.alpha >= min_alpha, self.depth, 0).reshape(self.shape).float().cpu().numpy()

    @cached_property
    def median_depth(self) -> Float[Tensor, " P"]:
        """Depth at which a ray has lost half its transmittance, for single rays; 0 where it never does."""
        if self.lattice.side != 1:
            raise InputError(f"median_depth needs one ray a row; this blend pools {self.lattice.side**2} rays")
        total = torch.cat((self.weight.new_zeros(1), self.weight)).double().cumsum(0)
        start, end = total[self.crow[:-1]], self.crow[1:]
        entry = torch.searchsorted(total[1:].contiguous(), start + 0.5)
        reached = entry < end
        if not reached.any():
            return torch.zeros_like(start, dtype=self.depths.dtype)
        entry = entry.clamp(max=len(self.col) - 1)
        return torch.where(reached, self.depths[self.col[entry].long()], 0)

    def render(self, values: Float[Tensor, "N *D"]) -> Float[Tensor, "P *D"]:
        """B @ values: any per-Gaussian quantity as seen in this view. Differentiable in `values`."""
        flat = values.flatten(1) if values.ndim > 1 else values.unsqueeze(1)
        return _Render.apply(flat, self).reshape(self.rows, *values.shape[1:])

    def lift(self, maps: Float[Tensor, "P *D"]) -> Float[Tensor, "N *D"]:
        """Bᵀ @ maps: what each Gaussian receives from this view. Differentiable in `maps`.

        Gaussians that the view does not see receive zero; use `lift_into` to sum many views without dense copies.
        """
        flat = maps.flatten(1) if maps.ndim > 1 else maps.unsqueeze(1)
        return _Lift.apply(flat, self).reshape(self.gaussians, *maps.shape[1:])

    def lift_into(self, maps: Float[Tensor, "P D"], sums: Float[Tensor, "N D"]) -> None:
        """Adds Bᵀ @ maps to `sums`, touching only the rows of Gaussians that the view sees."""
        columns, crow, row, weight = self.transposed
        _multiply_into(crow, row, weight, maps, columns, sums, on_numba=self._on_numba)

    def lift_codes_into(self, codes: Int32[Tensor, " P"], sums: Float[Tensor, "N C"]) -> None:
        """`lift_into` for maps that are one code a row: adds each entry's weight to sums[Gaussian, code].

        Rows of code −1 give nothing. By linearity `sums @ table` is what lifting `table[codes]` would have given.
        """
        if self._on_numba:
            blend_cpu.add_codes(*(part.numpy() for part in (self.crow, self.col, self.weight, codes, sums)))
        else:
            columns, crow, row, weight = self.transposed
            blend_torch.count_codes(crow, row, weight, codes, columns, sums)

    def keep_between(self, least: Float[Tensor, " P"], most: Float[Tensor, " P"]) -> "Blend":
        """The same blend with only the Gaussians whose depth lies from `least` to `most` of their row."""
        if self._on_numba:
            arrays = (self.crow, self.col, self.weight, self.depths, least, most)
            selected = blend_cpu.keep_between(*(array.numpy() for array in arrays))
            crow, col, weight = (torch.from_numpy(array) for array in selected)
        else:
            row = torch.repeat_interleave(torch.arange(self.rows, device=self.crow.device), self.crow.diff())
            z = self.depths[self.col.long()]
            kept = (z >= least[row]) & (z <= most[row])
            col, weight, crow = self.col[kept], self.weight[kept], torch.zeros_like(self.crow)
            crow[1:] = torch.bincount(row[kept], minlength=self.rows).cumsum(0)
        return Blend(crow, col, weight, self.depths, self.lattice, self.config)


def _multiply_into(
    crow: Tensor, col: Tensor, weight: Tensor, values: Tensor, targets: Tensor, out: Tensor, *, on_numba: bool
) -> None:
    if on_numba and values.dtype in (torch.float32, torch.float64):
        arrays = (crow, col, weight, values.detach().contiguous(), targets, out)
        blend_cpu.product(*(array.numpy() for array in arrays))
    else:
        # Targets are distinct: no two terms meet, so the order of additions does not depend on the device.
        out.index_add_(0, targets, blend_torch.product(crow, col, weight, values.detach()))


class _Render(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, blend: Blend) -> Tensor:
        ctx.blend = blend
        out = values.new_zeros(blend.rows, values.shape[1])
        rows = torch.arange(blend.rows, device=values.device)
        _multiply_into(blend.crow, blend.col, blend.weight, values, rows, out, on_numba=blend._on_numba)
        return out

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        return _Lift.apply(grad, ctx.blend), None


class _Lift(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, maps: Tensor, blend: Blend) -> Tensor:
        ctx.blend = blend
        out = maps.new_zeros(blend.gaussians, maps.shape[1])
        blend.lift_into(maps, out)
        return out

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        return _Render.apply(grad, ctx.blend), None


def blend(
    gaussians: Gaussians,
    cameras: Cameras,
    view: int = 0,
    *,
    patch: int | None = None,
    like: FeatureMap | None = None,
    stride: int = 1,
    between: tuple[Float32[np.ndarray, " P"], Float32[np.ndarray, " P"]] | None = None,
    config: BlendConfig = BlendConfig(),
    device: str | torch.device = "cpu",
    dtype: torch.dtype = torch.float32,
) -> Blend:
    """The blending weights of one view.

    Args:
        patch: pixels along the side of a square patch; None for one row a pixel.
        like: a feature map whose grid the rows follow, in place of `patch`.
        stride: where the rows are pixels, every how many of them, in both directions.
        between: smallest and largest depth of the entries of each row, as `Blend.keep_between` takes them: it gives the
            same, and what lies behind is not composited at all.
        device: where the result is made and lives; the numba backend computes on a CPU alone.
        dtype: float type of the torch backends; the numba backend computes in float64 and stores float32.
    """
    if not -len(cameras) <= view < len(cameras):
        raise InputError(f"view: expected 0 to {len(cameras) - 1}, got {view}")
    width, height = int(cameras.widths[view]), int(cameras.heights[view])
    if like is not None:
        lattice = grid_lattice(like.grid_from_image, like.width, like.height, config.rays_per_patch)
    elif patch is not None:
        lattice = patch_lattice(width, height, patch, config.rays_per_patch)
    else:
        lattice = strided_lattice(width, height, stride)
    knobs = {"stop": config.stop_transmittance, "keep": config.min_weight}
    backend = config.backend
    on_cpu = torch.device(device).type == "cpu"
    if backend == "auto":
        backend = "cpu" if on_cpu and dtype == torch.float32 else "torch"
    if backend == "cpu":
        if not on_cpu:
            raise InputError(f"blend.backend: cpu computes on a CPU alone, got device {device}; use auto or torch")
        if between is None:
            between = np.full(lattice.rows, -np.inf, np.float32), np.full(lattice.rows, np.inf, np.float32)
        pose, K, size = cameras.cam_from_world[view], cameras.Ks[view], (width, height)
        made = blend_cpu.blend_weights(
            gaussians, pose, K, size, lattice, between, eps2d=config.eps2d, near=config.near, **knobs
        )
        crow, col, weight, depths = map(torch.from_numpy, made)
        return Blend(crow, col, weight, depths, lattice, config)

    def tensor(array: np.ndarray, dtype: torch.dtype = dtype) -> Tensor:
        return torch.as_tensor(array, device=device).to(dtype)

    # A projection costs little, so that float64 is affordable also where a GPU is slow in it; see `blend_torch`.
    precise = dtype if backend == "reference" else torch.float64
    projected = project(
        tensor(gaussians.means, precise),
        tensor(gaussians.quats, precise),
        tensor(gaussians.scales, precise),
        tensor(gaussians.opacities, precise),
        tensor(cameras.cam_from_world[view], precise),
        tensor(cameras.Ks[view], precise),
        width,
        height,
        eps2d=config.eps2d,
        near=config.near,
    )
    make = blend_torch.reference_weights if backend == "reference" else blend_torch.blend_weights
    crow, col, weight = make(projected, tensor(gaussians.opacities), lattice, **knobs)
    b = Blend(crow, col, weight, projected.depths.to(dtype), lattice, config)
    if between is None:
        return b
    return b.keep_between(*(torch.from_numpy(depths).to(b.depths) for depths in between))
