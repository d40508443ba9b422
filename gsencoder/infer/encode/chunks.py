"""A scene of any size in parts: what an encoder sees at a time, each part with its surroundings."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float32, Int64

from gsencoder.core.errors import InputError
from gsencoder.core.runtime.device_names import Device, Precision
from gsencoder.core.runtime.tracking import Track, untracked
from gsencoder.models.grid.curves import SceneCurves
from gsencoder.types import Gaussians


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


def encode_by_chunks(
    gaussians: Gaussians,
    run: Callable[[Gaussians, SceneCurves | None], Float32[np.ndarray, "n channels"]],
    curves: Callable[[], SceneCurves | None],
    config: EncodeConfig,
    *,
    metres_per_unit: float,
    channels: int,
    track: Track = untracked,
) -> Float32[np.ndarray, "N channels"]:
    """What an encoder finds for every Gaussian, seen part by part.

    Args:
        gaussians: the splat.
        run: what the encoder finds for a part, given the curves of the whole where it is not all.
        curves: makes these, where there are several parts.
        config: of the parts.
        metres_per_unit: of the splat's world.
        channels: columns of the result.
        track: wraps the loop over chunks to show progress.

    Raises:
        InputError: no Gaussians, or features that are not finite.
    """
    if not len(gaussians):
        raise InputError("encode: the splat has no Gaussians")
    result = np.zeros((len(gaussians), channels), np.float32)
    bad = 0
    chunks = cut(gaussians.means, config.chunk, config.halo / metres_per_unit)
    whole = curves() if len(chunks) > 1 else None
    for chunk in track(chunks, "encoding"):
        part = gaussians if len(chunks) == 1 else gaussians.select(chunk.rows)
        found = run(part, whole)[: len(chunk.own)]
        bad += int((~np.isfinite(found).all(axis=1)).sum())
        result[chunk.own] = found
    if bad:
        raise InputError(f"encode: {bad} of {len(result)} features are not finite; try precision=float32")
    return result


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
