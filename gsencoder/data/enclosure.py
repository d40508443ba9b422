"""Is a bare splat a room or an object? Its free space says: what encloses it, and what stands in it.

A cupboard, a bust or a box is as closed as a room, so that being enclosed is not enough. Rays in 26 directions through
a coarse grid tell rooms apart in two ways. A scan without a ceiling is flat and open: most of its surface is free on
one side, and no part of its space is enclosed. A room with walls has one large space, and something stands in it: rays
that leave this space at a surface enter the same space again behind it. They do not where an empty shell ends.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial.transform import Rotation

from gsencoder.core.even_indices import even_indices
from gsencoder.data.seeding.room_frame import fit_axes
from gsencoder.data.surfaces import surfaces_of_gaussians
from gsencoder.types import Gaussians

CELLS = 32
"""Cells along the longest side: a wall of 5 m is 16 cm a cell, less than a chair."""
EXTENT = (0.03, 0.97)
"""Quantiles of the coordinates between which the grid lies."""
OPAQUE = 0.3
"""Gaussians of less opacity enclose nothing."""
MAX_GAUSSIANS = 200_000
"""Of more Gaussians, a random choice of so many fills cells."""
MAX_FRAME_MEANS, STARTS = 5000, 4
"""Means and normals of which the grid's axes are fitted, and random axes from which on."""
FILLED = 0.05
"""Area of the discs in a cell, in areas of its side, from which on the cell is a surface."""
ENCLOSED = 0.65
"""Share of the directions in which a free cell's rays end at a surface, from which on the cell is enclosed."""
OPEN_FLATNESS, OPEN_SURFACES, OPEN_SPACE = 0.35, 0.5, 0.3
"""An open scan's smallest side is at most this share of its largest one; rays from its surfaces get out in at least
this share of the directions; and at most this share of it is one enclosed space. House rooms have 0.06 to 0.3, 0.53 to
0.68 and 0.0 to 0.12; a window has 0.13, 0.58 and 0.47, a bowl 0.41, 0.48 and 0.0."""
ROOM_FLATNESS = 0.55
"""A room with walls is at most this high, as a share of its length."""
ROOM_SPACE, ROOM_SURFACES, ROOM_CONTENT = 0.3, 0.36, 0.01
"""The same of the enclosed space of a room with walls, at least, and of its surfaces (a piece of furniture has boards
in it and behind it, 0.2 to 0.35); and the share of the rays from its space that enter it again. A corridor with a few
cupboards has 0.013, rooms with tables and shelves 0.08 to 0.14; a scanned packet 0.008, boxes and bathtubs none."""
FULL_SPACE, FULL_CONTENT = 0.05, 0.04
"""Where less space is enclosed, since things stand everywhere, more rays must enter it again: a kitchen has 0.07 and
0.05."""
DIRECTIONS = tuple(each for each in product((-1, 0, 1), repeat=3) if any(each))


@dataclass(frozen=True, slots=True, kw_only=True)
class Enclosure:
    """What encloses the free space of a splat; shares from 0 to 1.

    Attributes:
        flatness: smallest side over largest side.
        openness: mean share of the directions in which rays from surfaces meet nothing.
        space: the largest connected enclosed space, as a share of the box around the splat.
        content: share of the rays from this space that enter it again behind the first surface they meet.
    """

    flatness: float
    openness: float
    space: float
    content: float

    @property
    def is_room(self) -> bool:
        """Whether photographs of it would be taken from inside."""
        if self.flatness <= OPEN_FLATNESS and self.openness >= OPEN_SURFACES and self.space <= OPEN_SPACE:
            return True
        if self.flatness > ROOM_FLATNESS:
            return False
        if self.space >= ROOM_SPACE:
            return self.openness >= ROOM_SURFACES and self.content >= ROOM_CONTENT
        return self.space >= FULL_SPACE and self.content >= FULL_CONTENT


def enclosure_of(gaussians: Gaussians) -> Enclosure:
    """Measures what encloses the free space of a splat; which way is up does not matter."""
    from scipy import ndimage

    areas = _surface_areas(gaussians)
    surface = areas >= FILLED
    if not surface.any():
        return Enclosure(flatness=1.0, openness=1.0, space=0.0, content=0.0)
    closed = _blocked(surface) / len(DIRECTIONS)
    openness = float(np.average(1 - closed, weights=areas * surface))
    numbers, count = ndimage.label(~surface & (closed >= ENCLOSED))
    space = np.zeros_like(surface)
    if count:
        space = numbers == 1 + int(np.bincount(numbers.ravel())[1:].argmax())
    content = float(_entering_again(surface, space)[space].sum()) / max(1, len(DIRECTIONS) * int(space.sum()))
    sides = surface.shape
    return Enclosure(flatness=min(sides) / max(sides), openness=openness, space=float(space.mean()), content=content)


