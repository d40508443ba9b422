"""The serialized-point transformer: an encoder and a decoder over levels of a grid (PTv3, Wu et al. 2024)."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from gsencoder.core.errors import InputError
from gsencoder.models.blocks import Block, Pool, Unpool
from gsencoder.models.grid.plan import ORDERS, Level, Plan
from gsencoder.models.grid.serialize import ALIGN, Order

MOST_CHANNELS, MOST_BLOCKS, MOST_RATIO = 1 << 14, 1000, 64
"""Beyond any network that was ever trained on points: such sizes are slips, or a file that wants the memory."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TransformerConfig:
    """The shape of the network. Lists have one entry a level, finest first; the decoder has one fewer."""

    encoder_depths: tuple[int, ...] = field(default=(1, 1, 2, 2, 1), metadata={"help": "blocks on the way down"})
    encoder_channels: tuple[int, ...] = field(
        default=(32, 64, 96, 128, 128), metadata={"help": "channels on the way down"}
    )
    decoder_depths: tuple[int, ...] = field(default=(0, 1, 1, 1), metadata={"help": "blocks on the way up"})
    decoder_channels: tuple[int, ...] = field(default=(64, 64, 96, 128), metadata={"help": "channels on the way up"})
    head_channels: int = field(default=32, metadata={"help": "channels of an attention head"})
    patch: int = field(default=128, metadata={"help": "most tokens that attend to one another"})
    orders: tuple[Order, ...] = field(
        default=ORDERS,
        metadata={"help": "curves that patches are cut along, block by block in turn"},
    )
    mlp_ratio: float = field(default=4.0, metadata={"help": "hidden channels of a block's perceptron, in its channels"})
    drop_path: float = field(default=0.1, metadata={"help": "share of residual branches left out in training"})
    checkpoint: bool = field(
        default=False, metadata={"help": "keep no activations within blocks, and compute them again on the way back"}
    )

    def __post_init__(self) -> None:
        levels = len(self.encoder_depths)
        # Beyond this, cells of a part of a scene would be pooled in other pairs than in the whole.
        most = ALIGN.bit_length()
        if not 1 <= levels <= most:
            raise InputError(f"encoder_depths: expected one entry a level and 1 to {most} levels, got {levels} entries")
        if self.head_channels < 1 or self.patch < 1:
            raise InputError(f"head_channels and patch: expected 1 or more, got {self.head_channels} and {self.patch}")
        if len(self.encoder_channels) != levels:
            raise InputError(
                f"encoder_channels: expected one entry a level as in encoder_depths ({levels}), "
                f"got {len(self.encoder_channels)}"
            )
        for name in ("decoder_depths", "decoder_channels"):
            if len(getattr(self, name)) != levels - 1:
                raise InputError(
                    f"{name}: expected {levels - 1} entries, one fewer than encoder_depths, got "
                    f"{len(getattr(self, name))}"
                )
        if min((*self.encoder_depths, *self.decoder_depths)) < 0:
            raise InputError("encoder_depths and decoder_depths: expected 0 blocks or more")
        for channels in (*self.encoder_channels, *self.decoder_channels):
            if channels < 1 or channels % self.head_channels:
                raise InputError(
                    f"channels: expected multiples of head_channels ({self.head_channels}), got {channels}"
                )
        if not self.orders:
            raise InputError("orders: expected at least one of z, z-trans, hilbert, hilbert-trans")
        if not 0 <= self.drop_path < 1:
            raise InputError(f"drop_path: expected a share in [0, 1), got {self.drop_path}")
        if not 0 < self.mlp_ratio <= MOST_RATIO:
            raise InputError(f"mlp_ratio: expected a number above 0 and at most {MOST_RATIO}, got {self.mlp_ratio}")
        for ways, most in (("channels", MOST_CHANNELS), ("depths", MOST_BLOCKS)):
            for name in (f"encoder_{ways}", f"decoder_{ways}"):
                if max(getattr(self, name), default=0) > most:
                    raise InputError(f"{name}: expected at most {most} a level, got {max(getattr(self, name))}")

    @property
    def levels(self) -> int:
        return len(self.encoder_depths)

    @property
    def orders_followed(self) -> tuple[frozenset[int], ...]:
        """For each level the orders, by number, that its blocks follow outside training."""
        counts = [(level, depth) for level, depth in enumerate(self.encoder_depths)]
        counts += reversed([(level, depth) for level, depth in enumerate(self.decoder_depths)])
        levels = [level for level, depth in counts for _ in range(depth)]
        numbers = [(level, block % len(self.orders)) for block, level in enumerate(levels)]
        return tuple(frozenset(number for at, number in numbers if at == level) for level in range(self.levels))

    @property
    def channels_out(self) -> int:
        """Channels of each token at the end."""
        return (*self.decoder_channels, *self.encoder_channels)[0]


