"""Is a bare splat a room or an object? Its free space says: what surrounds it, and what stands in it.

A cupboard, a bust or a box is as closed as a room, so that being enclosed is not enough. Rays in 26 directions through
a coarse grid tell rooms apart: one free space borders most of the surfaces, and something stands in it, so that
rays that leave this space at a surface enter it again behind. They do not where an empty shell ends. A scan without a
ceiling is flat and open: a ray from its surfaces gets out in half of all directions, as from a floor.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

from gsencoder.core.arrays import even_indices
from gsencoder.data.check.agreement import SAMPLES, depth_views
from gsencoder.data.seeding.depth import fit_axes
from gsencoder.types import Gaussians, Views
from gsencoder.types.scene import invert_rigid, transform, unproject_points

MAX_SAMPLES = 20_000  # Gaussians that are looked at
FLATTENED = 0.5  # Gaussians whose thinnest axis is above this share of the middle one have no normal
PLANE_NEIGHBORS = 32  # Means through which a plane is laid
PLANE_THICKNESS = 0.5
"""Largest thickness of a plane, as a share of its smaller width (standard deviations of the means)."""
MIN_OPACITY = 0.3  # Means of fainter Gaussians are left out of planes
MAX_PLANE_MEANS = 400_000  # Means among which neighbors are looked for


class Surfaces(NamedTuple):
    """Oriented pieces of surfaces."""

    means: Float64[np.ndarray, "n 3"]  # positions in the world
    normals: Float64[np.ndarray, "n 3"]  # unit; either side
    areas: Float64[np.ndarray, " n"]  # in any unit
    rest: float = 0.0  # area of what has no normal, in the same unit; it lowers the confidence of an estimate


def surfaces_of_gaussians(gaussians: Gaussians) -> Surfaces:
    """A random choice of the flat Gaussians; areas are times opacity."""
    from scipy.spatial.transform import Rotation

    rows = np.random.default_rng(0).permutation(len(gaussians))[: 4 * MAX_SAMPLES]
    scales = gaussians.scales[rows].astype(np.float64)
    order = np.argsort(scales, axis=1)
    ordered = np.take_along_axis(scales, order, axis=1)
    flat = ordered[:, 0] <= FLATTENED * ordered[:, 1]
    rows, order, ordered = rows[flat][:MAX_SAMPLES], order[flat][:MAX_SAMPLES], ordered[flat][:MAX_SAMPLES]
    if not len(rows):
        return Surfaces(np.empty((0, 3)), np.empty((0, 3)), np.empty(0))
    matrices = Rotation.from_quat(gaussians.quats[rows].astype(np.float64), scalar_first=True).as_matrix()
    normals = np.take_along_axis(matrices, order[:, None, :1], axis=2)[..., 0]
    areas = ordered[:, 1] * ordered[:, 2] * gaussians.opacities[rows].astype(np.float64)
    return Surfaces(gaussians.means[rows].astype(np.float64), normals, areas)


def planes_of_gaussians(gaussians: Gaussians) -> Surfaces:
    """Planes through the neighbors of randomly chosen means; areas are squared distances to the last neighbor."""
    from scipy.spatial import cKDTree

    opaque = np.flatnonzero(gaussians.opacities >= MIN_OPACITY)
    opaque = np.random.default_rng(0).permutation(opaque)[:MAX_PLANE_MEANS]
    if len(opaque) < PLANE_NEIGHBORS:
        return Surfaces(np.empty((0, 3)), np.empty((0, 3)), np.empty(0))
    means = gaussians.means[opaque].astype(np.float64)
    distances, neighbors = cKDTree(means).query(means[:MAX_SAMPLES], k=PLANE_NEIGHBORS)
    local = means[neighbors]
    local -= local.mean(axis=1, keepdims=True)
    variances, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", local, local))
    flat = variances[:, 0] < PLANE_THICKNESS**2 * variances[:, 1]
    # Neighbors of a lone mean are far away, and say nothing about a surface of that size.
    areas = np.square(distances[:, -1])
    areas = np.minimum(areas, np.quantile(areas, 0.95))
    return Surfaces(means[:MAX_SAMPLES][flat], axes[flat, :, 0], areas[flat], float(areas[~flat].sum()))


def surfaces_of_depth(views: Views) -> Surfaces:
    """Samples of the surfaces that 16 of the depth images show, evenly spaced."""
    # Its kernels load numba, which a scene that states its up does without.
    from gsencoder.data.seeding.depth import surface_pixels

    depth = depth_views(views, even_indices(len(views), 16))
    rng = np.random.default_rng(0)
    world_from_cam = invert_rigid(depth.cam_from_world)
    parts = []
    for view in range(len(depth)):
        pixels = surface_pixels(depth.depths[view], depth.Ks[view].astype(np.float32))
        rows, columns = np.nonzero(pixels.use)
        sample = rng.permutation(len(rows))[:SAMPLES]
        rows, columns = rows[sample], columns[sample]
        z, normals = pixels.depth[rows, columns].astype(np.float64), pixels.normals[rows, columns].astype(np.float64)
        local = unproject_points(np.stack((columns, rows), axis=1) + 0.5, z, depth.Ks[view])
        facing = np.abs(np.einsum("ni,ni->n", local, normals)) / np.linalg.norm(local, axis=1)
        areas = np.square(z) / np.prod(depth.Ks[view].diagonal()[:2]) / np.maximum(facing, 0.1)
        parts.append((transform(world_from_cam[view], local), normals @ depth.cam_from_world[view, :3, :3], areas))
    means, directions, sizes = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return Surfaces(means, directions, sizes)


CELLS = 32
"""Cells along the longest side: a wall of 5 m is 16 cm a cell, less than a chair. Cells are no smaller than most
Gaussians (`RESOLVED`), else surfaces of few Gaussians have holes, through which rays would enter spaces again."""
RESOLVED = 0.75  # Share of the Gaussians whose standard deviation is at most the side of a cell
EXTENT = (0.03, 0.97)  # Quantiles of the coordinates between which the grid lies
OPAQUE = 0.3  # Gaussians of less opacity enclose nothing
MIN_GAUSSIANS, MAX_GAUSSIANS = 4000, 100_000
"""Fewer opaque Gaussians show an object: objects cut from seeds of rooms have up to 1,900, rooms 16,000 and more. Of
more Gaussians, a random choice of this size fills cells."""
TURNS = np.arange(8) * np.pi / 4
DISC = np.concatenate([np.stack((r * np.cos(TURNS + r / 3), r * np.sin(TURNS + r / 3)), axis=1) for r in (0, 1, 2)])[7:]
"""Points of a disc, in standard deviations, whose cells it fills: surfaces of overlapping discs have no holes."""
MAX_FRAME_MEANS, STARTS = 5000, 4
"""Means and normals of which the grid's axes are fitted, and random axes from which on."""
FILLED = 0.15
"""Area of the discs in a cell, in areas of its side, from which on the cell is a surface; more than one counts as one,
since Gaussians of fitted surfaces overlap."""
ENCLOSED = 0.45
"""Share of the directions in which a free cell's rays end at a surface, from which on the cell is enclosed: half of
them, as between floor and walls, and a little less where a wall was not photographed."""
FLAT, HIGH = 0.35, 0.55
"""Smallest over largest side: scans without a ceiling are at most FLAT (house rooms 0.06 to 0.28), and rooms with walls
at most HIGH (0.19 to 0.50)."""
OPEN, OPEN_WITH_CONTENT, OPEN_ADJACENT, CONTENT = 0.56, 0.48, 0.6, 0.01
"""Of a scan without a ceiling: its surfaces' openness, less where something stands in its space; the share of them that
border this space; and the content that counts. Rooms: 0.53 and more, 0.69 and more; a deck chair and a window frame
have 0.52 and 0.50, and no content."""
CLOSED, CLOSED_ADJACENT, CLOSED_CONTENT, CLOSED_SPACE = 0.31, 0.83, 0.1, 0.28
"""The same of a room with walls, and its free space: things whose boards lie behind each other are less open (a car
with seats 0.28, a kitchen 0.34); a teddy's head and body have a content of 0.05, rooms 0.14 and more; a figure on a
plate of ground has a free space of 0.17, rooms 0.41 and more."""
WIDE_SPACE, WIDE_OPENNESS, WIDE_ADJACENT, WIDE_CONTENT = 0.58, 0.24, 0.65, 0.025
"""The same of a room of any shape, such as a bathroom as high as it is wide, whose free space is most of it: most of 67
made rooms have 0.60, 0.25, 0.77 and 0.029 and more. So have a shower stall and a safe of 260 models of furniture (a
nightstand without drawers has a content of 0.016), and none of 118 splats of other things."""
BARE_SPACE = 0.43  # In a room of which this share is free, as a corridor, `CONTENT` is enough; a hat has 0.41
DIRECTIONS = tuple(each for each in product((-1, 0, 1), repeat=3) if any(each))


