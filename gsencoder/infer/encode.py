"""Features of a splat in one pass: no photographs, no teacher (SplatDistill sec. 3.4), for scenes of any size."""

import math
from dataclasses import dataclass, field

import numpy as np
import torch

from gsencoder.errors import InputError
from gsencoder.infer.chunks import cut
from gsencoder.models.curves import curves_of
from gsencoder.models.device import Device, Precision, autocast_dtype, choose_device
from gsencoder.models.encoder import GaussianEncoder, encoder_inputs
from gsencoder.models.output_space import OutputSpace
from gsencoder.tracking import Track, untracked
from gsencoder.types import GaussianFeatures, Gaussians


@dataclass(frozen=True, slots=True, kw_only=True)
class EncodeConfig:
    """How much at a time, and in what precision."""

    chunk: int = field(
        default=250_000, metadata={"help": "most Gaussians that the network sees at once, halo included; 0 = all"}
    )
    halo: float = field(default=0.64, metadata={"help": "metres of surroundings that a chunk sees beyond its own part"})
    precision: Precision = field(
        default="auto",
        metadata={"help": "what the encoder computes in; auto = bfloat16 where the device multiplies it"},
    )
    device: Device = field(default="auto", metadata={"help": "where it computes"})

    def __post_init__(self) -> None:
        if self.chunk < 0:
            raise InputError(f"chunk: expected 0 (all) or more, got {self.chunk}")
        if not 0 <= self.halo < math.inf:
            raise InputError(f"halo: expected 0 or more metres, got {self.halo}")


def encode(
    gaussians: Gaussians,
    encoder: GaussianEncoder,
    outputs: OutputSpace,
    config: EncodeConfig = EncodeConfig(),
    *,
    metres_per_unit: float = 1.0,
    track: Track = untracked,
) -> GaussianFeatures:
    """Features of every Gaussian, all with weight 1.

    Args:
        gaussians: the splat.
        encoder: from `load_weights`, in evaluation mode.
        outputs: what its numbers mean.
        config: see there.
        metres_per_unit: of the splat's world; the encoder's grid is in metres.
        track: wraps the loop over chunks to show progress.

    Raises:
        InputError: no Gaussians, or they spread over too many cells.
    """
    if not len(gaussians):
        raise InputError("encode: the splat has no Gaussians")
    device = choose_device(config.device)
    dtype = autocast_dtype(config.precision, device)
    encoder = encoder.to(device).eval()
    voxel = encoder.config.voxel / metres_per_unit
    result = np.zeros((len(gaussians), outputs.channels), np.float32)
    bad = 0
    chunks = cut(gaussians.means, config.chunk, config.halo / metres_per_unit)
    shape = encoder.config.transformer
    whole = None
    if len(chunks) > 1:
        whole = curves_of(gaussians.means, voxel, levels=shape.levels, orders=shape.orders, patch=shape.patch)
    with torch.inference_mode(), torch.autocast(device.type, dtype, enabled=dtype is not None):
        for chunk in track(chunks, "encoding"):
            attributes, opacities, plan = encoder_inputs(
                gaussians.select(chunk.rows), encoder.config, voxel, device, whole=whole
            )
            found = encoder(attributes, opacities, encoder.join([plan]))
            bad += int((~torch.isfinite(found[: len(chunk.own)]).all(dim=1)).sum())
            result[chunk.own] = outputs.restore(found[: len(chunk.own)].cpu().numpy())
    if bad:
        raise InputError(f"encode: {bad} of {len(result)} features are not finite; try precision=float32")
    return GaussianFeatures(
        features=result,
        weights=np.ones(len(gaussians), np.float32),
        mean=outputs.mean,
        space=outputs.space,
        basis=outputs.basis,
    )
