"""Table of the cells around each occupied cell, and the sparse convolution over them."""

from typing import Any, Literal

import torch
from jaxtyping import Float, Int32, Int64, Integer
from torch import Tensor, nn

KernelSize = Literal[3, 5]
"""Edge k of the cube of k³ cells around a cell. Cell o = k²·(dx + r) + k·(dy + r) + (dz + r) with r = (k − 1) / 2: the
center is (k³ − 1) / 2, and k³ − 1 − o is opposite o."""

OCCUPIED: dict[int, int] = {3: 10, 5: 28}
"""Cells of a neighborhood that are occupied on a surface, approximately, by the edge of the neighborhood."""

CPU_BLOCK_ROWS = 8192
"""Rows whose neighborhoods are gathered together on a CPU, few enough that what they gather stays in its cache."""

FEW_CELLS = 9
"""A block of tokens that needs at most one in so many cells of a neighborhood multiplies these alone: isolated tokens,
and lines of them. It changes rounding only; surfaces, which need a third of the cells, keep every bit."""


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


class NeighborConv(nn.Module):
    """A submanifold sparse convolution: out[i] = Σ_o W_o x[neighbor o of i] + bias over occupied cells, others being 0.

    It gathers neighborhoods and multiplies once, which needs only torch. Since the neighborhood is symmetric, the
    gradient is the same convolution with the weights of opposite cells swapped, so that no atomics are needed.
    """

    def __init__(self, channels_in: int, channels_out: int, size: KernelSize = 3) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(size**3, channels_in, channels_out))
        self.bias = nn.Parameter(torch.zeros(channels_out))
        nn.init.normal_(self.weight, std=(OCCUPIED[size] * channels_in) ** -0.5)

    def forward(self, x: Float[Tensor, "N C"], neighbors: Integer[Tensor, "N cube"]) -> Float[Tensor, "N D"]:
        weight: Tensor = self.weight
        bias: Tensor = self.bias
        if torch.is_autocast_enabled(x.device.type):
            dtype = torch.get_autocast_dtype(x.device.type)
            x, weight, bias = x.to(dtype), weight.to(dtype), bias.to(dtype)
        return convolve(x, neighbors, weight) + bias


def convolve_reference(
    x: Float[Tensor, "N C"], neighbors: Int32[Tensor, "N cube"], weight: Float[Tensor, "cube C D"]
) -> Float[Tensor, "N D"]:
    """The plain twin of `NeighborConv` without bias: one gather and one product, differentiated by autograd."""
    padded = torch.cat((x, x.new_zeros(1, x.shape[1])))
    return padded[neighbors.long()].flatten(1) @ weight.flatten(0, 1)


# Operators of their own, which `gsencoder.infer.onnx.export` translates to standard ONNX operators.
@torch.library.custom_op("gsencoder::convolve", mutates_args=())
def convolve(x: Tensor, neighbors: Tensor, weight: Tensor) -> Tensor:
    """`convolve_reference`, computed in blocks of rows, on a CPU without the cells that no row of a block needs."""
    padded, matrix = _append_zero_row(x), weight.flatten(0, 1)
    out = x.new_empty(len(x), matrix.shape[1])
    for rows in _row_blocks(len(x), x.device):
        cells, columns = neighbors[rows], matrix
        if x.device.type == "cpu":
            occupied = cells.amin(dim=0) < len(x)
            if FEW_CELLS * int(occupied.sum()) <= len(occupied):
                cells, columns = cells[:, occupied], weight[occupied].flatten(0, 1)
        torch.mm(_gather_neighborhoods(padded, cells), columns, out=out[rows])
    return out


@convolve.register_fake
def _(x: Tensor, neighbors: Tensor, weight: Tensor) -> Tensor:
    return x.new_empty(neighbors.shape[0], weight.shape[2])


@torch.library.custom_op("gsencoder::convolve_weight_gradient", mutates_args=())
def convolve_weight_gradient(x: Tensor, neighbors: Tensor, grad: Tensor) -> Tensor:
    """The gradient of `convolve` with respect to its weight, (cube, C, D), from that with respect to its result.

    It is summed in float32 at least.
    """
    padded = _append_zero_row(x)
    shape = (neighbors.shape[1], x.shape[1], grad.shape[1])
    total = x.new_zeros(shape, dtype=torch.promote_types(x.dtype, torch.float32)).flatten(0, 1)
    for rows in _row_blocks(len(x), x.device):
        total += _gather_neighborhoods(padded, neighbors[rows]).T @ grad[rows]
    return total.view(shape).to(x.dtype)


@convolve_weight_gradient.register_fake
def _(x: Tensor, neighbors: Tensor, grad: Tensor) -> Tensor:
    return x.new_empty(neighbors.shape[1], x.shape[1], grad.shape[1])


def _save_inputs(ctx: Any, inputs: tuple[Tensor, ...], output: Tensor) -> None:  # noqa: ARG001
    ctx.save_for_backward(*inputs)


def _gradients(ctx: Any, grad: Tensor) -> tuple[Tensor | None, None, Tensor | None]:
    x, neighbors, weight = ctx.saved_tensors
    grad = grad.contiguous()
    # Cell j is neighbor o of i exactly where i is the neighbor of j on the opposite side.
    grad_x = convolve(grad, neighbors, weight.flip(0).transpose(1, 2)) if ctx.needs_input_grad[0] else None
    grad_weight = convolve_weight_gradient(x, neighbors, grad) if ctx.needs_input_grad[2] else None
    return grad_x, None, grad_weight


convolve.register_autograd(_gradients, setup_context=_save_inputs)


def _append_zero_row(x: Tensor) -> Tensor:
    return torch.cat((x, x.new_zeros(1, x.shape[1])))


def _gather_neighborhoods(padded: Tensor, neighbors: Tensor) -> Tensor:
    return padded.index_select(0, neighbors.reshape(-1)).view(neighbors.shape[0], -1)


def _row_blocks(n: int, device: torch.device) -> list[slice]:
    size = CPU_BLOCK_ROWS if device.type == "cpu" else max(n, 1)
    return [slice(start, start + size) for start in range(0, n, size)]