@dataclass(frozen=True, slots=True, kw_only=True)
class Enclosure:
    """What surrounds the free space of a splat; shares from 0 to 1."""

    flatness: float  # smallest side over largest side
    openness: float  # mean share of the directions in which rays from surfaces meet nothing
    space: float  # the largest connected enclosed space, as a share of the box around the splat
    adjacent: float  # share of the surfaces that border this space
    content: float  # share of the rays from this space that enter it again behind the first surface they meet
    enough: bool = True  # whether there are Gaussians enough to tell

    @property
    def is_room(self) -> bool:
        """Whether photographs of it would be taken from inside."""
        if not self.enough or self.adjacent < OPEN_ADJACENT:
            return False
        wide = self.space >= WIDE_SPACE and self.openness >= WIDE_OPENNESS
        if wide and self.adjacent >= WIDE_ADJACENT and self.content >= WIDE_CONTENT:
            return True
        if self.flatness > HIGH:
            return False
        low, filled = self.flatness <= FLAT, self.content >= CONTENT
        if low and (self.openness >= OPEN or (self.openness >= OPEN_WITH_CONTENT and filled)):
            return True
        if self.adjacent < CLOSED_ADJACENT or self.space < CLOSED_SPACE or self.openness < CLOSED:
            return False
        return self.content >= CLOSED_CONTENT or (filled and self.space >= BARE_SPACE)

    @property
    def reason(self) -> str:
        """Why it is a room or none, for people."""
        if not self.enough:
            return f"fewer than {MIN_GAUSSIANS:,} opaque Gaussians show no room"
        if self.is_room:
            return f"{self.adjacent:.0%} of its surfaces lie around one free space"
        if self.adjacent < OPEN_ADJACENT:
            return f"no free space borders most of its surfaces ({self.adjacent:.0%})"
        return f"of the rays from the free space within it {self.content:.1%} meet things that stand there"


