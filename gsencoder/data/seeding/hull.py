"""The visual hull: what photographs show to be empty holds no surface (Laurentini 1994)."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float32

from gsencoder.data.photographs import Photographs

MIN_VIEWS = 2
"""So many photographs must show a point's place to be empty: one pose may be off."""


def outside_hull(
    points: Float32[np.ndarray, "P 3"], photographs: Photographs, training: Sequence[int]
) -> Bool[np.ndarray, " P"]:
    """Which points lie where photographs show that nothing is.

    Args:
        points: world units relative to the scene's origin.
        photographs: of all views.
        training: those that may be looked at.
    """
    cameras, seen_empty = photographs.cameras, np.zeros(len(points), np.int64)
    for view in training:
        empty = photographs.empty(view)
        if empty is None:
            continue
        pixels, depths = cameras.project(points.astype(np.float64), view)
        inside = cameras.in_image(pixels, depths, view)
        columns, rows = torch.from_numpy(pixels[inside].astype(np.int64)).unbind(1)
        seen_empty[inside] += empty[rows, columns].numpy()
    return np.asarray(seen_empty >= min(MIN_VIEWS, len(training)))