class PointTransformer(nn.Module):
    """Tokens in, tokens out, with everything about their places in a plan."""

    def __init__(self, config: TransformerConfig) -> None:
        super().__init__()
        self.config = config
        down, up = config.encoder_channels, config.decoder_channels
        blocks_down = sum(config.encoder_depths)
        rates = [config.drop_path * block / max(blocks_down - 1, 1) for block in range(blocks_down)]
        self.down = nn.ModuleList()
        for level, depth in enumerate(config.encoder_depths):
            begin = sum(config.encoder_depths[:level])
            self.down.append(_blocks(config, down[level], rates[begin : begin + depth]))
        self.pools = nn.ModuleList(Pool(down[i], down[i + 1]) for i in range(config.levels - 1))
        self.up, self.unpools = nn.ModuleList(), nn.ModuleList()
        for level, depth in enumerate(config.decoder_depths):
            below = up[level + 1] if level + 2 < config.levels else down[-1]
            self.unpools.append(Unpool(below, down[level], up[level]))
            self.up.append(_blocks(config, up[level], [config.drop_path * level / config.levels] * depth))

    def forward(self, x: Float[Tensor, "T C"], plan: Plan) -> Float[Tensor, "T D"]:
        """Blocks follow the orders in turn, from the first on the way down to the last on the way up; in training the
        orders are shuffled.

        Args:
            x: embedded tokens, C = encoder_channels[0].
            plan: made with this configuration's levels, patch and orders.
        """
        count = len(self.config.orders)
        turn = torch.randperm(count).tolist() if self.training else list(range(count))
        skips: list[Tensor] = []
        before = 0
        for level, blocks in enumerate(self.down):
            if level:
                skips.append(x)
                x = self.pools[level - 1](x, plan.levels[level - 1].children)
            x = self._run(blocks, x, plan.levels[level], turn, before)
            before += self.config.encoder_depths[level]
        for level in reversed(range(len(self.up))):
            x = self.unpools[level](x, skips[level], plan.levels[level].parents)
            x = self._run(self.up[level], x, plan.levels[level], turn, before)
            before += self.config.decoder_depths[level]
        return x

    def _run(self, blocks: nn.Module, x: Tensor, level: Level, turn: list[int], before: int) -> Tensor:
        assert isinstance(blocks, nn.ModuleList)
        for number, block in enumerate(blocks, start=before):
            order = turn[number % len(turn)]
            mask = level.attn_mask[order] if level.attn_mask is not None else None
            places = (level.neighbors, level.gathers[order], level.scatters[order], mask, level.width)
            if self.config.checkpoint and self.training:
                x = checkpoint(block, x, *places, use_reentrant=False)
            else:
                x = block(x, *places)
        return x


def _blocks(config: TransformerConfig, channels: int, rates: list[float]) -> nn.ModuleList:
    heads = channels // config.head_channels
    return nn.ModuleList(Block(channels, heads, mlp_ratio=config.mlp_ratio, drop_path=rate) for rate in rates)
