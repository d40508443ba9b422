"""Plans of clouds of Gaussians: all index tensors of the network, computed once from the centers and then reused.

Gaussians are merged on a voxel grid into tokens. Each level of the network has a table of neighbors, the order in which
attention cuts its tokens into patches, and the indices for pooling to the next coarser level and back. Tokens are in
Morton order, so that tokens that are close in space are mostly close in memory.
"""

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Int32, Int64, Integer
from torch import Tensor

from gsencoder.core.errors import InputError
from gsencoder.models.grid import (
    ALIGN,
    Order,
    SceneCurves,
    check_extent,
    coordinate_bits,
    curve_from_morton,
    morton_codes,
)

KernelSize = Literal[3, 5]
"""Edge k of the cube of k³ cells around a cell. Cell o = k²·(dx + r) + k·(dy + r) + (dz + r) with r = (k − 1) / 2: the
center is (k³ − 1) / 2, and k³ − 1 − o is opposite o."""


def grid_coords(points: Tensor, voxel: float, corner: Tensor | None = None) -> Int64[Tensor, "N 3"]:
    """Non-negative grid coordinates of points.

    Cell borders lie at multiples of `voxel` in world coordinates. The origin of the coordinates is the largest multiple
    of ALIGN cells at or below the lowest point on each axis, or the lowest `corner` of the full scene, so that a part
    of a scene is divided into cells and pooled exactly as the full scene is.
    """
    if not len(points):
        return torch.zeros(0, 3, dtype=torch.int64, device=points.device)
    if not torch.isfinite(points).all():
        bad = int((~torch.isfinite(points).all(dim=1)).sum())
        raise InputError(f"grid: {bad} of {len(points)} positions are not finite")
    scaled = torch.floor(points.double() / voxel)
    low, high = scaled.aminmax(dim=0)
    if corner is not None:
        low = torch.minimum(low, torch.floor(corner.to(scaled) / voxel))
    check_extent((high - low + 1).max().item(), voxel)
    return (scaled - torch.floor(low / ALIGN) * ALIGN).long()


ORDERS: tuple[Order, ...] = ("z", "z-trans", "hilbert", "hilbert-trans")


class Level(NamedTuple):
    """One level of a batch of clouds: T tokens in all, cut along O orders into patches of `patch_width` slots.

    Attributes:
        neighbors: the 27 cells around each token; T where a cell is not occupied.
        gather_index: for each order, the token in each slot of each patch; padding repeats a token.
        scatter_index: for each order, the slot of each token.
        attn_mask: for each order, False in slots of padding; None if no patch is padded. `RawEncoder` has gather_index,
            scatter_index and attn_mask as tuples, since its orders may have different numbers of patches.
        parents: the token of the next coarser level that each token is pooled into; empty at the last level.
        children: for each token of the next coarser level, its eight tokens here; the first is repeated where there are
            fewer.
    """

    neighbors: Integer[Tensor, "T 27"]
    gather_index: Int64[Tensor, "O slots"] | tuple[Int64[Tensor, " _slots"], ...]
    scatter_index: Int64[Tensor, "O T"] | tuple[Int64[Tensor, " T"], ...]
    attn_mask: Bool[Tensor, "O patches 1 1 width"] | tuple[Bool[Tensor, "_patches 1 1 width"], ...] | None
    patch_width: int
    parents: Int64[Tensor, " parents"]
    children: Int64[Tensor, "M 8"]


class Plan(NamedTuple):
    """The plan of a batch of clouds, N Gaussians and T tokens in all.

    Attributes:
        token_of: the token of each Gaussian whose features are asked for: all N in their order, or M of them.
        members: the Gaussians sorted by token.
        counts: number of Gaussians of each token.
        levels: finest first.
        stem_neighbors: the cells around each token for a stem of 5³ cells, as `neighbors` of a level; None for 3³.
    """

    token_of: Int64[Tensor, " M"]
    members: Int64[Tensor, " N"]
    counts: Int64[Tensor, " T"]
    levels: tuple[Level, ...]
    stem_neighbors: Integer[Tensor, "T 125"] | None = None


class CloudLevel(NamedTuple):
    """One level of one cloud, not yet cut into patches, as in `Level`; for each order the tokens along its curve, and
    the patches of the full scene that these are in, None if the cloud is the full scene."""

    neighbors: Int32[Tensor, "T 27"]
    sorted_tokens: Int64[Tensor, "O T"]
    parents: Int64[Tensor, " parents"]
    children: Int64[Tensor, "M 8"]
    scene_patches: Int64[Tensor, "O T"] | None = None


