"""Parts of a scene that an encoder sees one at a time, each with its surroundings."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int64


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Chunk:
    """A part of a scene.

    Attributes:
        own: rows whose features come from this chunk.
        rows: what the network sees, `own` first.
    """

    own: Int64[np.ndarray, " n"]
    rows: Int64[np.ndarray, " m"]


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
