"""Plans: everything about a cloud of Gaussians that does not depend on features, worked out once and then reused.

Gaussians are merged on a grid into tokens. Each level of the network has its tokens' neighbors, the order in which
attention cuts them into patches, and the way down to the next level and back. Tokens are kept in Morton order, so that
whatever lies close in space lies close in memory.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int32, Int64, Integer
from torch import Tensor

from gsencoder.models.grid.cells import cells_of
from gsencoder.models.grid.curves import Curves
from gsencoder.models.grid.neighbors import neighbor_table
from gsencoder.models.grid.serialize import Order, bits_of, encode_morton, morton_codes

ORDERS: tuple[Order, ...] = ("z", "z-trans", "hilbert", "hilbert-trans")


class Level(NamedTuple):
    """One level of one or several clouds, T tokens in all, in O orders.

    Attributes:
        neighbors: the 27 cells around each token; T where there is none.
        gathers: for each order the token at every place of every patch; padding repeats a token.
        scatters: for each order the place of every token.
        attn_mask: for each order False at places that are not to be looked at; None where no patch is padded.
            `RawEncoder` has gathers, scatters and masks as tuples, since its orders may have different numbers of
            patches.
        width: places in a patch.
        parents: each token's token one level below (coarser); empty at the last level.
        children: each coarser token's tokens here, eight of them, the first repeated where there are fewer.
    """

    neighbors: Integer[Tensor, "T 27"]
    gathers: Int64[Tensor, "O places"] | tuple[Int64[Tensor, " _places"], ...]
    scatters: Int64[Tensor, "O T"] | tuple[Int64[Tensor, " T"], ...]
    attn_mask: Bool[Tensor, "O patches 1 1 width"] | tuple[Bool[Tensor, "_patches 1 1 width"], ...] | None
    width: int
    parents: Int64[Tensor, " parents"]
    children: Int64[Tensor, "M 8"]


class Plan(NamedTuple):
    """A batch of clouds, N Gaussians and T tokens in all.

    Attributes:
        token_of: each Gaussian's token.
        members: the Gaussians sorted by token.
        counts: how many of them each token has.
        levels: finest first.
    """

    token_of: Int64[Tensor, " N"]
    members: Int64[Tensor, " N"]
    counts: Int64[Tensor, " T"]
    levels: tuple[Level, ...]

    def to(self, device: str | torch.device) -> "Plan":
        """The same on another device."""

        def move(value: Tensor | tuple[Tensor, ...]) -> Any:
            if isinstance(value, tuple):
                return tuple(map(move, value))
            return value.to(device, non_blocking=True)

        levels = tuple(
            level._replace(
                neighbors=move(level.neighbors),
                gathers=move(level.gathers),
                scatters=move(level.scatters),
                attn_mask=move(level.attn_mask) if level.attn_mask is not None else None,
                parents=move(level.parents),
                children=move(level.children),
            )
            for level in self.levels
        )
        token_of, members, counts = map(move, (self.token_of, self.members, self.counts))
        return self._replace(token_of=token_of, members=members, counts=counts, levels=levels)


class CloudLevel(NamedTuple):
    """One level of one cloud, before patches are cut.

    Attributes:
        neighbors, parents, children: as in `Level`.
        orders: for each order the tokens along the curve.
        patches: for each order the patches of the whole scene that these tokens are in; None where this is all of it.
    """

    neighbors: Int32[Tensor, "T 27"]
    orders: Int64[Tensor, "O T"]
    parents: Int64[Tensor, " parents"]
    children: Int64[Tensor, "M 8"]
    patches: Int64[Tensor, "O T"] | None = None


class CloudPlan(NamedTuple):
    """One cloud, before clouds are put together."""

    token_of: Int64[Tensor, " N"]
    members: Int64[Tensor, " N"]
    counts: Int64[Tensor, " T"]
    levels: tuple[CloudLevel, ...]


def plan_cloud(
    means: Float[Tensor, "N 3"],
    voxel: float,
    *,
    levels: int,
    orders: Sequence[Order] = ORDERS,
    whole: Curves | None = None,
) -> CloudPlan:
    """The plan of one cloud.

    Args:
        means: centers in world units.
        voxel: edge of the finest grid, world units; each level below doubles it.
        levels: how many there are.
        orders: the curves that attention follows, in turn.
        whole: of the scene that the cloud is a part of, with the same voxel, levels, orders and patch as here and in
            `join_plans`; None = it is all of it. Patches are then cut where those of the whole are, so that tokens meet
            the same others.

    Raises:
        InputError: positions that are not finite, or spread over too many cells.
    """
    cells = cells_of(means, voxel, torch.from_numpy(whole.corner) if whole is not None else None)
    codes, members = torch.sort(morton_codes(cells), stable=True)
    _, token_of_member, counts = torch.unique_consecutive(codes, return_inverse=True, return_counts=True)
    token_of = torch.empty_like(members)
    token_of[members] = token_of_member
    # The first member of each token stands for its cell; members are sorted, so tokens are in Morton order.
    cells = cells[members[counts.cumsum(0) - counts]]
    bits, morton = bits_of(cells), codes[counts.cumsum(0) - counts]
    along = torch.stack([encode_morton(morton, order, bits) for order in orders])
    found = []
    for level in range(levels):
        parents, children, first = _pool(morton) if level + 1 < levels else _no_pool(morton)
        codes, sorted_rows = torch.sort(along, dim=1)
        patches = None
        if whole is not None:
            starts = torch.from_numpy(whole.starts[level]).to(codes.device)
            patches = torch.searchsorted(starts, codes, right=True) - 1
        found.append(CloudLevel(neighbor_table(cells), sorted_rows, parents, children, patches))
        cells, morton, along = cells[first] >> 1, morton[first] >> 3, along[:, first] >> 3
    return CloudPlan(token_of, members, counts, tuple(found))


def _pool(morton: Int64[Tensor, " T"]) -> tuple[Int64[Tensor, " T"], Int64[Tensor, "M 8"], Int64[Tensor, " M"]]:
    """Parents, children and first children of tokens in Morton order: siblings follow one another."""
    _, parents, counts = torch.unique_consecutive(morton >> 3, return_inverse=True, return_counts=True)
    first = counts.cumsum(0) - counts
    step = torch.arange(8, device=morton.device)
    children = first[:, None] + torch.where(step < counts[:, None], step, 0)
    return parents, children, first


def _no_pool(morton: Int64[Tensor, " T"]) -> tuple[Tensor, Tensor, Tensor]:
    nothing = morton.new_zeros(0)
    return nothing, nothing.view(0, 8), nothing


def join_plans(clouds: Sequence[CloudPlan], patch: int, *, round_up: bool = True) -> Plan:
    """Puts clouds side by side, without padding between them, and cuts each into patches of nearly equal size.

    Args:
        clouds: with equally many levels and orders.
        patch: most tokens in a patch. A cloud of n tokens has ⌈n / patch⌉ patches of n // that or one more; one that is
            a part of a scene has what it holds of the scene's patches.
        round_up: let every level end in tokens that stand for nothing, so that few different sizes occur: libraries
            that compile a product for each size (oneDNN in bfloat16, torch.compile) then do so rarely.
    """
    tokens = [len(cloud.counts) for cloud in clouds]
    gaussians = [len(cloud.members) for cloud in clouds]
    levels = []
    for level in range(len(clouds[0].levels)):
        parts = [cloud.levels[level] for cloud in clouds]
        levels.append(_join_levels(parts, patch, _rounded if round_up else int))
    return Plan(
        token_of=_shifted([cloud.token_of for cloud in clouds], tokens),
        members=_shifted([cloud.members for cloud in clouds], gaussians),
        counts=torch.cat([cloud.counts for cloud in clouds]),
        levels=tuple(levels),
    )


def _rounded(count: int) -> int:
    """The next multiple of an eighth to a sixteenth of it."""
    step = 1 << max(3, count.bit_length() - 4)
    return -(-count // step) * step


def _shifted(parts: Sequence[Tensor], sizes: Sequence[int], dim: int = 0) -> Tensor:
    """Row numbers of several clouds as row numbers of all of them together."""
    starts = [sum(sizes[:i]) for i in range(len(sizes))]
    return torch.cat([part + start for part, start in zip(parts, starts, strict=True)], dim=dim)


def _grown(rows: Tensor, size: int, value: int = 0, dim: int = 0) -> Tensor:
    """The same with rows of `value` at the end, `size` in all."""
    missing = size - rows.shape[dim]
    if missing == 0:
        return rows
    shape = [missing if axis == dim else length for axis, length in enumerate(rows.shape)]
    return torch.cat((rows, rows.new_full(shape, value)), dim=dim)


def _join_levels(parts: Sequence[CloudLevel], patch: int, size: Callable[[int], int]) -> Level:
    sizes = [len(part.neighbors) for part in parts]
    total, coarser = size(sum(sizes)), [len(part.children) for part in parts]
    neighbors = parts[0].neighbors
    if len(parts) > 1 or total != len(neighbors):
        neighbors, begin = neighbors.new_full((total, neighbors.shape[1]), total), 0
        for part, own in zip(parts, sizes, strict=True):
            rows = neighbors[begin : begin + own]
            torch.add(part.neighbors, begin, out=rows).masked_fill_(part.neighbors == own, total)
            begin += own
    orders = _shifted([part.orders for part in parts], sizes, dim=1)
    places, slots, used = _patches(_lengths(parts, patch), size)
    scatters = torch.empty_like(orders).scatter_(1, orders, slots.expand_as(orders))
    # Tokens that stand for nothing have no neighbors, are in no patch and no real token's children, and whatever is
    # read for them is never used.
    return Level(
        neighbors=neighbors,
        gathers=orders.gather(1, places.expand(len(orders), -1)),
        scatters=_grown(scatters, total, dim=1),
        attn_mask=None if bool(used.all()) else used[:, :, None, None].expand(len(orders), -1, -1, -1, -1),
        width=used.shape[2],
        parents=_grown(_shifted([part.parents for part in parts], coarser), total if sum(coarser) else 0),
        children=_grown(_shifted([part.children for part in parts], sizes), size(sum(coarser))),
    )


def _lengths(parts: Sequence[CloudLevel], patch: int) -> list[Int64[Tensor, " patches"]]:
    """How many tokens each patch has, for each order; for all orders at once where none of the clouds is a part."""
    found = []
    for order in range(len(parts[0].orders) if any(part.patches is not None for part in parts) else 1):
        lengths = []
        for part in parts:
            count = part.orders.shape[1]
            if part.patches is None:
                patches = -(-count // patch)
                bounds = torch.arange(patches + 1, device=part.orders.device) * count // max(patches, 1)
                lengths.append(bounds.diff())
            else:
                lengths.append(torch.unique_consecutive(part.patches[order], return_counts=True)[1])
        found.append(torch.cat(lengths))
    return found


def _patches(
    lengths: Sequence[Int64[Tensor, " _patches"]], size: Callable[[int], int]
) -> tuple[Int64[Tensor, "o places"], Int64[Tensor, "o T"], Bool[Tensor, "o patches width"]]:
    """The position in the order at each place, the place of each position, and which places are more than padding."""
    count = size(max(len(each) for each in lengths))
    length = torch.stack([_grown(each, count) for each in lengths])
    width = int(length.max()) if count else 0
    step = torch.arange(width, device=length.device)
    used = step < length[..., None]
    slots = torch.nonzero(used.flatten(1))[:, 1].view(len(lengths), -1)
    # A patch of nothing attends to a token again and again, without a mask; nobody reads the result.
    nothing = length == 0
    start = (length.cumsum(dim=1) - length).masked_fill(nothing, 0)
    places = start[..., None] + torch.where(used, step, 0)
    return places.flatten(1), slots, used | nothing[..., None]
