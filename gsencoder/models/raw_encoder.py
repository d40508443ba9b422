"""The encoder from raw Gaussians on, with its grid, curves, patches and neighbors, in operators that ONNX has.

It computes the same plan as `plan.plan_cloud` and `plan.join_plans`, for one cloud of dynamic size: without unique,
segment operations, or sizes that Python would have to read.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float32, Float64, Int32, Int64, Integer
from torch import Tensor, nn

from gsencoder.models.encoder import GaussianEncoder
from gsencoder.models.grid import (
    ALIGN,
    INVALID_CODE,
    MAX_LEVELS,
    Order,
    hilbert_from_morton,
    morton_codes,
    swap_xy,
)
from gsencoder.models.output_space import OutputSpaces
from gsencoder.models.plan import KernelSize, Level, Plan, forward_columns
from gsencoder.models.transformer import TransformerConfig, embed


class TokenLevel(NamedTuple):
    """The tokens of one level, in Morton order: grid coordinates, Morton codes, and codes along each order."""

    cells: Int64[Tensor, "T 3"]
    morton: Int64[Tensor, " T"]
    curve_codes: dict[Order, Int64[Tensor, " T"]]

    def coarser(self, first: Int64[Tensor, " M"]) -> "TokenLevel":
        """The next coarser level, given the rows of the first child of each of its tokens."""
        curve_codes = {order: codes.index_select(0, first) >> 3 for order, codes in self.curve_codes.items()}
        return TokenLevel(self.cells.index_select(0, first) >> 1, self.morton.index_select(0, first) >> 3, curve_codes)


class RawEncoder(nn.Module):
    """`GaussianEncoder` with the computation of its inputs before it and `OutputSpaces.restore` after it."""

    def __init__(self, encoder: GaussianEncoder, outputs: OutputSpaces) -> None:
        super().__init__()
        self.encoder = encoder
        self.register_buffer("unit", torch.from_numpy(outputs.unit), persistent=False)
        self.register_buffer("offset", torch.from_numpy(outputs.offset), persistent=False)

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
        """Predicts features of a cloud of one or more Gaussians: coordinates in the basis, or vectors, of each space.

        Args:
            voxel: edge length of the finest grid's cells in units of the cloud, metres. An input, since the exporter
                would round a constant to float32, which moves Gaussians near a border to another cell.
            corner: lowest corner of the full scene if the cloud is a part of one (`SceneCurves.corner`), else +inf.
            starts: first codes of the patches of the full scene (`SceneCurves.starts`), a row for each order of each
                level in turn, padded with `INVALID_CODE`; negative if the cloud is the full scene.
        """
        config = self.encoder.config
        attributes = embed(means, quats, scales, opacities, sh_dc, voxel=voxel, attributes=config.inputs)
        plan = _plan_cloud(means, voxel, corner, starts, config.transformer, config.stem)
        standard: Tensor = self.encoder(attributes, opacities, plan)
        return standard * self.get_buffer("unit") + self.get_buffer("offset")


def _plan_cloud(
    means: Tensor, voxel: Tensor, corner: Tensor, starts: Tensor, config: TransformerConfig, stem: KernelSize
) -> Plan:
    """The twin of `plan.plan_cloud` and `plan.join_plans`."""
    scaled = torch.floor(means.double() / voxel)
    low = torch.minimum(scaled.amin(dim=0), torch.floor(corner.double() / voxel))
    cells = (scaled - torch.floor(low / ALIGN) * ALIGN).long()
    codes, members = torch.sort(morton_codes(cells), stable=True)
    first, token_of_member = _runs(codes)
    morton = codes.index_select(0, first)
    curve_codes = {order: _curve_codes(morton, order) for order in config.orders}
    tokens = TokenLevel(cells.index_select(0, members.index_select(0, first)), morton, curve_codes)
    stem_neighbors = _neighbor_table(tokens.cells, stem) if stem != 3 else None
    levels = []
    for level in range(config.levels):
        neighbors = _neighbor_table(tokens.cells)
        cut = {
            number: _cut_patches(
                tokens.curve_codes[config.orders[number]], starts[level * len(config.orders) + number], config.patch
            )
            for number in sorted(config.orders_followed[level])
        }
        # Orders that no block of this level follows get any patches; they are never read.
        patches = [cut.get(number, next(iter(cut.values()))) for number in range(len(config.orders)) if cut]
        first_child, parents = _runs(tokens.morton >> 3)
        levels.append(
            Level(
                neighbors=neighbors,
                gather_index=tuple(index.gather for index in patches),
                scatter_index=tuple(index.scatter for index in patches),
                attn_mask=tuple(index.mask for index in patches),
                patch_width=config.patch,
                parents=parents,
                children=_children(first_child, parents.shape[0]),
            )
        )
        if level + 1 < config.levels:
            tokens = tokens.coarser(first_child)
    return Plan(
        token_of=torch.empty_like(members).scatter(0, members, token_of_member),
        members=members,
        counts=_run_lengths(first, members.shape[0]),
        levels=tuple(levels),
        stem_neighbors=stem_neighbors,
    )


def _curve_codes(morton: Int64[Tensor, " T"], order: Order) -> Int64[Tensor, " T"]:
    """The twin of `serialize.curve_from_morton`."""
    swapped = swap_xy(morton, order)
    return hilbert(swapped) if order.startswith("hilbert") else swapped


@torch.library.custom_op("gsencoder::hilbert", mutates_args=())
def hilbert(morton: Tensor) -> Tensor:
    """Codes along Hilbert's curve as one operator, since the number of levels is known only when a graph runs."""
    codes: Tensor = hilbert_from_morton(morton, MAX_LEVELS)
    return codes


