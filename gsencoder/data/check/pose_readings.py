"""Other ways to take the poses of a scene's files."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Float64

from gsencoder.types.checks import OPENCV_FROM_OPENGL, invert_rigid

PLACES = (-2, -1, 1, 2)
"""So many places in the order of the views poses may be moved by."""


def other_poses(cam_from_world: Float64[np.ndarray, "V 4 4"]) -> dict[str, Float64[np.ndarray, "V 4 4"]]:
    """cam_from_world if the files' matrices mean something else, by the cause in `ADVICE`."""
    inverse = invert_rigid(cam_from_world)
    return {
        "axes": OPENCV_FROM_OPENGL @ cam_from_world,
        "inverse": inverse,
        "inverse and axes": OPENCV_FROM_OPENGL @ inverse,
    }


def other_orders(poses: Float[np.ndarray, "V 4 4"]) -> Iterator[tuple[int, Float[np.ndarray, "V 4 4"]]]:
    """The poses if each belongs to the photograph some places further on, and by how many places; ends are wrapped."""
    if len(poses) > 2:
        for shift in PLACES:
            yield shift, np.roll(poses, shift, axis=0)
