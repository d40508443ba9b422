"""The encoder from raw Gaussians on, grid, curves, patches and neighbors included, in operators that ONNX has.

What `plan.plan_cloud` and `plan.join_plans` work out for a cloud is worked out here again, for one cloud whose size is
known only when it comes: without searches for duplicates, segments or sizes that Python has to see.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float32, Float64, Int32, Int64, Integer
from torch import Tensor, nn

from gsencoder.models.embed import embed
from gsencoder.models.encoder import GaussianEncoder
from gsencoder.models.grid.neighbors import AHEAD
from gsencoder.models.grid.plan import Level, Plan
from gsencoder.models.grid.serialize import ALIGN, MOST_LEVELS, NEVER, Order, hilbert_from_morton, morton_codes, swapped
from gsencoder.models.output_space import OutputSpace
from gsencoder.models.point_transformer import TransformerConfig


class Tokens(NamedTuple):
    """The tokens of one level, in Morton order.

    Attributes:
        cells: of the grid.
        morton: their codes.
        along: their codes along each order.
    """

    cells: Int64[Tensor, "T 3"]
    morton: Int64[Tensor, " T"]
    along: dict[Order, Int64[Tensor, " T"]]

    def coarser(self, first: Int64[Tensor, " M"]) -> "Tokens":
        """The level below, of which these rows are the first children."""
        along = {order: codes.index_select(0, first) >> 3 for order, codes in self.along.items()}
        return Tokens(self.cells.index_select(0, first) >> 1, self.morton.index_select(0, first) >> 3, along)


class RawEncoder(nn.Module):
    """`GaussianEncoder` with everything that comes before it and `OutputSpace.restore` after it."""

    def __init__(self, encoder: GaussianEncoder, outputs: OutputSpace) -> None:
        super().__init__()
        self.encoder, self.unit = encoder, outputs.unit
        mean = torch.zeros(outputs.channels) if outputs.basis is not None else torch.from_numpy(outputs.mean)
        self.register_buffer("space_mean", mean, persistent=False)

    def forward(
        self,
        means: Float32[Tensor, "N 3"],
        quats: Float32[Tensor, "N 4"],
        scales: Float32[Tensor, "N 3"],
        opacities: Float32[Tensor, " N"],
        sh_dc: Float32[Tensor, "N 3"],
        voxel: Float64[Tensor, ""],
        corner: Float32[Tensor, "3"],
        starts: Int64[Tensor, "rows P"],
    ) -> Float32[Tensor, "N channels"]:
        """Features of a cloud of one Gaussian or more: coordinates in the basis, or vectors of the space.

        Args:
            means: centers, world units.
            quats: wxyz; normalized here.
            scales: standard deviations > 0, world units.
            opacities: in [0, 1].
            sh_dc: degree-0 spherical-harmonic coefficients.
            voxel: edge of the finest grid, world units. An input, since the exporter rounds constants to float32, and
                a Gaussian at the border of a cell would fall into another.
            corner: of the scene that the cloud is a part of (`Curves.corner`); +inf where it is all of it.
            starts: of that scene, a row for each order of each level in turn (`Curves.starts`), filled up with `NEVER`;
                negative where the cloud is all of it.
        """
        config = self.encoder.config
        attributes = embed(means, quats, scales, opacities, sh_dc, voxel=voxel, attributes=config.inputs)
        plan = _plan(means, voxel, corner, starts, config.transformer)
        found: Tensor = self.encoder(attributes, opacities, plan)
        return found * self.unit + self.get_buffer("space_mean")


def _plan(means: Tensor, voxel: Tensor, corner: Tensor, starts: Tensor, config: TransformerConfig) -> Plan:
    scaled = torch.floor(means.double() / voxel)
    low = torch.minimum(scaled.amin(dim=0), torch.floor(corner.double() / voxel))
    cells = (scaled - torch.floor(low / ALIGN) * ALIGN).long()
    codes, members = torch.sort(morton_codes(cells), stable=True)
    first, token_of_member = _runs(codes)
    morton = codes.index_select(0, first)
    along = {order: _along(morton, order) for order in config.orders}
    tokens = Tokens(cells.index_select(0, members.index_select(0, first)), morton, along)
    levels = []
    for level in range(config.levels):
        neighbors = _neighbor_table(tokens.cells)
        cut = {
            number: _patches(
                tokens.along[config.orders[number]], starts[level * len(config.orders) + number], config.patch
            )
            for number in sorted(config.orders_followed[level])
        }
        # Orders that no block follows here stand for nothing.
        patches = [cut.get(number, next(iter(cut.values()))) for number in range(len(config.orders)) if cut]
        first_child, parents = _runs(tokens.morton >> 3)
        levels.append(
            Level(
                neighbors=neighbors,
                gathers=tuple(each.gather for each in patches),
                scatters=tuple(each.scatter for each in patches),
                attn_mask=tuple(each.mask for each in patches),
                width=config.patch,
                parents=parents,
                children=_children(first_child, parents.shape[0]),
            )
        )
        if level + 1 < config.levels:
            tokens = tokens.coarser(first_child)
    return Plan(
        token_of=torch.empty_like(members).scatter(0, members, token_of_member),
        members=members,
        counts=_lengths(first, members.shape[0]),
        levels=tuple(levels),
    )


def _along(morton: Int64[Tensor, " T"], order: Order) -> Int64[Tensor, " T"]:
    """As `serialize.encode_morton`."""
    turned = swapped(morton, order)
    return hilbert(turned) if order.startswith("hilbert") else turned


@torch.library.custom_op("gsencoder::hilbert", mutates_args=())
def hilbert(morton: Tensor) -> Tensor:
    """Hilbert's curve as one operator, since how far it has to look is known only when a graph runs."""
    found: Tensor = hilbert_from_morton(morton, MOST_LEVELS)
    return found