def enclosure_of(gaussians: Gaussians) -> Enclosure:
    """Measures what surrounds the free space of a splat; which way is up does not matter."""
    from scipy import ndimage

    areas = np.minimum(_surface_areas(gaussians), 1)
    surface = areas >= FILLED
    enough = int((gaussians.opacities >= OPAQUE).sum()) >= MIN_GAUSSIANS
    if not surface.any():
        return Enclosure(flatness=1.0, openness=1.0, space=0.0, adjacent=0.0, content=0.0, enough=enough)
    areas = areas * surface / areas[surface].sum()
    closed = _blocked(surface) / len(DIRECTIONS)
    numbers, count = ndimage.label(~surface & (closed >= ENCLOSED))
    space = np.zeros_like(surface)
    if count:
        space = numbers == 1 + int(np.bincount(numbers.ravel())[1:].argmax())
    content = float(_entering_again(surface, space)[space].sum()) / max(1, len(DIRECTIONS) * int(space.sum()))
    return Enclosure(
        flatness=min(surface.shape) / max(surface.shape),
        openness=float((areas * (1 - closed)).sum()),
        space=float(space.mean()),
        adjacent=float(areas[ndimage.binary_dilation(space, np.ones((3, 3, 3)))].sum()),
        content=content,
        enough=enough,
    )


