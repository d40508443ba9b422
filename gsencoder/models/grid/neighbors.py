"""The 27 cells around each occupied cell, found in sorted codes, and the convolution over them."""

from typing import Any

import torch
from jaxtyping import Float, Int32, Int64, Integer
from torch import Tensor, nn

CELLS = 27
"""Cells of a 3×3×3 neighborhood; number 9·(dx+1) + 3·(dy+1) + (dz+1), so 13 is the cell itself, 26 − o faces o."""

ROWS_AT_ONCE = 8192
"""Rows whose neighborhoods are gathered together on a CPU: what they take stays in the cache."""


AHEAD = ((0, 1), (1, -1), (1, 0), (1, 1))
"""The columns around a cell that come after its own; the other four are these, seen from the other side."""


def neighbor_table(cells: Int64[Tensor, "N 3"]) -> Int32[Tensor, "N 27"]:
    """For each of N distinct cells the rows of the 27 cells around it; N where there is none.

    The cells are sorted by column; for each of four columns one search finds where the three cells around a cell would
    begin, and they follow one another from there. Whatever is found is entered on both sides.
    """
    n = len(cells)
    if n == 0:
        return torch.zeros((0, CELLS), dtype=torch.int32, device=cells.device)
    low, high = cells.aminmax(dim=0)
    # A border of one empty cell on each side keeps the end of one column apart from the start of the next.
    sizes = (high - low + 3).tolist()
    stride_y, stride_x = sizes[2], sizes[2] * sizes[1]
    x, y, z = (cells - low + 1).unbind(dim=1)
    keys = x * stride_x + y * stride_y + z
    # The keys of a room fit into half the bits, which are sorted in a quarter of the time.
    keys, order = torch.sort(keys.int() if sizes[0] * stride_x < 2**31 else keys)
    own = torch.arange(n, dtype=torch.int32, device=cells.device)
    nobody = own.new_full((), n)
    # Cell o of the cell at place i of the sorted ones; what is not there is entered at place n.
    found = own.new_full((CELLS, n + 1), n)
    found[13, :n] = own
    adjacent = keys[1:] == keys[:-1] + 1
    found[14, : n - 1] = torch.where(adjacent, own[1:], nobody)
    found[12, 1:n] = torch.where(adjacent, own[:-1], nobody)
    # Two entries that no key equals let the walk along a column run past the end.
    padded = torch.cat((keys, keys.new_full((2,), torch.iinfo(keys.dtype).max)))
    starts = keys.new_tensor([dx * stride_x + dy * stride_y - 1 for dx, dy in AHEAD])
    wanted = keys + starts[:, None]
    place = torch.searchsorted(keys, wanted, out_int32=True)
    for step in range(3):
        hit = padded.index_select(0, place.flatten()).view(len(AHEAD), n) == wanted
        there = torch.where(hit, place, nobody)
        for column, (dx, dy) in enumerate(AHEAD):
            cell = 9 * (dx + 1) + 3 * (dy + 1) + step
            found[cell, :n] = there[column]
            found[CELLS - 1 - cell].scatter_(0, there[column].long(), own)
        place += hit
        wanted += 1
    rows = torch.cat((order.int(), nobody[None])).index_select(0, found.flatten()).view(CELLS, n + 1)
    place_of = torch.empty_like(order)
    place_of[order] = torch.arange(n, device=order.device)
    return rows[:, :n].T.contiguous().index_select(0, place_of)


class NeighborConv(nn.Module):
    """A convolution over occupied cells alone: out[i] = Σ_o W_o x[neighbor o of i] + bias, missing cells being zero.

    It gathers neighborhoods and multiplies once, which needs nothing but torch; the gradient is the same convolution
    with facing weights, since the neighborhood is symmetric, so that nothing is summed by atomics.
    """

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(CELLS, channels_in, channels_out))
        self.bias = nn.Parameter(torch.zeros(channels_out))
        # On a surface about ten of the 27 cells are occupied.
        nn.init.normal_(self.weight, std=(10 * channels_in) ** -0.5)

    def forward(self, x: Float[Tensor, "N C"], neighbors: Integer[Tensor, "N 27"]) -> Float[Tensor, "N D"]:
        weight: Tensor = self.weight
        bias: Tensor = self.bias
        if torch.compiler.is_exporting():
            return convolve(x, neighbors, weight) + bias
        if torch.is_autocast_enabled(x.device.type):
            dtype = torch.get_autocast_dtype(x.device.type)
            x, weight, bias = x.to(dtype), weight.to(dtype), bias.to(dtype)
        return _Convolve.apply(x, neighbors, weight) + bias


def convolve_reference(
    x: Float[Tensor, "N C"], neighbors: Int32[Tensor, "N 27"], weight: Float[Tensor, "27 C D"]
) -> Float[Tensor, "N D"]:
    """The plain twin: one gather and one product, differentiated by autograd."""
    padded = torch.cat((x, x.new_zeros(1, x.shape[1])))
    return padded[neighbors.long()].flatten(1) @ weight.flatten(0, 1)


@torch.library.custom_op("gsencoder::convolve", mutates_args=())
def convolve(x: Tensor, neighbors: Tensor, weight: Tensor) -> Tensor:
    """The convolution as one operator, which an exported graph has in ONNX's own (`gsencoder.infer.onnx.operators`)."""
    return _multiply(x, neighbors, weight.flatten(0, 1))


@convolve.register_fake
def _(x: Tensor, neighbors: Tensor, weight: Tensor) -> Tensor:
    return x.new_empty(neighbors.shape[0], weight.shape[2])


class _Convolve(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, neighbors: Tensor, weight: Tensor) -> Tensor:
        ctx.save_for_backward(x, neighbors, weight)
        return _multiply(x, neighbors, weight.flatten(0, 1))

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, None, Tensor | None]:
        x, neighbors, weight = ctx.saved_tensors
        grad = grad.contiguous()
        grad_x = grad_weight = None
        if ctx.needs_input_grad[0]:
            # Cell j lies in direction o of i exactly where i lies in direction 26 − o of j.
            grad_x = _multiply(grad, neighbors, weight.flip(0).transpose(1, 2).flatten(0, 1))
        if ctx.needs_input_grad[2]:
            padded = _with_zero_row(x)
            total = weight.new_zeros(weight.shape, dtype=torch.promote_types(weight.dtype, torch.float32)).flatten(0, 1)
            for rows in _blocks(len(x), x.device):
                total += _neighborhoods(padded, neighbors[rows]).T @ grad[rows]
            grad_weight = total.view(weight.shape).to(weight.dtype)
        return grad_x, None, grad_weight


def _with_zero_row(x: Tensor) -> Tensor:
    return torch.cat((x, x.new_zeros(1, x.shape[1])))


def _neighborhoods(padded: Tensor, neighbors: Tensor) -> Tensor:
    return padded.index_select(0, neighbors.reshape(-1)).view(neighbors.shape[0], -1)


def _blocks(n: int, device: torch.device) -> list[slice]:
    size = ROWS_AT_ONCE if device.type == "cpu" else max(n, 1)
    return [slice(start, start + size) for start in range(0, n, size)]


def _multiply(x: Tensor, neighbors: Tensor, weight: Tensor) -> Tensor:
    padded = _with_zero_row(x)
    out = x.new_empty(len(x), weight.shape[1])
    for rows in _blocks(len(x), x.device):
        torch.mm(_neighborhoods(padded, neighbors[rows]), weight, out=out[rows])
    return out