def _surface_areas(gaussians: Gaussians) -> Float64[np.ndarray, "x y z"]:
    """The area of opaque Gaussians' discs in each cell of a grid, in areas of a cell's side."""
    rows = np.flatnonzero(gaussians.opacities >= OPAQUE)
    total = len(rows)
    if total > MAX_GAUSSIANS:
        rows = np.sort(np.random.default_rng(0).choice(rows, MAX_GAUSSIANS, replace=False))
    if not total:
        return np.zeros((1, 1, 1))
    frame = _frame(gaussians, gaussians.means[rows].astype(np.float64))
    means, scales = gaussians.means[rows] @ frame.T, gaussians.scales[rows].astype(np.float64)
    low, high = np.quantile(means, EXTENT, axis=0)
    edge = float((high - low).max()) / CELLS or 1.0
    shape = np.maximum(np.ceil((high - low) / edge), 1).astype(np.int64)
    axes = frame @ Rotation.from_quat(gaussians.quats[rows].astype(np.float64), scalar_first=True).as_matrix()
    # A disc fills the cells of its center and of the ends of its axes.
    reach = np.minimum(scales, 2 * edge)[:, None] * axes
    points = np.concatenate([means, *(means + sign * reach[..., axis] for axis in range(3) for sign in (-1, 1))])
    widths = np.sort(scales, axis=1)[:, 1:]
    shares = np.pi * widths.prod(axis=1) / edge**2 * total / len(rows) / 7
    cells = np.floor((points - low) / edge)
    within = ((cells >= 0) & (cells < shape)).all(axis=1)
    index = np.ravel_multi_index(tuple(cells[within].astype(np.int64).T), tuple(shape))
    return np.bincount(index, np.tile(shares, 7)[within], int(shape.prod())).reshape(shape)


def _frame(gaussians: Gaussians, means: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "3 3"]:
    """The axes, as rows, of the grid: those of the walls, those in which the means spread most, or the world's,
    whichever give the smallest box."""
    means = means[even_indices(len(means), MAX_FRAME_MEANS)]
    normals = surfaces_of_gaussians(gaussians).normals[:MAX_FRAME_MEANS]
    starts = Rotation.random(STARTS, random_state=0).as_matrix() if len(normals) else ()
    fits = [fit_axes(normals, start) for start in starts]
    candidates = [np.eye(3), np.linalg.eigh(np.cov(means.T, bias=True))[1].T, *fits]
    return min(candidates, key=lambda axes: float(np.prod(np.ptp(np.quantile(means @ axes.T, EXTENT, axis=0), axis=0))))


def _slices(direction: tuple[int, ...], *grids: np.ndarray) -> Iterator[tuple[tuple[int, int], list[np.ndarray]]]:
    """Slices of grids across an axis of the direction, the one that rays reach last first; each with the step within
    slices to the next cell of a ray."""
    axis = next(number for number in range(3) if direction[number])
    across = [direction[number] for number in range(3) if number != axis]
    moved = [np.moveaxis(grid, axis, 0) for grid in grids]
    order = range(len(moved[0]))
    for index in reversed(order) if direction[axis] > 0 else order:
        yield (across[0], across[1]), [grid[index] for grid in moved]


def _shifted(values: Bool[np.ndarray, "a b"], step: tuple[int, int]) -> Bool[np.ndarray, "a b"]:
    """For each cell the value of the cell one step further; false outside."""
    padded = np.pad(values, 1)
    height, width = values.shape
    return padded[1 + step[0] : 1 + step[0] + height, 1 + step[1] : 1 + step[1] + width]


def _blocked(surface: Bool[np.ndarray, "x y z"]) -> Int64[np.ndarray, "x y z"]:
    """The number of directions in which a ray from each cell meets a surface."""
    count = np.zeros(surface.shape, np.int64)
    for direction in DIRECTIONS:
        ahead = None
        for step, (here, counted) in _slices(direction, surface, count):
            met = np.zeros_like(here) if ahead is None else _shifted(ahead, step)
            counted += met
            ahead = met | here
    return count


def _entering_again(surface: Bool[np.ndarray, "x y z"], space: Bool[np.ndarray, "x y z"]) -> Int64[np.ndarray, "x y z"]:
    """The number of directions in which a ray from each free cell meets a surface, and `space` right behind it."""
    count = np.zeros(surface.shape, np.int64)
    for direction in DIRECTIONS:
        ahead = None
        for step, (here, inside, counted) in _slices(direction, surface, space, count):
            # Of each cell: whether the ray that goes on from it, out of its surface if it is one, comes into the space.
            found = np.zeros_like(here) if ahead is None else _shifted(ahead[0], step)
            # Of a free cell: whether its ray finds the space behind the next surface.
            behind = np.zeros_like(here) if ahead is None else _shifted(ahead[1], step)
            counted += behind & ~here
            ahead = np.where(here, found, inside), np.where(here, found, behind)
    return count
