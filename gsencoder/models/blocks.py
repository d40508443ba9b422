"""The parts of the point transformer: patch attention, block, pooling and unpooling (PTv3, Wu et al. 2024, sec. 4)."""

import torch
from jaxtyping import Bool, Float, Int64, Integer
from torch import Tensor, nn
from torch.nn import functional

from gsencoder.models.grid.neighbors import NeighborConv

UNSEEN = -3e4
"""Added to the score of what is masked; half precision holds it."""


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
        gather: Int64[Tensor, " places"],
        scatter: Int64[Tensor, " T"],
        attn_mask: Bool[Tensor, "patches 1 1 width"] | None,
        width: int,
    ) -> Float[Tensor, "T C"]:
        """Tokens are put into patches, attend within them, and are put back; see `plan.Level`."""
        channels = x.shape[1]
        if torch.compiler.is_exporting():
            return self._exported(x.index_select(0, gather), scatter, attn_mask, width)
        placed = self.qkv(x.index_select(0, gather))
        # torch's backward of attention in bfloat16 on a CPU is five times slower than in float32.
        slow = placed.device.type == "cpu" and placed.dtype == torch.bfloat16 and torch.is_grad_enabled()
        qkv = (placed.float() if slow else placed).view(-1, width, 3, self.heads, channels // self.heads)
        q, k, v = qkv.permute(2, 0, 3, 1, 4)
        with torch.autocast(placed.device.type, enabled=False):
            attended = functional.scaled_dot_product_attention(q, k, v, attn_mask=attn_mask)
        flat = attended.transpose(1, 2).reshape(-1, channels)
        out: Tensor = self.project(flat.index_select(0, scatter))
        return out

    def _exported(
        self,
        placed: Float[Tensor, "places C"],
        scatter: Int64[Tensor, " T"],
        attn_mask: Bool[Tensor, "patches 1 1 width"] | None,
        width: int,
    ) -> Float[Tensor, "T C"]:
        """The same in plain operators, for ONNX: queries, keys and values from products of their own, which need not be
        taken apart again. No patch is masked altogether."""
        channels = placed.shape[1]
        rows = [slice(part * channels, (part + 1) * channels) for part in range(3)]
        q, k, v = (
            functional.linear(placed, self.qkv.weight[part], self.qkv.bias[part])
            .view(-1, width, self.heads, channels // self.heads)
            .transpose(1, 2)
            for part in rows
        )
        scores = (q * q.shape[3] ** -0.5) @ k.transpose(2, 3)
        if attn_mask is not None:
            scores = scores + torch.where(attn_mask, 0.0, UNSEEN).to(scores.dtype)
        attended = scores.softmax(dim=3) @ v
        out: Tensor = self.project(attended.transpose(1, 2).reshape(-1, channels).index_select(0, scatter))
        return out


class DropPath(nn.Module):
    """Leaves out a residual branch for a random share of tokens in training, and scales up the others."""

    def __init__(self, share: float) -> None:
        super().__init__()
        self.share = share

    def forward(self, x: Float[Tensor, "T C"]) -> Float[Tensor, "T C"]:
        if not self.training or self.share == 0:
            return x
        kept = torch.rand(len(x), 1, device=x.device) >= self.share
        return x * (kept / (1 - self.share)).to(x.dtype)


class Block(nn.Module):
    """x + position; x + attention(norm x); x + mlp(norm x), the position encoding being a 3³ convolution."""

    def __init__(self, channels: int, heads: int, *, mlp_ratio: float, drop_path: float) -> None:
        super().__init__()
        hidden = int(channels * mlp_ratio)
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
        gather: Int64[Tensor, " places"],
        scatter: Int64[Tensor, " T"],
        attn_mask: Bool[Tensor, "patches 1 1 width"] | None,
        width: int,
    ) -> Float[Tensor, "T C"]:
        x = x + self.norm_position(self.mix(self.position(x, neighbors)))
        x = x + self.drop_path(self.attention(self.norm_attention(x), gather, scatter, attn_mask, width))
        hidden = functional.gelu(self.expand(self.norm_mlp(x)))
        out: Tensor = x + self.drop_path(self.contract(hidden))
        return out


class Pool(nn.Module):
    """Tokens of a cell twice as large become one: the largest of each projected channel."""

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__()
        self.project = nn.Linear(channels_in, channels_out)
        self.norm = nn.LayerNorm(channels_out)

    def forward(self, x: Float[Tensor, "T C"], children: Int64[Tensor, "M 8"]) -> Float[Tensor, "M D"]:
        projected = self.project(x)
        gathered = projected.index_select(0, children.flatten()).view(-1, 8, projected.shape[1])
        return functional.gelu(self.norm(gathered.amax(dim=1)))


class Unpool(nn.Module):
    """Each token takes what its parent found out and adds what it knew itself."""

    def __init__(self, channels_in: int, channels_skip: int, channels_out: int) -> None:
        super().__init__()
        self.project = nn.Linear(channels_in, channels_out)
        self.norm = nn.LayerNorm(channels_out)
        self.project_skip = nn.Linear(channels_skip, channels_out)
        self.norm_skip = nn.LayerNorm(channels_out)

    def forward(
        self, x: Float[Tensor, "M C"], skip: Float[Tensor, "T S"], parents: Int64[Tensor, " T"]
    ) -> Float[Tensor, "T D"]:
        down = functional.gelu(self.norm(self.project(x)))
        return functional.gelu(self.norm_skip(self.project_skip(skip))) + down.index_select(0, parents)
