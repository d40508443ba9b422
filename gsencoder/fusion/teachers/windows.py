"""Large pictures in windows that overlap: each is given to a network by itself, and their maps are averaged."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor


def window_starts(count: int, window: int, overlap: float) -> list[int]:
    """Where windows begin along a side, in patches: evenly apart, the first at 0 and the last one at the end.

    Args:
        count: patches along the side.
        window: patches along a window; one window is enough where it is not less than `count`.
        overlap: smallest share of a window that the next one covers again, in [0, 1).
    """
    if window >= count:
        return [0]
    step = max(1, int(window * (1 - overlap)))
    steps = -(-(count - window) // step)
    return [round(number * (count - window) / steps) for number in range(steps + 1)]


def map_in_windows(
    network: Callable[[Float[Tensor, "1 3 H W"]], Float[Tensor, "h w D"]],
    pixels: Float[Tensor, "1 3 H W"],
    patch: int,
    window: int,
    overlap: float,
) -> Float[Tensor, "h w D"]:
    """The mean, cell by cell, of the maps of all windows that hold the cell.

    Args:
        network: gives a window's map, one cell a patch.
        pixels: a picture with sides of whole patches.
        patch: pixels along a patch.
        window: pixels along a window, in whole patches; a side of the picture that is shorter is one window.
        overlap: smallest share of a window that the next one covers again, in [0, 1).
    """
    rows, columns = pixels.shape[2] // patch, pixels.shape[3] // patch
    side = max(1, window // patch)
    height, width = min(side, rows), min(side, columns)
    sums, counts = torch.zeros(0), pixels.new_zeros(rows, columns, 1)
    for top in window_starts(rows, height, overlap):
        for left in window_starts(columns, width, overlap):
            inside = (slice(top, top + height), slice(left, left + width))
            cut = pixels[:, :, top * patch : (top + height) * patch, left * patch : (left + width) * patch]
            cells = network(cut)
            if not len(sums):
                sums = cells.new_zeros(rows, columns, cells.shape[-1])
            sums[inside] += cells
            counts[inside] += 1
    return sums / counts
