"""The point transformer (PTv3, Wu et al. 2024): input channels, sparse convolution, attention in patches, pooling
and unpooling.

The input channels do not depend on where the scene lies, nor on the sign and the axis order that a file chose. A
quaternion and three scales describe the same ellipsoid in 48 ways, and a network would have to learn that they are
equal. The logarithm of the covariance has one value for each ellipsoid, is linear in log-scales, and stays within a few
units for scales from 1e-9 to 1e4. `rotation` is its trace-free part and `scale` the sorted log-scales, so that either
can be left out.
"""

import math
from dataclasses import dataclass
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float, Int32, Int64, Integer
from torch import Tensor, nn
from torch.nn import functional

from gsencoder.core.errors import InputError
from gsencoder.core.settings import check_limits, option
from gsencoder.geometry import rotmats_from_quats
from gsencoder.models.grid import ALIGN, Order
from gsencoder.models.plan import ORDERS, KernelSize, Level, Plan
from gsencoder.types import SH_C0

MLP_RATIO = 4
"""Hidden channels of a block's MLP, as a multiple of its channels."""
MASKED_SCORE = -3e4
"""Added to attention scores of masked slots in an exported graph; finite in half precision."""
OCCUPIED: dict[int, int] = {3: 10, 5: 28}
"""Cells of a neighborhood that are occupied on a surface, approximately, by the edge of the neighborhood."""

CPU_BLOCK_ROWS = 8192
"""Rows whose neighbors are gathered together on a CPU, so that memory does not grow with the scene."""

MANY_CHANNELS = 48
"""Input channels from which a convolution on a CPU multiplies the neighbors that exist, cell by cell, rather than whole
neighborhoods. On a surface two cells in three are empty, but to find the others costs more than few channels save; in
bfloat16 it always costs more, since oneDNN prepares a product of a new size for each cell."""


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
    """`convolve_reference` in blocks of rows, summed in float32 at least."""
    if _by_cells(x):
        total = x.new_zeros(len(x), weight.shape[2], dtype=torch.promote_types(x.dtype, torch.float32))
        for rows in _row_blocks(len(x), x.device):
            present, cells, counts = _pairs_by_cell(neighbors[rows], len(x))
            products = x.new_empty(len(cells), weight.shape[2])
            parts = zip(x.index_select(0, cells).split(counts), weight, products.split(counts), strict=True)
            for gathered, matrix, product in parts:
                torch.mm(gathered, matrix, out=product)
            total[rows].index_add_(0, present, products.to(total.dtype))
        return total.to(x.dtype)
    padded, matrix = _append_zero_row(x), weight.flatten(0, 1)
    out = x.new_empty(len(x), matrix.shape[1])
    for rows in _row_blocks(len(x), x.device):
        torch.mm(_gather_neighborhoods(padded, neighbors[rows]), matrix, out=out[rows])
    return out


@convolve.register_fake
def _(x: Tensor, neighbors: Tensor, weight: Tensor) -> Tensor:
    return x.new_empty(neighbors.shape[0], weight.shape[2])


@torch.library.custom_op("gsencoder::convolve_weight_gradient", mutates_args=())
def convolve_weight_gradient(x: Tensor, neighbors: Tensor, grad: Tensor) -> Tensor:
    """The gradient of `convolve` with respect to its weight, (cube, C, D), from that with respect to its result.

    It is summed in float32 at least.
    """
    total = x.new_zeros(
        neighbors.shape[1], x.shape[1], grad.shape[1], dtype=torch.promote_types(x.dtype, torch.float32)
    )
    if _by_cells(x):
        for rows in _row_blocks(len(x), x.device):
            present, cells, counts = _pairs_by_cell(neighbors[rows], len(x))
            inputs, grads = x.index_select(0, cells), grad[rows].index_select(0, present)
            for sums, of_inputs, of_grads in zip(total, inputs.split(counts), grads.split(counts), strict=True):
                sums += of_inputs.T @ of_grads
        return total.to(x.dtype)
    padded = _append_zero_row(x)
    for rows in _row_blocks(len(x), x.device):
        total.flatten(0, 1).add_(_gather_neighborhoods(padded, neighbors[rows]).T @ grad[rows])
    return total.to(x.dtype)


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


def _by_cells(x: Tensor) -> bool:
    """Whether to multiply cell by cell; see `MANY_CHANNELS`."""
    return x.device.type == "cpu" and x.dtype != torch.bfloat16 and x.shape[1] >= MANY_CHANNELS