@hilbert.register_fake
def _(morton: Tensor) -> Tensor:
    return torch.empty_like(morton)


def _runs(codes: Int64[Tensor, " N"]) -> tuple[Int64[Tensor, " T"], Int64[Tensor, " N"]]:
    """The first row of each run of equal codes, and the number of the run of each row."""
    begins = (codes != codes.roll(1)) | (torch.arange(codes.shape[0], device=codes.device) == 0)
    return torch.nonzero(begins).squeeze(1), begins.long().cumsum(0) - 1


def _run_lengths(first: Int64[Tensor, " T"], total: int) -> Int64[Tensor, " T"]:
    return torch.cat((first[1:], first[:1] + total)) - first


def _children(first: Int64[Tensor, " M"], total: int) -> Int64[Tensor, "M 8"]:
    """The children of each token as in `plan.Level`; siblings follow one another."""
    step = torch.arange(8, device=first.device)
    return first[:, None] + torch.where(step < _run_lengths(first, total)[:, None], step, 0)


def _neighbor_table(cells: Int64[Tensor, "T 3"], size: KernelSize = 3) -> Int32[Tensor, "T cube"]:
    """The twin of `plan.neighbor_table`, without strides that Python would have to read."""
    count, radius, columns = cells.shape[0], size // 2, forward_columns(size)
    low, high = cells.amin(dim=0), cells.amax(dim=0)
    sizes = high - low + 1 + 2 * radius
    strides = torch.stack((sizes[1] * sizes[2], sizes[2], torch.ones_like(sizes[0])))
    keys, order = torch.sort(((cells - low + radius) * strides).sum(dim=1), stable=True)
    positions = torch.arange(count, device=cells.device, dtype=torch.int32)
    # Padded, so that a walk along a column may run past the end.
    padded = torch.cat((keys, keys.new_full((size,), INVALID_CODE)))
    # Cells of the center's column above it, then all cells of the forward columns.
    after = _walk_columns(padded, positions[None] + 1, keys[None] + 1, radius, count)
    steps = torch.tensor([[dx, dy, -radius] for dx, dy in columns], device=cells.device)
    target_keys = keys + (steps * strides).sum(dim=1, keepdim=True)
    first = torch.searchsorted(keys, target_keys).int()
    forward = torch.cat((after, _walk_columns(padded, first, target_keys, size, count)))
    # Cell o of the second half is opposite cell −1 − o of the first.
    missing = torch.full_like(forward[:, :1], count)
    opposite = torch.cat((torch.full_like(forward, count), missing), dim=1).scatter(
        1, forward.long(), positions.expand(forward.shape[0], -1)
    )
    table = torch.cat((opposite[:, :-1].flip(0), positions[None], forward))
    rows = _take(torch.cat((order.int(), torch.full_like(positions[:1], count))), table)
    return rows.T.index_select(0, torch.empty_like(positions).scatter(0, order, positions))


def _walk_columns(
    padded: Int64[Tensor, " padded"],
    position: Int32[Tensor, "columns T"],
    target_keys: Int64[Tensor, "columns T"],
    steps: int,
    count: int,
) -> Int32[Tensor, "cells T"]:
    """The positions of successive cells of columns among `count` sorted keys, which are padded at their end; `count`
    for cells that are not occupied. `position` is where each column's first cell would be, and `target_keys` its
    key."""
    matches = []
    for _ in range(steps):
        hit = _take(padded, position) == target_keys
        matches.append(torch.where(hit, position, count))
        position, target_keys = position + hit.int(), target_keys + 1
    return torch.stack(matches, dim=1).view(len(matches) * position.shape[0], -1)


def _take(values: Integer[Tensor, " n"], indices: Int32[Tensor, "..."]) -> Integer[Tensor, "..."]:
    return values.index_select(0, indices.flatten()).view(indices.shape)


class PatchIndex(NamedTuple):
    """The patches of one level along one order: gather and scatter index and mask as in `plan.Level`."""

    gather: Int64[Tensor, " slots"]
    scatter: Int64[Tensor, " T"]
    mask: Tensor


def _cut_patches(codes: Int64[Tensor, " T"], starts: Int64[Tensor, " P"], patch: int) -> PatchIndex:
    """Cuts tokens, given by their codes along an order, into patches, each padded to `patch` slots; `starts` are the
    first codes of the patches of the full scene, negative if the cloud is the full scene."""
    count = codes.shape[0]
    codes, rows = torch.sort(codes, stable=True)
    rank = torch.arange(count, device=codes.device)
    patch_number = ((rank + 1) * ((count + patch - 1) // patch) - 1) // count
    patch_number = torch.where(starts[:1] < 0, patch_number, torch.searchsorted(starts, codes, right=True) - 1)
    first, run = _runs(patch_number)
    slots = run * patch + rank - first.index_select(0, run)
    empty_slots = rank.new_zeros(first.shape[0] * patch)
    used = torch.zeros_like(empty_slots, dtype=torch.bool).scatter(0, slots, torch.ones_like(rank, dtype=torch.bool))
    return PatchIndex(
        gather=empty_slots.scatter(0, slots, rows),
        scatter=torch.empty_like(rows).scatter(0, rows, slots),
        mask=used.view(-1, 1, 1, patch),
    )
