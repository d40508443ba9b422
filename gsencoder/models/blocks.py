"""Layers of the point transformer: patch attention, block, pooling and unpooling (PTv3, Wu et al. 2024, sec. 4)."""

import torch
from jaxtyping import Bool, Float, Int64, Integer
from torch import Tensor, nn
from torch.nn import functional

from gsencoder.models.grid.neighbors import NeighborConv

MASKED_SCORE = -3e4
"""Added to attention scores of masked slots in an exported graph; finite in half precision."""


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
