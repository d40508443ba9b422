"""The Gaussian encoder: raw attributes of a splat in, one feature a Gaussian out (SplatDistill sec. 3.3)."""

import math
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from gsencoder.core.errors import InputError
from gsencoder.models.embed import CHANNELS, Attribute, channels_of, embed
from gsencoder.models.grid.curves import Curves
from gsencoder.models.grid.neighbors import NeighborConv
from gsencoder.models.grid.plan import CloudPlan, Plan, join_plans, plan_cloud
from gsencoder.models.point_transformer import PointTransformer, TransformerConfig
from gsencoder.types import Gaussians

FAINT = 1e-3
"""A Gaussian of no opacity counts this much within its token, so that a token of such Gaussians has a mean."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EncoderConfig:
    """What goes in, what happens to it."""

    voxel: float = field(default=0.02, metadata={"help": "edge of the finest grid in metres; its cells are the tokens"})
    inputs: tuple[Attribute, ...] = field(
        default=("offset", "color", "opacity", "scale", "rotation"), metadata={"help": "attributes that are looked at"}
    )
    transformer: TransformerConfig = field(default_factory=TransformerConfig)

    def __post_init__(self) -> None:
        if not 0 < self.voxel < math.inf:
            raise InputError(f"voxel: expected a positive length in metres, got {self.voxel}")
        unknown = [name for name in self.inputs if name not in CHANNELS]
        if not self.inputs or unknown or len(set(self.inputs)) < len(self.inputs):
            raise InputError(f"inputs: expected some of {', '.join(CHANNELS)}, each once, got {', '.join(self.inputs)}")


class GaussianEncoder(nn.Module):
    """Merges Gaussians into tokens, runs the transformer, and gives each Gaussian what its token found."""

    def __init__(self, config: EncoderConfig, channels: int) -> None:
        """Args:
        config: see there.
        channels: of the output: R coordinates in a basis, or all D of the space.
        """
        super().__init__()
        self.config, self.channels = config, channels
        width, out = config.transformer.encoder_channels[0], config.transformer.channels_out
        self.stem = NeighborConv(channels_of(config.inputs), width)
        self.stem_norm = nn.LayerNorm(width)
        self.transformer = PointTransformer(config.transformer)
        self.head_norm = nn.LayerNorm(out)
        self.head = nn.Linear(out, channels)

    def join(self, clouds: list[CloudPlan]) -> Plan:
        """The plan of a batch; see `plan.join_plans`."""
        return join_plans(clouds, self.config.transformer.patch)

    def forward(
        self, attributes: Float[Tensor, "N A"], opacities: Float[Tensor, " N"], plan: Plan
    ) -> Float[Tensor, "N channels"]:
        """Features in standard units (see `OutputSpace`), at least float32 whatever the network computed in.

        Args:
            attributes: of `embed`, with the configuration's inputs.
            opacities: how much each Gaussian counts within its token.
            plan: of these Gaussians, in this order.
        """
        tokens = merge(attributes, opacities.clamp(min=FAINT), plan)
        if not torch.compiler.is_exporting():
            # Levels may end in tokens that stand for nothing.
            tokens = functional.pad(tokens, (0, 0, 0, len(plan.levels[0].neighbors) - len(tokens)))
        # An encoder in half precision takes tokens that were merged in single.
        tokens = tokens.to(self.head.weight.dtype)
        x = functional.gelu(self.stem_norm(self.stem(tokens, plan.levels[0].neighbors)))
        x = self.transformer(x, plan)
        features = self.head(self.head_norm(x))
        features = features.to(torch.promote_types(features.dtype, torch.float32))
        return features.index_select(0, plan.token_of)


def merge(attributes: Float[Tensor, "N A"], weights: Float[Tensor, " N"], plan: Plan) -> Float[Tensor, "T A"]:
    """The weighted mean (weights > 0) of each token's members, summed in the members' order, without atomics."""
    weighted = torch.cat((attributes * weights.unsqueeze(1), weights.unsqueeze(1)), dim=1)
    if torch.compiler.is_exporting():
        # ONNX has no reduction of segments, and onnxruntime's scattered sums lose terms where two threads meet.
        ends = plan.counts.cumsum(0)
        running = functional.pad(weighted.index_select(0, plan.members).double().cumsum(0), (0, 0, 1, 0))
        sums = running.index_select(0, ends) - running.index_select(0, ends - plan.counts)
        sums = sums.to(weighted.dtype)
        return sums[:, :-1] / sums[:, -1:]
    if len(plan.counts) == len(attributes):
        return attributes.index_select(0, plan.members)
    sums = torch.segment_reduce(weighted.index_select(0, plan.members), "sum", lengths=plan.counts)
    return sums[:, :-1] / sums[:, -1:]


def encoder_inputs(
    gaussians: Gaussians,
    config: EncoderConfig,
    voxel: float,
    device: str | torch.device = "cpu",
    *,
    whole: Curves | None = None,
) -> tuple[Float[Tensor, "N A"], Float[Tensor, " N"], CloudPlan]:
    """What an encoder takes of one cloud: attributes, opacities, and its plan.

    Args:
        gaussians: the cloud.
        config: of the encoder.
        voxel: edge of the finest grid in the cloud's own units (`config.voxel` is in metres).
        device: where the tensors are to be.
        whole: of the scene that the cloud is a part of (`curves.curves_of`); None = it is all of it.

    Raises:
        InputError: the cloud spreads over too many cells.
    """

    def tensor(array: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(device)

    means, opacities = tensor(gaussians.means), tensor(gaussians.opacities)
    attributes = embed(
        means,
        tensor(gaussians.quats),
        tensor(gaussians.scales),
        opacities,
        tensor(gaussians.sh[:, 0]),
        voxel=voxel,
        attributes=config.inputs,
    )
    shape = config.transformer
    plan = plan_cloud(means, voxel, levels=shape.levels, orders=shape.orders, whole=whole)
    return attributes, opacities, plan
