"""The plain twin of the fast backends: blending weights and sparse products in torch alone, any device and float type.

It says what B is in few lines and in float64 serves tests as a check of the fast backends. Its products are also those
that run on a GPU.
"""

from collections.abc import Iterator

import torch
from jaxtyping import Float, Int32, Int64
from torch import Tensor

from gsencoder.geometry import ALPHA_MAX, ALPHA_MIN, Projected
from gsencoder.render.rays import Lattice


def blend_weights(
    projected: Projected, opacities: Float[Tensor, " N"], lattice: Lattice, *, stop: float, keep: float
) -> tuple[Int64[Tensor, " P_plus_1"], Int32[Tensor, " nnz"], Float[Tensor, " nnz"]]:
    """CSR (crow, col, weight) of B.

    For each tile the Gaussians whose ellipse of alpha ≥ 1/255 may touch it are composited over the tile's rays as a
    dense rays × Gaussians table: w = α·exp(Σ_before log1p(−α)).

    Args:
        opacities: of the same N Gaussians.
        lattice: where the rays are.
        stop: transmittance at which a ray ends, the Gaussian that would cross it excluded.
    """
    rows, cols, weights = [], [], []
    side = lattice.side
    for rays, members in _tiles(projected, lattice):
        w = _composite(projected, opacities, members, _pixels(rays, lattice, opacities), stop)
        cell = (rays[:, 1] // side) * lattice.width + rays[:, 0] // side
        # Sorted sums, since `index_add_` adds in another order each time on a GPU.
        cell, order = torch.sort(cell, stable=True)
        cells, uses = torch.unique_consecutive(cell, return_counts=True)
        pooled = torch.segment_reduce(w[order], "sum", lengths=uses, axis=0) / side**2
        at, member = (pooled >= keep if keep > 0 else pooled > 0).nonzero(as_tuple=True)
        rows.append(cells[at])
        cols.append(members[member])
        weights.append(pooled[at, member])
    row, col, weight = torch.cat(rows), torch.cat(cols), torch.cat(weights)
    # Tiles emit whole rows in depth order; a stable sort by row only interleaves tiles.
    order = torch.argsort(row, stable=True)
    crow = torch.zeros(lattice.rows + 1, dtype=torch.int64, device=row.device)
    crow[1:] = torch.bincount(row, minlength=lattice.rows).cumsum(0)
    return crow, col[order].to(torch.int32), weight[order]


def composite(
    projected: Projected, opacities: Float[Tensor, " N"], values: Float[Tensor, "N D"], lattice: Lattice, *, stop: float
) -> Float[Tensor, "P D"]:
    """B @ values for single rays, differentiable in the geometry as well: the twin of the kernels in rasterize.py.

    Args:
        opacities: of the same N Gaussians.
        lattice: where the rays are, one a row.
        stop: transmittance at which a ray ends, the Gaussian that would cross it excluded.
    """
    rows, parts = [], []
    for rays, members in _tiles(projected, lattice):
        w = _composite(projected, opacities, members, _pixels(rays, lattice, opacities), stop)
        rows.append(rays[:, 1] * lattice.width + rays[:, 0])
        parts.append(w @ values[members])
    return torch.cat(parts)[torch.argsort(torch.cat(rows))]


def _tiles(projected: Projected, lattice: Lattice) -> Iterator[tuple[Int64[Tensor, "rays 2"], Int64[Tensor, " n"]]]:
    """The rays (column, line) of each tile, and the Gaussians whose ellipse may touch it, front to back."""
    device, dtype = projected.depths.device, projected.depths.dtype
    valid = projected.valid.nonzero().squeeze(1)
    order = valid[torch.argsort(projected.depths[valid], stable=True)]
    origin = torch.tensor([lattice.x0, lattice.y0], device=device, dtype=dtype)
    step = torch.tensor([lattice.dx, lattice.dy], device=device, dtype=dtype)
    low = (projected.means2d - projected.extents - origin) / step
    high = (projected.means2d + projected.extents - origin) / step
    tile, side = lattice.tile, lattice.side
    for v0 in range(0, lattice.height * side, tile):
        v1 = min(v0 + tile, lattice.height * side)
        line = order[(low[order, 1] <= v1 - 1) & (high[order, 1] >= v0)]
        for u0 in range(0, lattice.width * side, tile):
            u1 = min(u0 + tile, lattice.width * side)
            members = line[(low[line, 0] <= u1 - 1) & (high[line, 0] >= u0)]
            u = torch.arange(u0, u1, device=device)
            v = torch.arange(v0, v1, device=device)
            yield torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1).reshape(-1, 2), members


