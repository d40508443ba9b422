"""Close-ups: windows of the scene's own photographs around a target.

A photograph has far more pixels than a model is shown of it. A window of it shows a small thing as large as a camera
near it would, and sharper than any render.
"""

import numpy as np
from jaxtyping import Float64, Int64

from gsencoder.core.arrays import even_indices
from gsencoder.infer.views.constants import CONSTANTS
from gsencoder.infer.views.targets import Target
from gsencoder.types import Cameras, Gaussians


def closeups(
    frames: Cameras, gaussians: Gaussians, target: Target, *, width: int, height: int
) -> tuple[Cameras, Int64[np.ndarray, " n"]]:
    """The frames' cameras with windows around a target, where these are clearly smaller than the frame.

    Args:
        frames: in the sizes of their photographs.
        gaussians: the splat.
        target: what is looked at; half of its size is left on every side.
        width: of the pictures to be shown, pixels.
        height: of the pictures to be shown, pixels; windows have the same shape.

    Returns:
        n cameras at places of frames, and which frames these are, ascending.
    """
    points = gaussians.means[target.rows[even_indices(len(target.rows), CONSTANTS.closeup_sample)]].astype(np.float64)
    rows: list[int] = []
    Ks: list[Float64[np.ndarray, "3 3"]] = []
    for view in range(len(frames)):
        pixels, depths = frames.project(points, view)
        shown = frames.in_image(pixels, depths, view)
        if shown.mean() < CONSTANTS.min_closeup_inside:
            continue
        low, high = pixels[shown].min(axis=0), pixels[shown].max(axis=0)
        wide, tall = (high - low) * (1 + 2 * CONSTANTS.frame_margin)
        window = np.array([1, height / width]) * max(wide, tall * width / height, CONSTANTS.min_closeup_width)
        size = np.array([frames.widths[view], frames.heights[view]], np.float64)
        if (window > CONSTANTS.max_closeup_share * size).any():
            continue
        corner = np.clip((low + high) / 2 - window / 2, 0, size - window)
        K = frames.Ks[view].astype(np.float64)
        K[:2, 2] -= corner
        K[:2] *= (np.array([width, height]) / window)[:, None]
        rows.append(view)
        Ks.append(K)
    chosen_rows = np.array(rows, np.int64)
    return (
        Cameras(
            cam_from_world=frames.cam_from_world[chosen_rows],
            Ks=np.array(Ks, np.float32).reshape(-1, 3, 3),
            widths=np.full(len(chosen_rows), width, np.int32),
            heights=np.full(len(chosen_rows), height, np.int32),
        ),
        chosen_rows,
    )
