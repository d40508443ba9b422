"""Depth of one sensor as another camera beside it sees it: nearer surfaces hide further ones."""

from typing import no_type_check

import numpy as np
from jaxtyping import Float32, Float64

from gsencoder.core.process import kernel

MARGIN = 1.1
"""The square that a depth pixel covers is this much wider than the distance to its neighbor's, so that slanted surfaces
have no holes."""


def register_depth(
    depth: Float32[np.ndarray, "h w"],
    depth_K: Float64[np.ndarray, "3 3"],
    color_from_depth: Float64[np.ndarray, "4 4"],
    color_K: Float64[np.ndarray, "3 3"],
    width: int,
    height: int,
) -> Float32[np.ndarray, "height width"]:
    """Depth z in the color camera at its pixels, 0 = none: also where a surface hides from the depth sensor.

    Each depth pixel becomes a square that faces the color camera, as large as the pixel at its depth. Of several in a
    pixel the nearest counts.

    Args:
        depth: z in the depth camera, 0 = none.
        depth_K: its intrinsics, pixel centers at .5.
        color_from_depth: rigid, in the unit of the depth.
        color_K: intrinsics of the color camera at the size of the result.
        width: of the result, pixels.
        height: of the result, pixels.
    """
    result = np.full((height, width), np.inf, np.float32)
    _register(
        np.ascontiguousarray(depth, np.float32),
        np.ascontiguousarray(depth_K, np.float64),
        np.ascontiguousarray(color_from_depth, np.float64),
        np.ascontiguousarray(color_K, np.float64),
        result,
    )
    result[np.isinf(result)] = 0
    return result


@kernel
@no_type_check
def _register(depth, depth_K, color_from_depth, color_K, result):
    height, width = result.shape
    fx, fy, cx, cy = color_K[0, 0], color_K[1, 1], color_K[0, 2], color_K[1, 2]
    half_x, half_y = 0.5 * MARGIN * fx / depth_K[0, 0], 0.5 * MARGIN * fy / depth_K[1, 1]
    for row in range(depth.shape[0]):
        for column in range(depth.shape[1]):
            z = depth[row, column]
            if not z > 0:
                continue
            x = (column + 0.5 - depth_K[0, 2]) / depth_K[0, 0] * z
            y = (row + 0.5 - depth_K[1, 2]) / depth_K[1, 1] * z
            m = color_from_depth
            far = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
            if not far > 0:
                continue
            u = fx * (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) / far + cx
            v = fy * (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) / far + cy
            wide, high = half_x * z / far, half_y * z / far
            if not (u + wide > 0 and v + high > 0 and u - wide < width and v - high < height):
                continue
            left, right = max(0, int(np.ceil(u - wide - 0.5))), min(width - 1, int(np.floor(u + wide - 0.5)))
            top, bottom = max(0, int(np.ceil(v - high - 0.5))), min(height - 1, int(np.floor(v + high - 0.5)))
            for r in range(top, bottom + 1):
                for c in range(left, right + 1):
                    if far < result[r, c]:
                        result[r, c] = far