def _pairs_by_cell(neighbors: Tensor, tokens: int) -> tuple[Tensor, Tensor, list[int]]:
    """The rows that have a neighbor in the first cell of the neighborhood, then in the second, …, these neighbors, and
    the number of pairs of each cell."""
    columns = neighbors.T.contiguous()
    occupied = columns < tokens
    pairs = torch.nonzero(occupied.view(-1)).squeeze(1)
    return pairs % len(neighbors), columns.view(-1).index_select(0, pairs), occupied.sum(dim=1).tolist()


def _append_zero_row(x: Tensor) -> Tensor:
    return torch.cat((x, x.new_zeros(1, x.shape[1])))


def _gather_neighborhoods(padded: Tensor, neighbors: Tensor) -> Tensor:
    return padded.index_select(0, neighbors.reshape(-1)).view(neighbors.shape[0], -1)


def _row_blocks(n: int, device: torch.device) -> list[slice]:
    size = CPU_BLOCK_ROWS if device.type == "cpu" else max(n, 1)
    return [slice(start, start + size) for start in range(0, n, size)]


class PatchAttention(nn.Module):
    """Multi-head self-attention among the tokens of a patch."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(channels, 3 * channels)
        self.project = nn.Linear(channels, channels)

    def forward(
        self,
        x: Float[Tensor, "T C"],
        gather_index: Int64[Tensor, " slots"],
        scatter_index: Int64[Tensor, " T"],
        attn_mask: Bool[Tensor, "patches 1 1 width"] | None,
        patch_width: int,
    ) -> Float[Tensor, "T C"]:
        """Gathers tokens into patches, attends within each patch, and scatters the results back; see `plan.Level`."""
        channels = x.shape[1]
        if torch.compiler.is_exporting():
            return self._forward_exported(x.index_select(0, gather_index), scatter_index, attn_mask, patch_width)
        gathered = self.qkv(x.index_select(0, gather_index))
        # On a CPU torch's backward pass of attention is five times slower in bfloat16 than in float32.
        upcast = gathered.device.type == "cpu" and gathered.dtype == torch.bfloat16 and torch.is_grad_enabled()
        qkv = (gathered.float() if upcast else gathered).view(-1, patch_width, 3, self.heads, channels // self.heads)
        q, k, v = qkv.permute(2, 0, 3, 1, 4)
        with torch.autocast(gathered.device.type, enabled=False):
            attended = functional.scaled_dot_product_attention(q, k, v, attn_mask=attn_mask)
        flat = attended.transpose(1, 2).reshape(-1, channels)
        out: Tensor = self.project(flat.index_select(0, scatter_index))
        return out

    def _forward_exported(
        self,
        gathered: Float[Tensor, "slots C"],
        scatter_index: Int64[Tensor, " T"],
        attn_mask: Bool[Tensor, "patches 1 1 width"] | None,
        patch_width: int,
    ) -> Float[Tensor, "T C"]:
        """The same in operators that ONNX has. Queries, keys and values come from separate products, so that the graph
        need not split them; every patch has a slot that is not masked, so that the softmax is defined."""
        channels = gathered.shape[1]
        row_slices = [slice(i * channels, (i + 1) * channels) for i in range(3)]
        q, k, v = (
            functional.linear(gathered, self.qkv.weight[rows], self.qkv.bias[rows])
            .view(-1, patch_width, self.heads, channels // self.heads)
            .transpose(1, 2)
            for rows in row_slices
        )
        scores = (q * q.shape[3] ** -0.5) @ k.transpose(2, 3)
        if attn_mask is not None:
            scores = scores + torch.where(attn_mask, 0.0, MASKED_SCORE).to(scores.dtype)
        attended = scores.softmax(dim=3) @ v
        out: Tensor = self.project(attended.transpose(1, 2).reshape(-1, channels).index_select(0, scatter_index))
        return out


class DropPath(nn.Module):
    """Stochastic depth: in training, drops a residual branch for random tokens and scales it up for the others."""

    def __init__(self, drop_prob: float) -> None:
        super().__init__()
        self.drop_prob = drop_prob

    def forward(self, x: Float[Tensor, "T C"]) -> Float[Tensor, "T C"]:
        if not self.training or self.drop_prob == 0:
            return x
        keep_mask = torch.rand(len(x), 1, device=x.device) >= self.drop_prob
        return x * (keep_mask / (1 - self.drop_prob)).to(x.dtype)


class Block(nn.Module):
    """A transformer block: x + position(x); x + attention(norm(x)); x + mlp(norm(x)).

    The conditional position encoding is a 3³ sparse convolution, a linear layer and a norm.
    """

    def __init__(self, channels: int, heads: int, *, drop_path: float) -> None:
        super().__init__()
        hidden = MLP_RATIO * channels
        self.position = NeighborConv(channels, channels)
        self.mix = nn.Linear(channels, channels)
        self.norm_position = nn.LayerNorm(channels)
        self.norm_attention = nn.LayerNorm(channels)
        self.attention = PatchAttention(channels, heads)
        self.norm_mlp = nn.LayerNorm(channels)
        self.expand = nn.Linear(channels, hidden)
        self.contract = nn.Linear(hidden, channels)
        self.drop_path = DropPath(drop_path)

    def forward(
        self,
        x: Float[Tensor, "T C"],
        neighbors: Integer[Tensor, "T 27"],
        gather_index: Int64[Tensor, " slots"],
        scatter_index: Int64[Tensor, " T"],
        attn_mask: Bool[Tensor, "patches 1 1 width"] | None,
        patch_width: int,
    ) -> Float[Tensor, "T C"]:
        x = x + self.norm_position(self.mix(self.position(x, neighbors)))
        x = x + self.drop_path(
            self.attention(self.norm_attention(x), gather_index, scatter_index, attn_mask, patch_width)
        )
        hidden = functional.gelu(self.expand(self.norm_mlp(x)))
        out: Tensor = x + self.drop_path(self.contract(hidden))
        return out


class Pool(nn.Module):
    """Pooling to the next coarser level: a linear layer, the maximum over the tokens of a coarser cell, and a norm."""

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__()
        self.project = nn.Linear(channels_in, channels_out)
        self.norm = nn.LayerNorm(channels_out)

    def forward(self, x: Float[Tensor, "T C"], children: Int64[Tensor, "M 8"]) -> Float[Tensor, "M D"]:
        projected = self.project(x)
        gathered = projected.index_select(0, children.flatten()).view(-1, 8, projected.shape[1])
        return functional.gelu(self.norm(gathered.amax(dim=1)))


class Unpool(nn.Module):
    """Unpooling to the next finer level: the features of each token's parent plus its own skip connection."""

    def __init__(self, channels_in: int, channels_skip: int, channels_out: int) -> None:
        super().__init__()
        self.project = nn.Linear(channels_in, channels_out)
        self.norm = nn.LayerNorm(channels_out)
        self.project_skip = nn.Linear(channels_skip, channels_out)
        self.norm_skip = nn.LayerNorm(channels_out)

    def forward(
        self, x: Float[Tensor, "M C"], skip: Float[Tensor, "T S"], parents: Int64[Tensor, " T"]
    ) -> Float[Tensor, "T D"]:
        from_parents = functional.gelu(self.norm(self.project(x)))
        return functional.gelu(self.norm_skip(self.project_skip(skip))) + from_parents.index_select(0, parents)


