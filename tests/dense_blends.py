"""B as a dense matrix, and Gaussians at the ends of what a splat may hold."""

import numpy as np
from splats import one_gaussian, random_gaussians

from gsencoder.render import Blend


def dense(b: Blend) -> np.ndarray:
    out = np.zeros((b.rows, b.gaussians))
    row = np.repeat(np.arange(b.rows), b.crow.diff().numpy())
    out[row, b.col.numpy()] = b.weight.numpy()
    return out


EXTREMES = {
    "an empty view": random_gaussians(50, 0, center=(0, 0, -30)),
    "no Gaussians": random_gaussians(0),
    "one Gaussian": one_gaussian(),
    "scales of 1e-9": one_gaussian(scale=1e-9),
    "scales of 1e4": one_gaussian(scale=1e4),
    "opacity 0": one_gaussian(opacity=0.0),
    "opacity 1": one_gaussian(opacity=1.0),
    "on the camera": one_gaussian((0, 0, 0)),
    "at the near plane": one_gaussian((0, 0, 0.01001), scale=1.0),
    "a needle": one_gaussian((0.2, 0.1, 2), (1.0, 1e-6, 1e-6)),
    "a disc edge-on": one_gaussian((0.0, 0.0, 2), (1.0, 1e-6, 1.0)),
    "far away": one_gaussian((0, 0, 1e6), scale=1e4),
}