@hilbert.register_fake
def _(morton: Tensor) -> Tensor:
    return torch.empty_like(morton)


def _runs(codes: Int64[Tensor, " N"]) -> tuple[Int64[Tensor, " T"], Int64[Tensor, " N"]]:
    """The first row of each run of equal codes, and each row's run."""
    begins = (codes != codes.roll(1)) | (torch.arange(codes.shape[0], device=codes.device) == 0)
    return torch.nonzero(begins).squeeze(1), begins.long().cumsum(0) - 1


def _lengths(first: Int64[Tensor, " T"], total: int) -> Int64[Tensor, " T"]:
    """How many rows each run has."""
    return torch.cat((first[1:], first[:1] + total)) - first


def _children(first: Int64[Tensor, " M"], total: int) -> Int64[Tensor, "M 8"]:
    """See `plan.Level`; siblings follow one another."""
    step = torch.arange(8, device=first.device)
    return first[:, None] + torch.where(step < _lengths(first, total)[:, None], step, 0)


def _neighbor_table(cells: Int64[Tensor, "T 3"]) -> Int32[Tensor, "T 27"]:
    """As `neighbors.neighbor_table`, without strides that Python has to see."""
    count = cells.shape[0]
    low, high = cells.amin(dim=0), cells.amax(dim=0)
    sizes = high - low + 3
    strides = torch.stack((sizes[1] * sizes[2], sizes[2], torch.ones_like(sizes[0])))
    keys, order = torch.sort(((cells - low + 1) * strides).sum(dim=1), stable=True)
    own = torch.arange(count, device=cells.device, dtype=torch.int32)
    ahead = torch.tensor([[dx, dy, -1] for dx, dy in AHEAD], device=cells.device)
    wanted = keys + (ahead * strides).sum(dim=1, keepdim=True)
    place = torch.searchsorted(keys, wanted).int()
    padded = torch.cat((keys, keys.new_full((3,), NEVER)))
    after = []
    for _ in range(3):
        hit = _take(padded, place) == wanted
        after.append(torch.where(hit, place, count))
        place, wanted = place + hit.int(), wanted + 1
    # Cells 15 to 26, which face 11 to 0.
    facing = torch.stack(after, dim=1).view(12, -1)
    nobody = torch.full_like(facing[:, :1], count)
    before = torch.cat((torch.full_like(facing, count), nobody), dim=1).scatter(1, facing.long(), own.expand(12, -1))
    beyond = torch.where(_take(padded, own + 1) == keys + 1, own + 1, count)
    previous = torch.where(keys.roll(1) == keys - 1, own - 1, count)
    found = torch.cat((before[:, :-1].flip(0), torch.stack((previous, own, beyond)), facing))
    rows = _take(torch.cat((order.int(), torch.full_like(own[:1], count))), found)
    return rows.T.index_select(0, torch.empty_like(own).scatter(0, order, own))


def _take(values: Integer[Tensor, " n"], places: Int32[Tensor, "..."]) -> Integer[Tensor, "..."]:
    return values.index_select(0, places.flatten()).view(places.shape)


class Patches(NamedTuple):
    """How one order cuts one level; see `plan.Level`, whose fields for one order these are."""

    gather: Int64[Tensor, " places"]
    scatter: Int64[Tensor, " T"]
    mask: Tensor


def _patches(codes: Int64[Tensor, " T"], starts: Int64[Tensor, " P"], patch: int) -> Patches:
    """Patches of at most `patch` tokens, each padded to that many places.

    Args:
        codes: along the order, of the tokens.
        starts: of the whole scene's patches; negative where this is all of it.
        patch: most tokens in a patch.
    """
    count = codes.shape[0]
    codes, rows = torch.sort(codes, stable=True)
    rank = torch.arange(count, device=codes.device)
    number = ((rank + 1) * ((count + patch - 1) // patch) - 1) // count
    number = torch.where(starts[:1] < 0, number, torch.searchsorted(starts, codes, right=True) - 1)
    first, run = _runs(number)
    slots = run * patch + rank - first.index_select(0, run)
    places = rank.new_zeros(first.shape[0] * patch)
    used = torch.zeros_like(places, dtype=torch.bool).scatter(0, slots, torch.ones_like(rank, dtype=torch.bool))
    return Patches(
        gather=places.scatter(0, slots, rows),
        scatter=torch.empty_like(rows).scatter(0, rows, slots),
        mask=used.view(-1, 1, 1, patch),
    )