def _surface_areas(gaussians: Gaussians) -> Float64[np.ndarray, "x y z"]:
    """The area of opaque Gaussians' discs in each cell of a grid, in areas of a cell's side."""
    rows = np.flatnonzero(gaussians.opacities >= OPAQUE)
    total = len(rows)
    if total > MAX_GAUSSIANS:
        rows = np.sort(np.random.default_rng(0).choice(rows, MAX_GAUSSIANS, replace=False))
    if not total:
        return np.zeros((1, 1, 1))
    from scipy.spatial.transform import Rotation

    frame = _frame(gaussians, gaussians.means[rows].astype(np.float64))
    means, scales = gaussians.means[rows] @ frame.T, gaussians.scales[rows].astype(np.float64)
    low, high = np.quantile(means, EXTENT, axis=0)
    order = np.argsort(-scales, axis=1)[:, :2]
    widths = np.take_along_axis(scales, order, axis=1)
    edge = max(float((high - low).max()) / CELLS, float(np.quantile(widths[:, 0], RESOLVED))) or 1.0
    shape = np.maximum(np.ceil((high - low) / edge), 1).astype(np.int64)
    axes = frame @ Rotation.from_quat(gaussians.quats[rows].astype(np.float64), scalar_first=True).as_matrix()
    reach = np.take_along_axis(axes, order[:, None], axis=2) * np.minimum(widths, 1.5 * edge)[:, None]
    points = means[:, None] + np.einsum("nij,pj->npi", reach, DISC)
    shares = np.pi * widths.prod(axis=1) / edge**2 * total / len(rows) / len(DISC)
    cells = np.floor((points - low) / edge).reshape(-1, 3)
    within = ((cells >= 0) & (cells < shape)).all(axis=1)
    index = np.ravel_multi_index(tuple(cells[within].astype(np.int64).T), tuple(shape))
    return np.bincount(index, np.repeat(shares, len(DISC))[within], int(shape.prod())).reshape(shape)


def _frame(gaussians: Gaussians, means: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "3 3"]:
    """The axes of the grid, as rows: of the walls, of the largest spread, or the world's, by the smallest box."""
    from scipy.spatial.transform import Rotation

    means = means[even_indices(len(means), MAX_FRAME_MEANS)]
    normals = surfaces_of_gaussians(gaussians).normals[:MAX_FRAME_MEANS]
    starts = Rotation.random(STARTS, random_state=0).as_matrix() if len(normals) else ()
    fits = [fit_axes(normals, start) for start in starts]
    candidates = [np.eye(3), np.linalg.eigh(np.cov(means.T, bias=True))[1].T, *fits]
    return min(candidates, key=lambda axes: float(np.prod(np.ptp(np.quantile(means @ axes.T, EXTENT, axis=0), axis=0))))


def _slices(direction: tuple[int, ...], *grids: np.ndarray) -> Iterator[tuple[tuple[int, int], list[np.ndarray]]]:
    """Slices of grids across an axis, last to be reached first, with a ray's step within slices to the next."""
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
    """For each free cell the number of directions in which a ray meets a surface with `space` right behind it."""
    count = np.zeros(surface.shape, np.int64)
    for direction in DIRECTIONS:
        ahead = None
        for step, (here, inside, counted) in _slices(direction, surface, space, count):
            # Of each cell: whether the ray that goes on from it, out of its surface if it is one, comes into the space.
            found = np.zeros_like(here) if ahead is None else _shifted(ahead[0], step)
            # Of a free cell: whether its ray finds the space behind the next surface.
            behind = np.zeros_like(here) if ahead is None else _shifted(ahead[1], step)
            counted += behind
            ahead = np.where(here, found, inside), np.where(here, found, behind)
    return count
