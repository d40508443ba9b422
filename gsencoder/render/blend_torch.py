"""Blending weights and sparse products in torch, on any device and in any float type: what makes B on a GPU, and its
plain twin (`reference_weights`), which tests compare with.

Sums run over axes and sorted lists, never over atomic additions, so that a device gives the same bits each time.
"""

import math
from collections.abc import Iterator

import torch
from jaxtyping import Float, Int32, Int64
from torch import Tensor

from gsencoder.geometry import ALPHA_MAX, ALPHA_MIN, Projected
from gsencoder.render.blend_cpu import Lattice

ROUND = 32
"""Gaussians of each tile that are composited in one round."""
ROUND_VALUES = 1 << 24
"""Values of one tensor of a round (rays × Gaussians of a batch of tiles), 64 MiB in float32."""


def blend_weights(
    projected: Projected, opacities: Float[Tensor, " N"], lattice: Lattice, *, stop: float, keep: float
) -> tuple[Int64[Tensor, " P_plus_1"], Int32[Tensor, " nnz"], Float[Tensor, " nnz"]]:
    """CSR (crow, col, weight) of B as `reference_weights` makes it, without its loop over tiles: pairs of a tile and a
    Gaussian are sorted by tile and depth, and all tiles are composited at once, a few Gaussians of each a round, until
    every ray has ended.

    The projection is best given in float64, as on a CPU, so that both put Gaussians of nearly equal depths in one
    order; compositing is in the type of the opacities.
    """
    starts, members = tile_lists(projected, lattice)
    batch = max(1, ROUND_VALUES // (lattice.tile**2 * ROUND))
    packed = torch.cat((projected.means2d, projected.conics), dim=1).to(opacities.dtype)
    packed = torch.cat((packed, opacities.unsqueeze(1)), dim=1)
    occupied = starts.diff().nonzero().squeeze(1)
    parts = []
    for tiles in occupied.split(batch):
        parts += _composite_tiles(tiles, starts, members, packed, lattice, stop, keep)
    if not parts:
        empty = opacities.new_zeros(0)
        return starts.new_zeros(lattice.rows + 1), empty.to(torch.int32), empty
    row, col, weight = (torch.cat(part) for part in zip(*parts, strict=True))
    # Within a row, entries were made front to back: rounds follow one another, and so do Gaussians in a round.
    row, order = torch.sort(row, stable=True)
    crow = torch.searchsorted(row, torch.arange(lattice.rows + 1, device=row.device))
    return crow, col[order].to(torch.int32), weight[order]


def tile_lists(projected: Projected, lattice: Lattice) -> tuple[Int64[Tensor, " tiles_plus_1"], Int64[Tensor, " n"]]:
    """For each tile, line by line, the Gaussians that may touch its rays, front to back: (starts, Gaussians)."""
    device, dtype = projected.depths.device, projected.depths.dtype
    valid = projected.valid.nonzero().squeeze(1)
    index = valid[torch.argsort(projected.depths[valid], stable=True)]
    means, extents = projected.means2d[index], projected.extents[index]
    origin = torch.tensor([lattice.x0, lattice.y0], device=device, dtype=dtype)
    step = torch.tensor([lattice.dx, lattice.dy], device=device, dtype=dtype)
    last = torch.tensor([lattice.width, lattice.height], device=device, dtype=dtype) * lattice.side - 1
    # Bounds are clipped as floats: a Gaussian far outside the image overflows an integer.
    low = torch.minimum(((means - extents - origin) / step).ceil().clamp(min=0), last + 1)
    high = torch.minimum(((means + extents - origin) / step).floor().clamp(min=-1), last)
    meets = (low <= high).all(dim=1)
    index, low, high = index[meets], low[meets].long() // lattice.tile, high[meets].long() // lattice.tile
    tiles_x, tiles_y = _tile_counts(lattice)
    across, down = (high - low + 1).unbind(dim=1)
    uses = across * down
    pair = torch.repeat_interleave(torch.arange(len(index), device=device), uses)
    nth = torch.arange(len(pair), device=device) - (uses.cumsum(0) - uses)[pair]
    tile = (low[pair, 1] + nth // across[pair]) * tiles_x + low[pair, 0] + nth % across[pair]
    tile, order = torch.sort(tile, stable=True)
    starts = torch.searchsorted(tile, torch.arange(tiles_x * tiles_y + 1, device=device))
    return starts, index[pair[order]]


def _tile_counts(lattice: Lattice) -> tuple[int, int]:
    tile, side = lattice.tile, lattice.side
    return -(-lattice.width * side // tile), -(-lattice.height * side // tile)


def _composite_tiles(
    tiles: Int64[Tensor, " A"],
    starts: Int64[Tensor, " tiles_plus_1"],
    members: Int64[Tensor, " n"],
    packed: Float[Tensor, "N 6"],
    lattice: Lattice,
    stop: float,
    keep: float,
) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Composites the lists of some tiles: (row, Gaussian, weight) of the entries of each round. `packed` are means,
    conics and opacities on the image plane."""
    tile, side, device = lattice.tile, lattice.side, packed.device
    cells, (tiles_x, _) = tile // side, _tile_counts(lattice)
    step, cell = torch.arange(tile, device=device), torch.arange(cells, device=device)
    slot = torch.arange(ROUND, device=device)
    column, line = tiles % tiles_x, tiles // tiles_x
    u, v = column.unsqueeze(1) * tile + step, line.unsqueeze(1) * tile + step
    inside = (v < lattice.height * side).unsqueeze(2) & (u < lattice.width * side).unsqueeze(1)
    # The logarithm of each ray's transmittance; rays beyond the grid have ended before they begin.
    light = torch.where(inside, 0.0, -math.inf).to(packed.dtype)
    x, y = u.to(packed.dtype) * lattice.dx + lattice.x0, v.to(packed.dtype) * lattice.dy + lattice.y0
    row = (line.unsqueeze(1) * cells + cell).unsqueeze(2) * lattice.width + (column.unsqueeze(1) * cells + cell)[
        :, None
    ]
    next_member, end = starts[tiles], starts[tiles + 1]
    dark = math.log(stop)
    parts = []
    while len(next_member):
        at = next_member.unsqueeze(1) + slot
        member = members[at.clamp(max=len(members) - 1)]
        a, b, c = (part.unsqueeze(1) for part in packed[member, 2:5].unbind(dim=2))
        opacity = torch.where(at < end.unsqueeze(1), packed[member, 5], 0)[:, None, None]
        du, dv = x.unsqueeze(2) - packed[member, 0].unsqueeze(1), y.unsqueeze(2) - packed[member, 1].unsqueeze(1)
        power = (0.5 * c * dv * dv).unsqueeze(2) + (0.5 * a * du * du).unsqueeze(1)
        power += (b * dv).unsqueeze(2) * du.unsqueeze(1)
        alpha = (opacity * torch.exp(-power)).clamp(max=ALPHA_MAX)
        alpha = torch.where(alpha >= ALPHA_MIN, alpha, 0)
        lost = torch.log1p(-alpha).cumsum(dim=3)
        before = torch.cat((torch.zeros_like(lost[..., :1]), lost[..., :-1]), dim=3) + light.unsqueeze(3)
        weight = torch.where(lost + light.unsqueeze(3) > dark, alpha * before.exp(), 0)
        if side > 1:
            weight = weight.view(-1, cells, side, cells, side, ROUND).sum(dim=(2, 4)) / side**2
        which = (weight >= keep if keep > 0 else weight > 0).nonzero(as_tuple=True)
        parts.append((row[which[:3]], member[which[0], which[3]], weight[which]))
        light, next_member = light + lost[..., -1], next_member + ROUND
        going = ((next_member < end) & (light > dark).flatten(1).any(dim=1)).nonzero().squeeze(1)
        light, next_member, end, x, y, row = (each[going] for each in (light, next_member, end, x, y, row))
    return parts


def reference_weights(
    projected: Projected, opacities: Float[Tensor, " N"], lattice: Lattice, *, stop: float, keep: float
) -> tuple[Int64[Tensor, " P_plus_1"], Int32[Tensor, " nnz"], Float[Tensor, " nnz"]]:
    """CSR (crow, col, weight) of B, the plain twin of the fast backends: what B is in few lines.

    For each tile the Gaussians whose ellipse of alpha ≥ 1/255 may touch it are composited over the tile's rays as a
    dense rays × Gaussians table, w = α·exp(Σ_before log1p(−α)). A ray ends where its transmittance falls to `stop`, the
    Gaussian that would cross it excluded; weights below `keep` are left out.
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
    """B @ values for single rays, differentiable in the geometry as well: the twin of the kernels in rasterize.py."""
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
    """Adds CSR @ one_hot(codes) to out[targets], by sums over entries sorted by target and code; code −1 gives nothing,
    and targets are distinct."""
    row = torch.repeat_interleave(torch.arange(len(crow) - 1, device=crow.device), crow.diff())
    code = codes[col.long()].long()
    coded = code >= 0
    key, order = torch.sort(targets[row[coded]] * out.shape[1] + code[coded], stable=True)
    if not len(key):
        return
    keys, uses = torch.unique_consecutive(key, return_counts=True)
    sums = torch.segment_reduce(weight[coded][order].to(out.dtype), "sum", lengths=uses, axis=0)
    out.view(-1).index_add_(0, keys, sums)
