"""The lattice of rays of a blend, grouped into rows of B.

Pixel rows are the lattice of pixel centers with one ray a row. Patch rows put `side × side` rays into each cell of a
coarser grid (a teacher's patch grid, seen through its resize and crop), at the centers of equal sub-cells: a fixed
stratified pattern, so that the same scene gives the same numbers on every run.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from gsencoder.core.errors import InputError


@dataclass(frozen=True, slots=True, kw_only=True)
class Lattice:
    """Ray (i, j) pierces pixel coordinates (x0 + i·dx, y0 + j·dy); row (r, c) owns a side × side block of rays.

    Attributes:
        side: rays along one side of a cell.
        x0, y0: first ray, in pixels.
        dx, dy: distance between rays, in pixels.
        tile: rays along one side of a binning tile: a whole number of cells, near 16.
    """

    height: int
    width: int
    side: int
    x0: float
    y0: float
    dx: float
    dy: float
    tile: int = 16

    @property
    def rows(self) -> int:
        return self.height * self.width


def strided_lattice(width: int, height: int, stride: int) -> Lattice:
    """One ray through the center of every `stride`-th pixel, from the middle of the first block of that many on."""
    if stride < 1:
        raise InputError(f"stride: expected at least 1 pixel, got {stride}")
    first_x, first_y = min(stride, width) // 2, min(stride, height) // 2
    return Lattice(
        height=math.ceil((height - first_y) / stride),
        width=math.ceil((width - first_x) / stride),
        side=1,
        x0=first_x + 0.5,
        y0=first_y + 0.5,
        dx=float(stride),
        dy=float(stride),
    )


def patch_lattice(width: int, height: int, patch: int, rays_per_patch: int) -> Lattice:
    """Square patches from the image's top left corner; the last ones may reach over the right and lower border."""
    if patch < 1:
        raise InputError(f"patch: expected at least 1 pixel, got {patch}")
    grid_from_image = np.array([[1 / patch, 0, 0], [0, 1 / patch, 0]])
    return grid_lattice(grid_from_image, math.ceil(width / patch), math.ceil(height / patch), rays_per_patch)


def grid_lattice(grid_from_image: Float64[np.ndarray, "2 3"], width: int, height: int, rays_per_patch: int) -> Lattice:
    """Rays for any grid that is a resize and crop of the image.

    Args:
        grid_from_image: diagonal affine from pixel to grid coordinates; cell (r, c) covers [c, c+1) × [r, r+1).
        width: cells in a line of the grid.
        rays_per_patch: 1, 4, 9, 16, …
    """
    side = math.isqrt(max(rays_per_patch, 0))
    if side < 1 or side * side != rays_per_patch:
        raise InputError(f"rays_per_patch: expected a square number (1, 4, 9, 16, …), got {rays_per_patch}")
    (ax, _, bx), (_, ay, by) = grid_from_image.tolist()
    dx, dy = 1 / (ax * side), 1 / (ay * side)
    x0, y0, tile = -bx / ax + dx / 2, -by / ay + dy / 2, side * max(1, round(16 / side))
    return Lattice(height=height, width=width, side=side, x0=x0, y0=y0, dx=dx, dy=dy, tile=tile)