def _pixels(rays: Int64[Tensor, "rays 2"], lattice: Lattice, like: Tensor) -> Float[Tensor, "rays 2"]:
    """Where rays pierce the image."""
    return rays * like.new_tensor([lattice.dx, lattice.dy]) + like.new_tensor([lattice.x0, lattice.y0])


def _composite(projected: Projected, opacities: Tensor, members: Tensor, rays: Tensor, stop: float) -> Tensor:
    """Weights of `members` (front to back) on rays given in pixels: [rays, members]."""
    d = rays.unsqueeze(1) - projected.means2d[members]
    a, b, c = projected.conics[members].unbind(-1)
    power = 0.5 * (a * d[..., 0] ** 2 + c * d[..., 1] ** 2) + b * d[..., 0] * d[..., 1]
    alpha = (opacities[members] * torch.exp(-power)).clamp(max=ALPHA_MAX)
    alpha = torch.where(alpha >= ALPHA_MIN, alpha, 0)
    after = torch.log1p(-alpha).cumsum(dim=1)
    before = torch.cat((torch.zeros_like(after[:, :1]), after[:, :-1]), dim=1) if len(members) else after
    return torch.where(after.exp() > stop, alpha * before.exp(), 0)


def transpose(crow: Tensor, col: Tensor, weight: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The columns that occur, and Bᵀ restricted to them as CSR: (columns, crow, row, weight)."""
    row = torch.repeat_interleave(torch.arange(len(crow) - 1, device=crow.device), crow.diff())
    order = torch.argsort(col, stable=True)
    columns, uses = torch.unique_consecutive(col[order].long(), return_counts=True)
    return columns, torch.cat((uses.new_zeros(1), uses.cumsum(0))), row[order].to(torch.int32), weight[order]


def product(crow: Tensor, col: Tensor, weight: Tensor, values: Float[Tensor, "n D"]) -> Float[Tensor, "rows D"]:
    """CSR @ values by sorted segment sums, which on every device give the same bits each time."""
    index, weight = col.long(), weight.to(values.dtype).unsqueeze(1)
    # Sixteen channels at a time bound the gathered products to nnz × 16.
    parts = [
        torch.segment_reduce(weight * part[index], "sum", offsets=crow, axis=0, initial=0.0)
        for part in values.split(16, dim=1)
    ]
    return torch.cat(parts, dim=1)


def count_codes(
    crow: Tensor,
    col: Tensor,
    weight: Tensor,
    codes: Int32[Tensor, " n"],
    targets: Int64[Tensor, " rows"],
    out: Float[Tensor, "N C"],
) -> None:
    """Adds CSR @ one_hot(codes) to out[targets], by sums over entries sorted by target and code; code −1 gives nothing.

    Args:
        col: column of each entry.
        codes: of the columns, −1 or below C.
        targets: distinct, of the rows.
        out: what is added to.
    """
    row = torch.repeat_interleave(torch.arange(len(crow) - 1, device=crow.device), crow.diff())
    code = codes[col.long()].long()
    coded = code >= 0
    key, order = torch.sort(targets[row[coded]] * out.shape[1] + code[coded], stable=True)
    if not len(key):
        return
    keys, uses = torch.unique_consecutive(key, return_counts=True)
    sums = torch.segment_reduce(weight[coded][order].to(out.dtype), "sum", lengths=uses, axis=0)
    out.view(-1).index_add_(0, keys, sums)
