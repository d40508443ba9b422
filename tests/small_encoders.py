"""A small encoder, and random Gaussians for it."""

import numpy as np
import torch

from gsencoder.models.encoder import EncoderConfig, GaussianEncoder, encoder_inputs
from gsencoder.models.plan import join_plans
from gsencoder.models.transformer import TransformerConfig
from gsencoder.types import Gaussians

TINY = TransformerConfig(
    encoder_depths=(1, 1, 2),
    encoder_channels=(16, 32, 32),
    decoder_depths=(1, 1),
    decoder_channels=(16, 32),
    head_channels=16,
    patch=24,
)
CONFIG = EncoderConfig(voxel=0.1, transformer=TINY)


def splat(count: int, seed: int = 0, extent: float = 1.5) -> Gaussians:
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(count, 4))
    return Gaussians(
        means=rng.uniform(0, extent, (count, 3)).astype(np.float32),
        quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        scales=rng.uniform(0.005, 0.1, (count, 3)).astype(np.float32),
        opacities=rng.uniform(0, 1, count).astype(np.float32),
        sh=rng.normal(size=(count, 1, 3)).astype(np.float32),
    )


def encoder(config: EncoderConfig = CONFIG, channels: int = 7) -> GaussianEncoder:
    torch.manual_seed(0)
    return GaussianEncoder(config, channels).eval()


def run(network: GaussianEncoder, *splats: Gaussians, round_up: bool = True) -> torch.Tensor:
    """The features of splats, put side by side."""
    inputs = [encoder_inputs(one, network.config, network.config.voxel) for one in splats]
    plan = join_plans([cloud for _, _, cloud in inputs], network.config.transformer.patch, round_up=round_up)
    with torch.no_grad():
        return network(torch.cat([a for a, _, _ in inputs]), torch.cat([o for _, o, _ in inputs]), plan)