class CloudPlan(NamedTuple):
    """The plan of one cloud, before clouds are joined; attributes as in `Plan`."""

    token_of: Int64[Tensor, " M"]
    members: Int64[Tensor, " N"]
    counts: Int64[Tensor, " T"]
    levels: tuple[CloudLevel, ...]
    stem_neighbors: Int32[Tensor, "T 125"] | None = None


def forward_columns(size: KernelSize) -> tuple[tuple[int, int], ...]:
    """Steps (dx, dy) to the columns of a neighborhood that come after the center's; the others are opposite them."""
    radius = size // 2
    steps = range(-radius, radius + 1)
    return tuple((dx, dy) for dx in steps for dy in steps if (dx, dy) > (0, 0))


def neighbor_table(cells: Int64[Tensor, "N 3"], size: KernelSize = 3) -> Int32[Tensor, "N cube"]:
    """For each of N distinct cells, the rows of the size³ cells around it; N for cells that are not occupied.

    Cells are sorted by column. For each forward column one binary search finds where the cells of the neighborhood
    would begin; they follow one another from there. Each match is entered at both cells.
    """
    n, cube, radius = len(cells), size**3, size // 2
    if n == 0:
        return torch.zeros((0, cube), dtype=torch.int32, device=cells.device)
    low, high = cells.aminmax(dim=0)
    # A border of empty cells on each side keeps the end of one column apart from the start of the next.
    sizes = (high - low + 1 + 2 * radius).tolist()
    stride_y, stride_x = sizes[2], sizes[2] * sizes[1]
    x, y, z = (cells - low + radius).unbind(dim=1)
    keys = x * stride_x + y * stride_y + z
    # The keys of a room fit into half the bits, which are sorted in a quarter of the time.
    keys, order = torch.sort(keys.int() if sizes[0] * stride_x < 2**31 else keys)
    positions = torch.arange(n, dtype=torch.int32, device=cells.device)
    missing = positions.new_full((), n)
    # Entry [o, i] is the position among the sorted cells of neighbor o of the cell at position i. Column n takes the
    # writes of cells that are missing.
    table = positions.new_full((cube, n + 1), n)
    table[cube // 2, :n] = positions
    # Two entries that no key equals let the walk along a column run past the end.
    padded = torch.cat((keys, keys.new_full((2,), torch.iinfo(keys.dtype).max)))
    above = positions + 1
    for step in range(1, radius + 1):
        hit = padded.index_select(0, above) == keys + step
        table[cube // 2 + step, :n] = torch.where(hit, above, missing)
        table[cube // 2 - step].scatter_(0, table[cube // 2 + step, :n].long(), positions)
        above = above + hit
    columns = forward_columns(size)
    offsets = keys.new_tensor([dx * stride_x + dy * stride_y - radius for dx, dy in columns])
    target_keys = keys + offsets[:, None]
    position = torch.searchsorted(keys, target_keys, out_int32=True)
    for step in range(size):
        hit = padded.index_select(0, position.flatten()).view(len(columns), n) == target_keys
        neighbor = torch.where(hit, position, missing)
        for column, (dx, dy) in enumerate(columns):
            cell = size**2 * (dx + radius) + size * (dy + radius) + step
            table[cell, :n] = neighbor[column]
            table[cube - 1 - cell].scatter_(0, neighbor[column].long(), positions)
        position += hit
        target_keys += 1
    rows = torch.cat((order.int(), missing[None])).index_select(0, table.flatten()).view(cube, n + 1)
    position_of_row = torch.empty_like(order)
    position_of_row[order] = torch.arange(n, device=order.device)
    return rows[:, :n].T.contiguous().index_select(0, position_of_row)


def plan_cloud(
    means: Float[Tensor, "N 3"],
    voxel: float,
    *,
    levels: int,
    orders: Sequence[Order] = ORDERS,
    scene_curves: SceneCurves | None = None,
    stem: KernelSize = 3,
) -> CloudPlan:
    """The plan of one cloud.

    Args:
        voxel: edge length of the finest grid's cells, world units; it doubles from level to level.
        orders: the curves that attention follows, in turn.
        scene_curves: patch boundaries of the full scene, made with the same voxel, levels, orders and patch. The cloud
            is then cut where the scene is, so that its tokens share a patch exactly where they do in the scene.
        stem: edge of the neighborhood of the encoder's first convolution, cells.
    """
    cells = grid_coords(means, voxel, torch.from_numpy(scene_curves.corner) if scene_curves is not None else None)
    codes, members = torch.sort(morton_codes(cells), stable=True)
    _, token_of_member, counts = torch.unique_consecutive(codes, return_inverse=True, return_counts=True)
    token_of = torch.empty_like(members)
    token_of[members] = token_of_member
    # The first member of each token stands for its cell; members are sorted, so tokens are in Morton order.
    cells = cells[members[counts.cumsum(0) - counts]]
    bits, morton = coordinate_bits(cells), codes[counts.cumsum(0) - counts]
    curve_codes = torch.stack([curve_from_morton(morton, order, bits) for order in orders])
    stem_neighbors = neighbor_table(cells, stem) if stem != 3 else None
    cloud_levels = []
    for level in range(levels):
        parents, children, first = _pool_tokens(morton if level + 1 < levels else morton[:0])
        codes, sorted_tokens = torch.sort(curve_codes, dim=1)
        scene_patches = None
        if scene_curves is not None:
            starts = torch.from_numpy(scene_curves.starts[level]).to(codes.device)
            scene_patches = torch.searchsorted(starts, codes, right=True) - 1
        cloud_levels.append(CloudLevel(neighbor_table(cells), sorted_tokens, parents, children, scene_patches))
        cells, morton, curve_codes = cells[first] >> 1, morton[first] >> 3, curve_codes[:, first] >> 3
    return CloudPlan(token_of, members, counts, tuple(cloud_levels), stem_neighbors)


def _pool_tokens(morton: Int64[Tensor, " T"]) -> tuple[Int64[Tensor, " T"], Int64[Tensor, "M 8"], Int64[Tensor, " M"]]:
    """Parents, children and first children of tokens in Morton order, in which siblings follow one another."""
    _, parents, counts = torch.unique_consecutive(morton >> 3, return_inverse=True, return_counts=True)
    first = counts.cumsum(0) - counts
    step = torch.arange(8, device=morton.device)
    children = first[:, None] + torch.where(step < counts[:, None], step, 0)
    return parents, children, first


def join_plans(clouds: Sequence[CloudPlan], patch: int, *, round_up: bool = True) -> Plan:
    """Joins the plans of clouds to that of a batch, whose tokens follow one another, and cuts each cloud into patches
    of nearly equal size: ⌈n / patch⌉ of n tokens; a part of a scene has its share of each of the scene's patches.

    Args:
        round_up: append unused tokens to every level, so that few different sizes occur: libraries that compile a
            matrix product for each size (oneDNN in bfloat16) then do so rarely.
    """
    tokens = [len(cloud.counts) for cloud in clouds]
    gaussians = [len(cloud.members) for cloud in clouds]
    levels = []
    for level in range(len(clouds[0].levels)):
        cloud_levels = [cloud.levels[level] for cloud in clouds]
        levels.append(_join_levels(cloud_levels, patch, _round_up_size if round_up else int))
    stems = [cloud.stem_neighbors for cloud in clouds if cloud.stem_neighbors is not None]
    return Plan(
        token_of=_concat_indices([cloud.token_of for cloud in clouds], tokens),
        members=_concat_indices([cloud.members for cloud in clouds], gaussians),
        counts=torch.cat([cloud.counts for cloud in clouds]),
        levels=tuple(levels),
        stem_neighbors=_join_neighbors(stems, len(levels[0].neighbors)) if stems else None,
    )


def _round_up_size(count: int) -> int:
    """The next multiple of a power of two that is between a sixteenth and an eighth of the count, and at least 8."""
    step = 1 << max(3, count.bit_length() - 4)
    return -(-count // step) * step


def _concat_indices(indices: Sequence[Tensor], sizes: Sequence[int], dim: int = 0) -> Tensor:
    """Indices into several tensors as indices into their concatenation; `sizes` are the lengths of these tensors."""
    starts = [sum(sizes[:i]) for i in range(len(sizes))]
    return torch.cat([index + start for index, start in zip(indices, starts, strict=True)], dim=dim)


def _pad_to(rows: Tensor, size: int, value: int = 0, dim: int = 0) -> Tensor:
    """The tensor padded at its end with `value` to `size` entries along a dimension."""
    padding = size - rows.shape[dim]
    if padding == 0:
        return rows
    shape = [padding if axis == dim else length for axis, length in enumerate(rows.shape)]
    return torch.cat((rows, rows.new_full(shape, value)), dim=dim)


def _join_neighbors(tables: Sequence[Int32[Tensor, "_T cube"]], total: int) -> Int32[Tensor, "total cube"]:
    """Neighbors of the tokens of several clouds as rows of their concatenation, which is padded to `total` tokens."""
    if len(tables) == 1 and len(tables[0]) == total:
        return tables[0]
    joined, begin = tables[0].new_full((total, tables[0].shape[1]), total), 0
    for table in tables:
        rows = joined[begin : begin + len(table)]
        torch.add(table, begin, out=rows).masked_fill_(table == len(table), total)
        begin += len(table)
    return joined


def _join_levels(levels: Sequence[CloudLevel], patch: int, round_size: Callable[[int], int]) -> Level:
    sizes = [len(level.neighbors) for level in levels]
    total, coarser_sizes = round_size(sum(sizes)), [len(level.children) for level in levels]
    sorted_tokens = _concat_indices([level.sorted_tokens for level in levels], sizes, dim=1)
    positions, slots, used = _pack_patches(_patch_lengths(levels, patch), round_size)
    scatter_index = torch.empty_like(sorted_tokens).scatter_(1, sorted_tokens, slots.expand_as(sorted_tokens))
    # Unused tokens have no neighbors, are in no patch, and are not children of used tokens. What is computed for them
    # is never read.
    return Level(
        neighbors=_join_neighbors([level.neighbors for level in levels], total),
        gather_index=sorted_tokens.gather(1, positions.expand(len(sorted_tokens), -1)),
        scatter_index=_pad_to(scatter_index, total, dim=1),
        attn_mask=None if bool(used.all()) else used[:, :, None, None].expand(len(sorted_tokens), -1, -1, -1, -1),
        patch_width=used.shape[2],
        parents=_pad_to(
            _concat_indices([level.parents for level in levels], coarser_sizes), total if sum(coarser_sizes) else 0
        ),
        children=_pad_to(_concat_indices([level.children for level in levels], sizes), round_size(sum(coarser_sizes))),
    )


def _patch_lengths(levels: Sequence[CloudLevel], patch: int) -> list[Int64[Tensor, " patches"]]:
    """Numbers of tokens of the patches, for each order; one entry for all orders if no cloud is a part of a scene."""
    lengths = []
    for order in range(len(levels[0].sorted_tokens) if any(level.scene_patches is not None for level in levels) else 1):
        order_lengths = []
        for level in levels:
            count = level.sorted_tokens.shape[1]
            if level.scene_patches is None:
                patches = -(-count // patch)
                bounds = torch.arange(patches + 1, device=level.sorted_tokens.device) * count // max(patches, 1)
                order_lengths.append(bounds.diff())
            else:
                order_lengths.append(torch.unique_consecutive(level.scene_patches[order], return_counts=True)[1])
        lengths.append(torch.cat(order_lengths))
    return lengths


def _pack_patches(
    lengths: Sequence[Int64[Tensor, " _patches"]], round_size: Callable[[int], int]
) -> tuple[Int64[Tensor, "o slots"], Int64[Tensor, "o T"], Bool[Tensor, "o patches width"]]:
    """Packs runs of tokens along the curves into patches of one width: the position on the curve in each slot, the slot
    of each position, and which slots attention may look at."""
    count = round_size(max(len(order_lengths) for order_lengths in lengths))
    length = torch.stack([_pad_to(order_lengths, count) for order_lengths in lengths])
    width = int(length.max()) if count else 0
    step = torch.arange(width, device=length.device)
    used = step < length[..., None]
    slots = torch.nonzero(used.flatten(1))[:, 1].view(len(lengths), -1)
    # An empty patch holds one token repeatedly and is not masked, so that its softmax is finite; its result is unused.
    empty = length == 0
    start = (length.cumsum(dim=1) - length).masked_fill(empty, 0)
    positions = start[..., None] + torch.where(used, step, 0)
    return positions.flatten(1), slots, used | empty[..., None]
