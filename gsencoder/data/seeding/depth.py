"""Oriented surface samples from RGB-D frames: back-projection, normals, rejection of floating pixels at edges, and
grid subsampling that separates different surfaces inside one voxel.

Everything local is done on inverse depth w = 1/z, because a plane n·x = −c seen through a pinhole is
w = −n·r / c with the ray r = (u', v', 1): linear in the pixel. Its normal is then read off the gradient,
n ∝ −(∂w/∂u', ∂w/∂v', w − u' ∂w/∂u' − v' ∂w/∂v'), and always faces the camera, because n·r ∝ −w < 0.

The mean of all samples in a voxel lies between the surfaces where two of them share it: a spoon's rim sinks towards
the table. Samples are therefore summed by voxel, by the axis direction that they face, and by their layer along the
normal; sums of one voxel that turn out to be the same surface are joined again at the end. Sums add up in any order,
so frames stream through in constant memory.

The grid turns and moves with the room: its axes are those with the largest Σ (n · axis)⁴ over the normals n of depth
images, the walls' and the floor's in most rooms (a Manhattan world, Coughlan and Yuille 1999).
"""

import warnings
from collections.abc import Sequence
from dataclasses import replace
from itertools import permutations
from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError, SceneWarning, error_prefix
from gsencoder.core.threads import ahead, kernel
from gsencoder.data.seeding.points import flat_gaussians
from gsencoder.types import Cameras, Gaussians, Views
from gsencoder.types.scene import invert_rigid, pixel_centers, transform, unproject_points

AXIS_BITS = 19  # Bits of a voxel index along one axis: 524,288 voxels, or 10 km at 2 cm
OUT_OF_REACH = 2.0**62  # Voxels that no integer counts
MIN_SLOTS = 1 << 12  # Size of the hash table at first, a power of two like every later one
LAYER = 0.25  # Height of a layer along the normal, in voxels
SAME_SURFACE_COS = 0.95  # Two sums of a voxel are one surface if their normals are closer than this (18°) …
SAME_SURFACE_OFFSET = 0.1  # … and their planes closer than this, in voxels

_LAYERS = 8
_DIRECTIONS = 6
_COLUMNS = 10  # position, normal, color, count


class SurfaceSamples(NamedTuple):
    """Points on surfaces."""

    points: Float32[np.ndarray, "n 3"]  # world positions
    normals: Float32[np.ndarray, "n 3"]  # unit, away from the surface
    colors: Float32[np.ndarray, "n 3"]  # RGB in [0, 1]
    counts: Int64[np.ndarray, " n"]  # how many samples each stands for