MAX_CHANNELS, MAX_BLOCKS = 1 << 14, 1000
"""Limits beyond any network that was ever trained on points; larger sizes are typing errors, or damaged files that
would fill the memory."""

Shuffle = Literal["once", "pooling", "never"]


@dataclass(frozen=True, slots=True, kw_only=True)
class TransformerConfig:
    """Sizes of the network. Tuples have one entry per level, finest first; those of the decoder have one fewer."""

    encoder_depths: tuple[int, ...] = option(
        (1, 1, 2, 2, 1), "number of encoder blocks of each level, finest first", ge=0, le=MAX_BLOCKS
    )
    encoder_channels: tuple[int, ...] = option(
        (32, 64, 96, 128, 128), "encoder channels of each level", ge=1, le=MAX_CHANNELS
    )
    decoder_depths: tuple[int, ...] = option(
        (0, 1, 1, 1), "number of decoder blocks of each level but the coarsest", ge=0, le=MAX_BLOCKS
    )
    decoder_channels: tuple[int, ...] = option(
        (64, 64, 96, 128), "decoder channels of each level but the coarsest", ge=1, le=MAX_CHANNELS
    )
    head_channels: int = option(32, "channels per attention head", ge=1)
    patch: int = option(128, "largest number of tokens in a patch, within which attention is computed", ge=1)
    orders: tuple[Order, ...] = option(
        ORDERS, "space-filling curves along which patches are cut; blocks use them in turn"
    )
    shuffle_orders: Shuffle = option(
        "once",
        "in training, permute the orders at random: once for all levels, or again at each pooling, as PTv3 "
        "does; outside training they are never permuted",
    )
    drop_path: float = option(
        0.1, "rate of stochastic depth in training, reached at the last encoder block", ge=0, lt=1
    )

    def __post_init__(self) -> None:
        check_limits(self)
        levels = len(self.encoder_depths)
        # With more levels a part of a scene would be pooled differently from the full scene.
        max_levels = ALIGN.bit_length()
        if not 1 <= levels <= max_levels:
            raise InputError(
                f"encoder_depths: expected one entry per level and 1 to {max_levels} levels, got {levels} entries"
            )
        if len(self.encoder_channels) != levels:
            raise InputError(
                f"encoder_channels: expected one entry per level as in encoder_depths ({levels}), "
                f"got {len(self.encoder_channels)}"
            )
        for name in ("decoder_depths", "decoder_channels"):
            if len(getattr(self, name)) != levels - 1:
                raise InputError(
                    f"{name}: expected {levels - 1} entries, one fewer than encoder_depths, got "
                    f"{len(getattr(self, name))}"
                )
        for channels in (*self.encoder_channels, *self.decoder_channels):
            if channels % self.head_channels:
                raise InputError(
                    f"encoder_channels and decoder_channels: expected multiples of head_channels "
                    f"({self.head_channels}), got {channels}"
                )
        if not self.orders:
            raise InputError("orders: expected at least one of z, z-trans, hilbert, hilbert-trans")

    @property
    def levels(self) -> int:
        return len(self.encoder_depths)

    @property
    def orders_followed(self) -> tuple[frozenset[int], ...]:
        """For each level, the indices into `orders` that its blocks follow outside training."""
        depths = [(level, depth) for level, depth in enumerate(self.encoder_depths)]
        depths += reversed([(level, depth) for level, depth in enumerate(self.decoder_depths)])
        block_levels = [level for level, depth in depths for _ in range(depth)]
        block_orders = [(level, block % len(self.orders)) for block, level in enumerate(block_levels)]
        return tuple(
            frozenset(order for block_level, order in block_orders if block_level == level)
            for level in range(self.levels)
        )

    @property
    def channels_out(self) -> int:
        """Channels of the output tokens."""
        return (*self.decoder_channels, *self.encoder_channels)[0]


