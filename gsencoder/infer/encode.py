"""Features of a splat in one pass: no photographs, no teacher (SplatDistill sec. 3.4), for scenes of any size."""

import math
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float32, Int64

from gsencoder.errors import InputError
from gsencoder.models.device import Device, Precision, autocast_dtype, choose_device
from gsencoder.models.encoder import GaussianEncoder, encoder_inputs
from gsencoder.models.output_space import OutputSpace
from gsencoder.models.plan import Curves, curves_of
from gsencoder.models.serialize import LARGEST_EXTENT
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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Chunk:
    """A part of a scene.

    Attributes:
        own: rows whose features come from this chunk.
        rows: what the network sees, `own` first.
    """

    own: Int64[np.ndarray, " n"]
    rows: Int64[np.ndarray, " m"]


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
    whole = _whole(gaussians, encoder, voxel, device) if len(chunks) > 1 else None
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


def _whole(gaussians: Gaussians, encoder: GaussianEncoder, voxel: float, device: torch.device) -> Curves | None:
    """The scene's curves; None where it has too many cells for one set of codes, and each chunk has its own."""
    if np.ptp(gaussians.means.astype(np.float64), axis=0).max() >= (LARGEST_EXTENT - 2) * voxel:
        return None
    shape = encoder.config.transformer
    means = torch.from_numpy(np.ascontiguousarray(gaussians.means)).to(device)
    return curves_of(means, voxel, levels=shape.levels, orders=shape.orders)


def cut(means: Float32[np.ndarray, "N 3"], chunk: int, halo: float) -> list[Chunk]:
    """Cuts a scene into boxes, halved along their longest side until each, with its halo, fits into a chunk.

    Every row is some chunk's own, once. Where a box has become small beside its halo, the halo is what is cut: the
    nearest surroundings that fit are kept.

    Args:
        means: world units.
        chunk: most rows of a chunk; 0 = one chunk.
        halo: world units.
    """
    everything = np.arange(len(means))
    if chunk == 0 or len(means) <= chunk:
        return [Chunk(own=everything, rows=everything)]
    found: list[Chunk] = []
    waiting = [(everything, np.full(3, -np.inf), np.full(3, np.inf))]
    while waiting:
        own, low, high = waiting.pop()
        around = _around(means, own, low, high, halo)
        if len(own) + len(around) <= chunk or len(own) <= max(1, chunk // 4):
            if len(own) + len(around) > chunk:
                inside = means[around].clip(low, high)
                far = np.square(means[around] - inside).sum(axis=1)
                around = around[np.sort(np.argsort(far, kind="stable")[: chunk - len(own)])]
            found.append(Chunk(own=own, rows=np.concatenate((own, around))))
            continue
        points = means[own]
        axis = int(np.argmax(points.max(axis=0) - points.min(axis=0)))
        order = np.argsort(points[:, axis], kind="stable")
        half = len(own) // 2
        middle = float(points[order[half], axis])
        first, second = np.sort(own[order[:half]]), np.sort(own[order[half:]])
        upper, lower = high.copy(), low.copy()
        upper[axis] = lower[axis] = middle
        waiting += [(second, lower, high), (first, low, upper)]
    return found


def _around(means: np.ndarray, own: np.ndarray, low: np.ndarray, high: np.ndarray, halo: float) -> np.ndarray:
    """Rows within `halo` of a box that are not its own."""
    near = np.asarray(((means >= low - halo) & (means <= high + halo)).all(axis=1))
    near[own] = False
    return np.flatnonzero(near)
