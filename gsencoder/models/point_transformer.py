"""The point transformer: an encoder and a decoder over the levels of a voxel grid (PTv3, Wu et al. 2024)."""

from dataclasses import dataclass, field
from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from gsencoder.core.errors import InputError
from gsencoder.models.blocks import Block, Pool, Unpool
from gsencoder.models.grid.plan import ORDERS, Level, Plan
from gsencoder.models.grid.serialize import ALIGN, Order

MAX_CHANNELS, MAX_BLOCKS, MAX_MLP_RATIO = 1 << 14, 1000, 64
"""Limits beyond any network that was ever trained on points; larger sizes are typing errors, or damaged files that
would fill the memory."""

Shuffle = Literal["once", "pooling", "never"]


@dataclass(frozen=True, slots=True, kw_only=True)
class TransformerConfig:
    """Sizes of the network. Tuples have one entry per level, finest first; those of the decoder have one fewer."""

    encoder_depths: tuple[int, ...] = field(
        default=(1, 1, 2, 2, 1), metadata={"help": "number of encoder blocks of each level, finest first"}
    )
    encoder_channels: tuple[int, ...] = field(
        default=(32, 64, 96, 128, 128), metadata={"help": "encoder channels of each level"}
    )
    decoder_depths: tuple[int, ...] = field(
        default=(0, 1, 1, 1), metadata={"help": "number of decoder blocks of each level but the coarsest"}
    )
    decoder_channels: tuple[int, ...] = field(
        default=(64, 64, 96, 128), metadata={"help": "decoder channels of each level but the coarsest"}
    )
    head_channels: int = field(default=32, metadata={"help": "channels per attention head"})
    patch: int = field(
        default=128, metadata={"help": "largest number of tokens in a patch, within which attention is computed"}
    )
    orders: tuple[Order, ...] = field(
        default=ORDERS,
        metadata={"help": "space-filling curves along which patches are cut; blocks use them in turn"},
    )
    shuffle_orders: Shuffle = field(
        default="once",
        metadata={
            "help": "in training, permute the orders at random: once for all levels, or again at each pooling, as PTv3 "
            "does; outside training they are never permuted"
        },
    )
    mlp_ratio: float = field(
        default=4.0, metadata={"help": "hidden channels of a block's MLP, as a multiple of its channels"}
    )
    drop_path: float = field(
        default=0.1, metadata={"help": "rate of stochastic depth in training, reached at the last encoder block"}
    )
    checkpoint: bool = field(
        default=False, metadata={"help": "recompute activations of blocks in the backward pass to save memory"}
    )

    def __post_init__(self) -> None:
        levels = len(self.encoder_depths)
        # With more levels a part of a scene would be pooled differently from the full scene.
        max_levels = ALIGN.bit_length()
        if not 1 <= levels <= max_levels:
            raise InputError(
                f"encoder_depths: expected one entry per level and 1 to {max_levels} levels, got {levels} entries"
            )
        if self.head_channels < 1 or self.patch < 1:
            raise InputError(f"head_channels and patch: expected 1 or more, got {self.head_channels} and {self.patch}")
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
        if min((*self.encoder_depths, *self.decoder_depths)) < 0:
            raise InputError("encoder_depths and decoder_depths: expected 0 or more blocks at every level")
        for channels in (*self.encoder_channels, *self.decoder_channels):
            if channels < 1 or channels % self.head_channels:
                raise InputError(
                    f"encoder_channels and decoder_channels: expected multiples of head_channels "
                    f"({self.head_channels}), got {channels}"
                )
        if not self.orders:
            raise InputError("orders: expected at least one of z, z-trans, hilbert, hilbert-trans")
        if self.shuffle_orders not in get_args(Shuffle):
            raise InputError(f"shuffle_orders: expected once, pooling or never, got {self.shuffle_orders!r}")
        if not 0 <= self.drop_path < 1:
            raise InputError(f"drop_path: expected a number in [0, 1), got {self.drop_path}")
        if not 0 < self.mlp_ratio <= MAX_MLP_RATIO:
            raise InputError(f"mlp_ratio: expected a number above 0 and at most {MAX_MLP_RATIO}, got {self.mlp_ratio}")
        for kind, limit in (("channels", MAX_CHANNELS), ("depths", MAX_BLOCKS)):
            for name in (f"encoder_{kind}", f"decoder_{kind}"):
                if max(getattr(self, name), default=0) > limit:
                    raise InputError(f"{name}: expected at most {limit} per level, got {max(getattr(self, name))}")

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
        """Runs all blocks; they follow the orders in turn, in training permuted as `shuffle_orders` says.

        The permutations are drawn from torch's generator on the CPU, which the training loop seeds by the step.

        Args:
            x: embedded tokens, C = encoder_channels[0].
            plan: made with the levels, patch and orders of the configuration.
        """
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
            level_inputs = (
                level.neighbors,
                level.gather_index[order],
                level.scatter_index[order],
                mask,
                level.patch_width,
            )
            if self.config.checkpoint and self.training:
                x = checkpoint(block, x, *level_inputs, use_reentrant=False)
            else:
                x = block(x, *level_inputs)
        return x


def _make_blocks(config: TransformerConfig, channels: int, rates: list[float]) -> nn.ModuleList:
    heads = channels // config.head_channels
    return nn.ModuleList(Block(channels, heads, mlp_ratio=config.mlp_ratio, drop_path=rate) for rate in rates)