class PointTransformer(nn.Module):
    """The network from embedded tokens to tokens of the finest level; all indices come from a plan."""

    def __init__(self, config: TransformerConfig) -> None:
        super().__init__()
        self.config = config
        down, up = config.encoder_channels, config.decoder_channels
        blocks_down = sum(config.encoder_depths)
        rates = [config.drop_path * block / max(blocks_down - 1, 1) for block in range(blocks_down)]
        self.down = nn.ModuleList()
        for level, depth in enumerate(config.encoder_depths):
            begin = sum(config.encoder_depths[:level])
            self.down.append(_make_blocks(config, down[level], rates[begin : begin + depth]))
        self.pools = nn.ModuleList(Pool(down[i], down[i + 1]) for i in range(config.levels - 1))
        self.up, self.unpools = nn.ModuleList(), nn.ModuleList()
        for level, depth in enumerate(config.decoder_depths):
            coarser = up[level + 1] if level + 2 < config.levels else down[-1]
            self.unpools.append(Unpool(coarser, down[level], up[level]))
            self.up.append(_make_blocks(config, up[level], [config.drop_path * level / config.levels] * depth))

    def forward(self, x: Float[Tensor, "T C"], plan: Plan) -> Float[Tensor, "T D"]:
        """Runs all blocks on embedded tokens; they follow the orders in turn, in training permuted as `shuffle_orders`
        says. The permutations are drawn from torch's generator on the CPU, which the training loop seeds by the
        step."""
        permutations = self._permutations()
        skips: list[Tensor] = []
        first_block = 0
        for level, blocks in enumerate(self.down):
            if level:
                skips.append(x)
                x = self.pools[level - 1](x, plan.levels[level - 1].children)
            x = self._run(blocks, x, plan.levels[level], permutations[level], first_block)
            first_block += self.config.encoder_depths[level]
        for level in reversed(range(len(self.up))):
            x = self.unpools[level](x, skips[level], plan.levels[level].parents)
            x = self._run(self.up[level], x, plan.levels[level], permutations[level], first_block)
            first_block += self.config.decoder_depths[level]
        return x

    def _permutations(self) -> list[list[int]]:
        """For each level, the permutation of the orders that its blocks follow in encoder and decoder."""
        count, levels = len(self.config.orders), self.config.levels
        if not self.training or self.config.shuffle_orders == "never":
            return [list(range(count))] * levels
        if self.config.shuffle_orders == "once":
            return [torch.randperm(count).tolist()] * levels
        return [torch.randperm(count).tolist() for _ in range(levels)]

    def _run(self, blocks: nn.Module, x: Tensor, level: Level, permutation: list[int], first_block: int) -> Tensor:
        assert isinstance(blocks, nn.ModuleList)
        for number, block in enumerate(blocks, start=first_block):
            order = permutation[number % len(permutation)]
            mask = level.attn_mask[order] if level.attn_mask is not None else None
            gather, scatter = level.gather_index[order], level.scatter_index[order]
            x = block(x, level.neighbors, gather, scatter, mask, level.patch_width)
        return x


