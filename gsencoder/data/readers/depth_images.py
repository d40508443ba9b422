"""Depth images of sensors as lazy sequences: z in world units, in the pixels of the photographs."""

from collections.abc import Sequence
from typing import no_type_check

import numpy as np
from jaxtyping import Float32, Float64

from gsencoder.core.errors import InputError
from gsencoder.core.threads import kernel
from gsencoder.data.readers.images import PictureFiles, PixelGrid, load_npy, read_integers
from gsencoder.data.readers.posed import PosedImage
from gsencoder.data.readers.undistort import pinhole_for, remap_between
from gsencoder.types.checks import invert_rigid
from gsencoder.types.scene import pixel_centers, unproject_points


def ray_lengths(K: Float64[np.ndarray, "3 3"], width: int, height: int) -> Float64[np.ndarray, "height width"]:
    """The distance from the camera of a point of depth z = 1, for each pixel."""
    rays = unproject_points(pixel_centers(width, height), np.ones((height, width)), K)
    return np.asarray(np.linalg.norm(rays, axis=2))


class DepthFiles(PictureFiles[Float32[np.ndarray, "H W"]]):
    """Sensor depth as float32 [H, W], z in world units, 0 = none; a view without a file is all zero.

    PNG holds integers and .npy any number type; both are multiplied by the view's scale. In .npy, NaN and infinity
    also mean none. Depth of a sensor that stands elsewhere is carried over (`register_depth`).
    """

    def __init__(self, images: Sequence[PosedImage], grids: Sequence[PixelGrid]) -> None:
        super().__init__([image.depth for image in images], grids)
        self._images = tuple(images)

    def _load(self, view: int) -> Float32[np.ndarray, "H W"]:
        path, grid = self._paths[view], self.grids[view]
        if path is None:
            return np.zeros((grid.height, grid.width), np.float32)
        if path.suffix.lower() == ".npy":
            array = load_npy(path)
            with np.errstate(over="ignore"):
                values = np.where(np.isfinite(array), array, 0).astype(np.float64)
            if values.size and values.min() < 0:
                raise InputError(f"{path}: depth has negative values")
        else:
            values = read_integers(path, "depth", wide=True).astype(np.float64)
        image = self._images[view]
        if image.no_depth is not None:
            values[values == image.no_depth] = 0
        if image.depth_from_color is None:
            depth = self._nearest(view, values) * image.depth_scale
            if image.depth_measure == "ray":
                depth /= ray_lengths(grid.pinhole.matrix(grid.width, grid.height), grid.width, grid.height)
        else:
            depth = self._registered(view, values * image.depth_scale, image)
        if depth.size and depth.max() > np.finfo(np.float32).max:
            raise InputError(f"{path}: depth of {depth.max():g} world units; check the depth scale")
        return depth.astype(np.float32)

    def _registered(self, view: int, depth: np.ndarray, image: PosedImage) -> Float32[np.ndarray, "H W"]:
        """The depth of a sensor that stands elsewhere, as the photograph's camera sees it."""
        grid = self.grids[view]
        depth = self._of_source(view, depth)
        pinhole = pinhole_for(grid.source, str(self._paths[view]))
        remap = remap_between(pinhole, grid.source)
        if remap is not None:
            depth = remap.nearest(depth)
        K = pinhole.matrix(pinhole.width, pinhole.height)
        if image.depth_measure == "ray":
            depth = depth / ray_lengths(K, pinhole.width, pinhole.height)
        assert image.depth_from_color is not None
        return register_depth(
            depth.astype(np.float32),
            K,
            invert_rigid(image.depth_from_color),
            grid.pinhole.matrix(grid.width, grid.height),
            grid.width,
            grid.height,
        )


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
    pixel the nearest counts. `color_K` is that of the result's size.
    """
    result = np.full((height, width), np.inf, np.float32)
    matrices = (np.ascontiguousarray(matrix, np.float64) for matrix in (depth_K, color_from_depth, color_K))
    _register(np.ascontiguousarray(depth, np.float32), *matrices, result)
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