class SurfaceGrid:
    """Sums of surface samples in the cells of a world-aligned grid; the cells' corners are multiples of `voxel`.

    Args:
        voxel: edge of a cell, world units.
        around: a point near the middle of the data; the grid reaches 262,144 cells to each side of it.
    """

    def __init__(self, voxel: float, around: np.ndarray) -> None:
        self.voxel = voxel
        self._base = np.floor(np.asarray(around, np.float64) / voxel).astype(np.int64) - (1 << (AXIS_BITS - 1))
        self._slots = np.full(MIN_SLOTS, -1, np.int32)
        self._keys = np.empty(0, np.int64)
        self._sums = np.empty((0, _COLUMNS))
        self._rows = 0

    def add(
        self, points: Float32[np.ndarray, "n 3"], normals: Float32[np.ndarray, "n 3"], colors: UInt8[np.ndarray, "n 3"]
    ) -> None:
        """Adds samples."""
        if not len(points):
            return
        self._make_room(self._rows + len(points))
        arrays = (points, normals, colors, np.float32(self.voxel), self._base)
        rows = _add_samples(*arrays, self._slots, self._keys, self._sums, self._rows)
        if rows < 0:
            reach = self.voxel * (1 << (AXIS_BITS - 1))
            raise InputError(
                f"seeds: a sample lies further than {reach:.6g} units ({1 << (AXIS_BITS - 1)} voxels) from the "
                "cameras' middle; look at the pose, or take a larger voxel"
            )
        self._rows = rows

    def samples(self) -> SurfaceSamples:
        """One sample for each surface in each voxel, ordered by voxel: mean position, normal and color."""
        if not self._rows:
            empty = np.zeros((0, 3), np.float32)
            return SurfaceSamples(empty, empty, empty, np.zeros(0, np.int64))
        order = np.argsort(self._keys[: self._rows])
        keys, sums = self._keys[order], self._sums[order]
        surface = _surfaces(keys // (_DIRECTIONS * _LAYERS), sums, self.voxel)
        sums = _sum_rows(surface, sums, int(surface.max()) + 1)
        counts = sums[:, 9:]
        normals = sums[:, 3:6] / np.linalg.norm(sums[:, 3:6], axis=1, keepdims=True)
        return SurfaceSamples(
            (sums[:, :3] / counts).astype(np.float32),
            normals.astype(np.float32),
            (sums[:, 6:9] / (255 * counts)).astype(np.float32),
            counts[:, 0].astype(np.int64),
        )

    def _make_room(self, rows: int) -> None:
        """Makes the arrays large enough for this many rows, and the hash table twice as large."""
        if rows > len(self._keys):
            size = max(rows, 2 * len(self._keys))
            self._keys = np.concatenate([self._keys[: self._rows], np.empty(size - self._rows, np.int64)])
            self._sums = np.concatenate([self._sums[: self._rows], np.empty((size - self._rows, _COLUMNS))])
        if 2 * rows > len(self._slots):
            self._slots = np.full(1 << (2 * rows - 1).bit_length(), -1, np.int32)
            _fill_slots(self._keys[: self._rows], self._slots)


@kernel
@no_type_check
def _slot_of(key, keys, slots):
    """The slot of a key in a hash table with linear probing, or the empty one where it belongs."""
    mask = len(slots) - 1
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    slot = np.int64(mixed >> np.uint64(20)) & mask
    while slots[slot] >= 0 and keys[slots[slot]] != key:
        slot = (slot + 1) & mask
    return slot


@kernel
@no_type_check
def _fill_slots(keys, slots):
    for row in range(len(keys)):
        slots[_slot_of(keys[row], keys, slots)] = row


@kernel
@no_type_check
def _add_samples(points, normals, colors, voxel, base, slots, keys, sums, rows):
    """Adds samples to the sums of their keys, in their order; returns the number of rows, or −1 where one lies outside.

    A key is the voxel, the axis direction that the normal is closest to, and the layer: the offset of the sample's
    plane from the voxel's center, at most √3/2 voxels, in steps of LAYER.
    """
    half, layer_height = np.float32(0.5), np.float32(LAYER)
    last_key, line = np.int64(-1), sums[0]
    for n in range(len(points)):
        key, offset, facing, largest = np.int64(0), np.float32(0), 0, np.float32(-1)
        for axis in range(3):
            position, normal = points[n, axis] / voxel, normals[n, axis]
            cell = np.floor(position)
            # Numbers that no integer holds are out of reach too, and must not be cast.
            if not abs(cell) < OUT_OF_REACH:
                return -1
            local = np.int64(cell) - base[axis]
            if local < 0 or local >= 1 << AXIS_BITS:
                return -1
            key = key << AXIS_BITS | local
            offset += (position - cell - half) * normal
            if abs(normal) > largest:
                largest, facing = abs(normal), 2 * axis + (normal > 0)
        layer = min(max(int(np.rint(offset / layer_height)) + _LAYERS // 2, 0), _LAYERS - 1)
        key = (key * _DIRECTIONS + facing) * _LAYERS + layer
        # Neighboring pixels mostly fall into one voxel.
        if key != last_key:
            slot = _slot_of(key, keys, slots)
            if slots[slot] < 0:
                slots[slot], keys[rows] = rows, key
                sums[rows] = 0.0
                rows += 1
            last_key, line = key, sums[slots[slot]]
        for axis in range(3):
            line[axis] += points[n, axis]
            line[3 + axis] += normals[n, axis]
            line[6 + axis] += colors[n, axis]
        line[9] += 1
    return rows


@kernel
@no_type_check
def _sum_rows(group_of, values, groups):
    """Sums of the rows of each group, in their order."""
    sums = np.zeros((groups, values.shape[1]))
    for row in range(len(values)):
        line = sums[group_of[row]]
        for column in range(len(line)):
            line[column] += values[row, column]
    return sums


def _surfaces(voxel_of: np.ndarray, sums: np.ndarray, voxel: float) -> np.ndarray:
    """A number for each row: one for all rows of a voxel whose normals and planes agree, directly or in a chain."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    points = sums[:, :3] / sums[:, 9:]
    normals = sums[:, 3:6] / np.linalg.norm(sums[:, 3:6], axis=1, keepdims=True)
    pairs = []
    step = 1
    while True:
        first = np.flatnonzero(voxel_of[step:] == voxel_of[:-step])
        if not first.size:
            break
        second = first + step
        both = normals[first] + normals[second]
        cos = np.einsum("ij,ij->i", normals[first], normals[second])
        gap = np.abs(np.einsum("ij,ij->i", points[first] - points[second], both))
        length = np.sqrt(np.maximum(2 + 2 * cos, 1e-12))
        same = (cos > SAME_SURFACE_COS) & (gap < SAME_SURFACE_OFFSET * voxel * length)
        pairs.append(np.stack([first[same], second[same]]))
        step += 1
    rows, columns = np.concatenate(pairs, axis=1) if pairs else np.zeros((2, 0), np.int64)
    graph = coo_matrix((np.ones(len(rows), np.int8), (rows, columns)), shape=(len(sums), len(sums)))
    _, label = connected_components(graph, directed=False)
    # Scipy does not promise an order of its labels: number the surfaces by their first row.
    _, first_row, inverse = np.unique(label, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first_row))[inverse]


LINEAR = 3.0  # A second difference of inverse depth within this many of its noise's standard deviations counts as zero
RELATIVE_FLOOR = 1e-3  # … and so does one below this share of the view's mean inverse depth
SMOOTHING_RADIUS = 2  # Half width in pixels of the window over which inverse depth is averaged
BETWEEN = 0.3
"""A pixel floats between two surfaces if the steps beyond its neighbors are below this share of those towards them."""
OCCLUSION = 0.01
"""A pixel lies behind its neighbor's outline if that is nearer by this share of its depth, 15 mm at 1.5 m."""

SMALLEST_DEPTH, LARGEST_DEPTH = 1e-9, 1e12  # Depths outside are taken for a wrong scale, world units


class SurfacePixels(NamedTuple):
    """What one depth image says about the surfaces in it."""

    depth: Float32[np.ndarray, "H W"]  # z after smoothing, world units
    normals: Float32[np.ndarray, "H W 3"]  # unit, camera axes, towards the camera
    use: Bool[np.ndarray, "H W"]  # pixels that lie on a surface


def surface_pixels(
    depth: Float32[np.ndarray, "H W"], K: Float32[np.ndarray, "3 3"], *, min_cos: float = 0.1
) -> SurfacePixels:
    """Smooths a depth image within its own noise, finds normals, and drops pixels that lie on no surface.

    Dropped are pixels without depth; pixels that lie between the two surfaces at a depth edge, since sensors mix both
    there; pixels just behind an outline, whose color is mixed with the nearer thing's; and surfaces seen at a slant
    beyond arccos(min_cos). The nearer side of an edge is kept: thin things consist of such pixels.
    """
    valid = depth > 0
    inverse = np.divide(1, depth, out=np.zeros_like(depth), where=valid)
    floor = RELATIVE_FLOOR * float(inverse.mean(where=valid)) if valid.any() else 0.0
    step = np.float32(max(LINEAR * _second_difference_noise(inverse, valid), floor))
    inverse = _smooth(inverse, valid, step)
    along_u, float_u = _gradient(inverse, valid, step)
    along_v, float_v = _gradient(inverse.T, valid.T, step)
    along_u, along_v = along_u * K[0, 0], along_v.T * K[1, 1]
    across, down = (pixel_centers(*size).astype(np.float32) for size in ((depth.shape[1], 1), (1, depth.shape[0])))
    columns, rows = (unproject_points(line, np.ones_like(line[..., 0]), K) for line in (across, down))
    ray_u, ray_v = columns[..., 0], rows[..., 1]  # x/z of each column [1, W], y/z of each row [H, 1]
    normals = np.stack([-along_u, -along_v, ray_u * along_u + ray_v * along_v - inverse], axis=-1)
    length = np.sqrt(np.einsum("ijk,ijk->ij", normals, normals))
    normals /= np.maximum(length, np.float32(1e-30))[..., None]
    ray_length = np.sqrt(ray_u * ray_u + ray_v * ray_v + 1)
    use = valid & ~float_u & ~float_v.T & (inverse > np.float32(min_cos) * length * ray_length)
    smooth = np.divide(1, inverse, out=np.zeros_like(depth), where=valid)
    return SurfacePixels(smooth, normals, use)


def depth_samples(views: Views, *, voxel: float) -> tuple[SurfaceSamples, list[str]]:
    """Surface samples of all RGB-D frames on a grid of `voxel` world units, and the names of views that gave none."""
    if not len(views):
        raise InputError("seeds: the scene has no views; seeds from depth need posed RGB-D frames")
    if views.depths is None:
        raise InputError("seeds: the scene has no depth images; use source=points or source=mesh")
    if views.images is None:
        raise InputError("seeds: the scene has depth but no images, and seeds take their color from the photographs")
    grid = SurfaceGrid(voxel, np.median(views.cameras.centers, axis=0))

    def samples_of(view: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        depth, image = read_rgbd(views, view)
        if views.masks is not None:
            depth = np.where(views.masks[view], depth, np.float32(0))
        pixels = surface_pixels(depth, views.cameras.Ks[view])
        centers = pixel_centers(depth.shape[1], depth.shape[0])[pixels.use].astype(np.float32)
        points = views.cameras.unproject(centers, pixels.depth[pixels.use], view)
        return points, views.cameras.rotate_to_world(pixels.normals[pixels.use], view), image[pixels.use]

    empty = []
    for name, samples in zip(views.names, ahead(samples_of, range(len(views))), strict=True):
        with error_prefix(f"view {name!r}"):
            grid.add(*samples)
        if not len(samples[0]):
            empty.append(name)
    return grid.samples(), empty


def read_rgbd(views: Views, view: int) -> tuple[Float32[np.ndarray, "H W"], UInt8[np.ndarray, "H W 3"]]:
    """Depth and image of one view."""
    assert views.depths is not None
    assert views.images is not None
    depth, image = views.depths[view], views.images[view]
    size = (int(views.cameras.heights[view]), int(views.cameras.widths[view]))
    for kind, array in (("depth", depth), ("image", image)):
        if array.shape[:2] != size:
            actual, expected = "×".join(map(str, array.shape[1::-1])), f"{size[1]}×{size[0]}"
            raise InputError(f"view {views.names[view]!r}: the {kind} is {actual}, but its camera says {expected}")
    bad = np.count_nonzero(~np.isfinite(depth) | (depth < 0))
    if bad:
        raise InputError(
            f"view {views.names[view]!r}: {bad} of {depth.size} depths are NaN, infinite or negative; 0 means none"
        )
    # Beyond this their inverses, and lengths in voxels, leave float32.
    far = np.count_nonzero((depth > 0) & ~((depth >= SMALLEST_DEPTH) & (depth <= LARGEST_DEPTH)))
    if far:
        raise InputError(
            f"view {views.names[view]!r}: {far} of {depth.size} depths lie outside {SMALLEST_DEPTH:g} to "
            f"{LARGEST_DEPTH:g} world units; check the depth scale"
        )
    return depth, image


def _second_difference_noise(inverse: np.ndarray, valid: np.ndarray) -> float:
    """Standard deviation of the noise in second differences of inverse depth along the rows.

    They vanish on planes but for noise, and the quartile ignores the edges. Rounding to millimetres is noise too, but
    most of its second differences are 0, which is why the median would not do.
    """
    inside = valid[:, :-2] & valid[:, 1:-1] & valid[:, 2:]
    second = np.abs(inverse[:, :-2] - 2 * inverse[:, 1:-1] + inverse[:, 2:])[inside]
    return float(np.quantile(second, 0.75)) / 1.1503 if second.size else 0.0


@kernel
@no_type_check
def _smooth(inverse, valid, step):
    """Mean over a window, taken in pairs of opposite pixels whose line passes the center within `step`."""
    height, width = inverse.shape
    result = np.empty_like(inverse)
    weight = np.empty(width, inverse.dtype)
    for y in range(height):
        total, center = result[y], inverse[y]
        total[:] = center
        weight[:] = 1
        for dy in range(min(SMOOTHING_RADIUS, y, height - 1 - y) + 1):
            for dx in range(-SMOOTHING_RADIUS if dy else 1, SMOOTHING_RADIUS + 1):
                left, inner = abs(dx), width - 2 * abs(dx)
                # Slices that start at 0 are added without a test of each index, eight pixels at a time.
                ahead, behind = inverse[y + dy, left + dx :], inverse[y - dy, left - dx :]
                valid_ahead, valid_behind = valid[y + dy, left + dx :], valid[y - dy, left - dx :]
                middle, sums, weights = center[left:], total[left:], weight[left:]
                for x in range(inner):
                    pair = ahead[x] + behind[x]
                    fits = valid_ahead[x] & valid_behind[x] & (abs(pair - (middle[x] + middle[x])) < step)
                    sums[x] += pair * fits
                    weights[x] += fits + fits
        for x in range(width):
            total[x] /= weight[x]
    return result


@kernel
@no_type_check
def _gradient(inverse, valid, step):
    """Gradient along the rows, [H, W], and the pixels that float between two surfaces or show next to a nearer one."""
    height, width = inverse.shape
    gradient, astray = np.zeros_like(inverse), np.zeros(inverse.shape, np.bool_)
    steps = np.zeros(width + 3, inverse.dtype)
    has_step = np.zeros(width + 3, np.bool_)
    occlusion, flatter = np.float32(OCCLUSION), np.float32(BETWEEN)
    for y in range(height):
        # Steps[x + 1] and steps[x + 2] lead to pixel x and on from it; there are none beyond the border.
        for x in range(1, width):
            has_step[x + 1] = valid[y, x] & valid[y, x - 1]
            steps[x + 1] = inverse[y, x] - inverse[y, x - 1] if has_step[x + 1] else 0
        for x in range(width):
            before, after = steps[x + 1], steps[x + 2]
            if not (has_step[x + 1] and has_step[x + 2]):
                gradient[y, x] = before if has_step[x + 1] else after
                continue
            smaller = min(abs(before), abs(after))
            steep = smaller > step
            if abs(after - before) < step:
                gradient[y, x] = (before + after) / 2
            elif not (steep and before * after < 0):
                gradient[y, x] = before if abs(before) < abs(after) else after
            # The surfaces that a floating pixel lies between go on next to it, less steep than the steps towards it.
            beyond = max(abs(steps[x]), abs(steps[x + 3]))
            between = steep and before * after > 0 and beyond < flatter * smaller
            # How much nearer the neighbor is, beyond what the pixel's own surface explains by its slope on the other
            # side.
            edge = max(step, occlusion * inverse[y, x])
            behind = max(after, -before) > edge + 3 * smaller or (after > edge and -before > edge)
            astray[y, x] = between or behind
    return gradient, astray


AXES_STEPS = 40


def fit_axes(normals: Float64[np.ndarray, "n 3"], axes: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, "3 3"]:
    """Orthonormal rows with a large Σ (n · axis)⁴, from a first guess. The sum is convex in the axes, so that the
    orthonormal matrix nearest to its gradient never has a smaller one."""
    for _ in range(AXES_STEPS):
        cosines = normals @ axes.T
        left, _, right = np.linalg.svd((cosines * cosines * cosines).T @ normals)
        axes = left @ right
    return axes


FRAME_VIEWS = 12  # Depth images that are looked at, evenly spaced
FRAME_SIDE = 240
"""Longer side in pixels of these depth images; of larger ones every second, third … row and column is taken."""
FRAME_NORMALS = 2000  # Normals of each that are used
FRAME_STARTS = 4  # Cameras whose axes the search begins at


def room_frame(views: Views) -> Float64[np.ndarray, "4 4"] | None:
    """frame_from_world, rigid: the axes lie along walls, floor and furniture, the origin is the mean of the cameras.

    None where no surface is seen, and without depth.

    A grid of cubes is the same whichever axis comes first and whichever way it points. Each is the one nearest to the
    world's, so that rows that are sorted by cells come in the world's order.
    """
    normals = np.empty((0, 3)) if views.depths is None else _normals(views.cameras, views.depths)
    if not len(normals):
        return None
    poses, center = views.cameras.cam_from_world.astype(np.float64), views.cameras.centers.mean(axis=0)
    fits = [fit_axes(normals, poses[view, :3, :3]) for view in even_indices(len(views), FRAME_STARTS)]
    axes = max(fits, key=lambda each: float(np.square(np.square(normals @ each.T)).sum()))
    frame = np.eye(4)
    frame[:3, :3] = _nearest_order(axes)
    frame[:3, 3] = -frame[:3, :3] @ center
    return frame


def _normals(cameras: Cameras, depths: Sequence[Float32[np.ndarray, "_ _"]]) -> Float64[np.ndarray, "n 3"]:
    """Unit normals in the world of the surfaces that some depth images show."""
    parts = [np.empty((0, 3))]
    for view in even_indices(len(depths), FRAME_VIEWS):
        depth = depths[int(view)]
        step = -(-max(depth.shape) // FRAME_SIDE)
        K = cameras.Ks[view] / np.array([[step], [step], [1]], np.float32)
        # Depth that cannot be is refused where all of it is read.
        with np.errstate(all="ignore"):
            pixels = surface_pixels(np.ascontiguousarray(depth[::step, ::step]), K)
        local = pixels.normals[pixels.use].astype(np.float64)
        local = local[np.isfinite(local).all(axis=1)]
        local = local[even_indices(len(local), FRAME_NORMALS)] if len(local) else local
        parts.append(local @ cameras.cam_from_world[view, :3, :3])
    return np.concatenate(parts)


def _nearest_order(axes: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, "3 3"]:
    """The same three lines as rows of a rotation, each as near to its axis of the world as can be."""
    order = max(permutations(range(3)), key=lambda rows: float(np.abs(axes[list(rows)].diagonal()).sum()))
    rotation = axes[list(order)]
    rotation *= np.where(rotation.diagonal() < 0, -1, 1)[:, None]
    rotation[np.abs(rotation.diagonal()).argmin()] *= np.sign(np.linalg.det(rotation))
    return rotation


LARGEST_SPACING = 4.0
"""Upper limit of a Gaussian's spacing in voxels, for surfaces that the frames sample more coarsely than the grid."""


def seed_from_depth(views: Views, *, voxel: float) -> Gaussians:
    """Flat Gaussians on the surfaces that RGB-D frames show, one for each surface in each voxel.

    Frames are read one at a time. Depth is smoothed within its own noise; pixels that float between two surfaces are
    dropped; samples are averaged by voxel (its edge in world units), facing and layer, so that thin objects keep their
    edges. The grid stands in a frame that turns and moves with the scene. The order of the views changes no more than
    rounding, unless there are more than those a frame is taken from.
    """
    frame = room_frame(views)
    world_from_frame = np.eye(4) if frame is None else invert_rigid(frame)
    if frame is not None:
        poses = views.cameras.cam_from_world.astype(np.float64) @ world_from_frame
        views = replace(views, cameras=replace(views.cameras, cam_from_world=poses.astype(np.float32)))
    samples, empty = depth_samples(views, voxel=voxel)
    if not len(samples.points):
        raise InputError(
            f"seeds: none of the {len(views)} depth images shows a surface; check the files and their scale"
        )
    if empty:
        warnings.warn(
            f"seeds: {len(empty)} of {len(views)} views have no usable depth (first: {empty[0]!r})",
            SceneWarning,
            stacklevel=2,
        )
    points, normals = samples.points, samples.normals
    if frame is not None:
        points = transform(world_from_frame, points).astype(np.float32)
        normals = (normals @ world_from_frame[:3, :3].T).astype(np.float32)
    return flat_gaussians(points, normals, samples.colors, largest=LARGEST_SPACING * voxel)