def _make_blocks(config: TransformerConfig, channels: int, rates: list[float]) -> nn.ModuleList:
    heads = channels // config.head_channels
    return nn.ModuleList(Block(channels, heads, drop_path=rate) for rate in rates)


Attribute = Literal["offset", "color", "opacity", "scale", "rotation", "height", "cell"]

ATTRIBUTE_CHANNELS: dict[Attribute, int] = {
    "offset": 3,
    "color": 3,
    "opacity": 1,
    "scale": 3,
    "rotation": 6,
    "height": 2,
    "cell": 1,
}

MAX_ABS_LOG_SCALE = 12.0
"""Limit to which log-scales relative to the voxel are clamped: no useful Gaussian is smaller or larger than e^±12
voxels."""


def input_channels(attributes: tuple[Attribute, ...]) -> int:
    """The number of channels that attributes have in total."""
    return sum(ATTRIBUTE_CHANNELS[name] for name in attributes)


def embed(
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    scales: Float[Tensor, "N 3"],
    opacities: Float[Tensor, " N"],
    sh_dc: Float[Tensor, "N 3"],
    *,
    voxel: float | Float[Tensor, ""],
    attributes: tuple[Attribute, ...],
) -> Float[Tensor, "N C"]:
    """The input channels, all of order one, concatenated in the order of `attributes`.

    offset: position of the center in its voxel, −1 to 1. color: degree-0 color, −1 for black to 1 for white, clamped to
    ±2. opacity: −1 to 1. scale: ¼ of log(scale / voxel), largest first. rotation: ¼ of the six distinct entries of
    R diag(log s − mean log s) Rᵀ, the off-diagonal ones times √2, so that distances between inputs are Frobenius
    distances between matrices. height: z above the floor in 50 voxels and in 5, less 1, clamped to ±2 and ±1; z must be
    up and the floor at 0 (see `gsencoder.data.up.upright_gaussians`). cell: log₂ of the voxel over 0.05, which tells
    its size in a splat in metres. The voxel is a tensor in an exported graph, where it is an input.
    """
    channels: list[Tensor] = []
    log_scales = torch.log(scales.double() / voxel).clamp(-MAX_ABS_LOG_SCALE, MAX_ABS_LOG_SCALE).to(means.dtype)
    for name in attributes:
        if name == "offset":
            scaled = means.double() / voxel
            channels.append((2 * (scaled - torch.floor(scaled)) - 1).to(means.dtype))
        elif name == "color":
            channels.append((2 * SH_C0 * sh_dc).clamp(-2, 2))
        elif name == "opacity":
            channels.append(2 * opacities.unsqueeze(1) - 1)
        elif name == "height":
            cells = means[:, 2:].double() / voxel
            channels.append((cells / 50 - 1).clamp(-2, 2).to(means.dtype))
            channels.append((cells / 5 - 1).clamp(-1, 1).to(means.dtype))
        elif name == "cell":
            size = math.log2(voxel / 0.05) if isinstance(voxel, float) else torch.log2(voxel / 0.05).to(means.dtype)
            channels.append(torch.zeros_like(means[:, :1]) + size)
        elif name == "scale":
            channels.append(log_scales.sort(dim=1, descending=True).values / 4)
        else:
            channels.append(_symmetric_matrix(quats, log_scales - log_scales.mean(dim=1, keepdim=True)) / 4)
    return torch.cat(channels, dim=1)


def _symmetric_matrix(quats: Float[Tensor, "N 4"], eigenvalues: Float[Tensor, "N 3"]) -> Float[Tensor, "N 6"]:
    """The entries xx, yy, zz, √2·xy, √2·xz, √2·yz of R diag(eigenvalues) Rᵀ."""
    rotation = rotmats_from_quats(quats)
    x, y, z = rotation.unbind(dim=1)
    root = math.sqrt(2)
    entries = (x * x, y * y, z * z, root * x * y, root * x * z, root * y * z)
    return torch.stack([(entry * eigenvalues).sum(dim=1) for entry in entries], dim=1)
