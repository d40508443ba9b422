"""Blending weights on a CPU: numba kernels that project, bin, composite and multiply; and the rays of the rows of B.

Pixel rows are the lattice of pixel centers with one ray a row. Patch rows put `side × side` rays into each cell of a
coarser grid (a teacher's patch grid, seen through its resize and crop), at the centers of equal sub-cells: a fixed
stratified pattern, so that the same scene gives the same numbers on every run.
"""

import math
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64

from gsencoder.core.errors import InputError
from gsencoder.core.threads import PIECES, kernel, parallel
from gsencoder.geometry import ALPHA_MAX, ALPHA_MIN
from gsencoder.types import Gaussians


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


_ENTRIES = 48
"""Room for this many entries a row is set aside; memory that is not touched costs nothing."""

_SCRATCH_KEPT = 1 << 24
"""Rooms of up to this many entries (200 MB) are kept for the next call."""


@kernel
@no_type_check
def _project(first, last, means, quats, scales, opacities, pose, K, size, eps2d, near, lattice, out, index, depths):
    """geometry.project of rows [first, last) in one pass; valid ones are listed from index[first] on, with depths."""
    x0, y0, dx, dy = lattice
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    width, height = size
    slack_x, slack_y = 0.15 * width / fx, 0.15 * height / fy
    row_x, row_y = np.empty(3), np.empty(3)
    count = 0
    for i in range(first, last):
        mx, my, mz = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
        z = pose[2, 0] * mx + pose[2, 1] * my + pose[2, 2] * mz + pose[2, 3]
        opacity = np.float64(opacities[i])
        if not z > near or not opacity > ALPHA_MIN:
            continue
        x = pose[0, 0] * mx + pose[0, 1] * my + pose[0, 2] * mz + pose[0, 3]
        y = pose[1, 0] * mx + pose[1, 1] * my + pose[1, 2] * mz + pose[1, 3]
        tx = min(max(x / z, -(cx / fx + slack_x)), (width - cx) / fx + slack_x)
        ty = min(max(y / z, -(cy / fy + slack_y)), (height - cy) / fy + slack_y)
        w, qx = np.float64(quats[i, 0]), np.float64(quats[i, 1])
        qy, qz = np.float64(quats[i, 2]), np.float64(quats[i, 3])
        n = 1.0 / math.sqrt(w * w + qx * qx + qy * qy + qz * qz + 1e-36)
        w, qx, qy, qz = w * n, qx * n, qy * n, qz * n
        for k in range(3):
            if k == 0:
                c0, c1, c2 = 1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy + w * qz), 2 * (qx * qz - w * qy)
            elif k == 1:
                c0, c1, c2 = 2 * (qx * qy - w * qz), 1 - 2 * (qx * qx + qz * qz), 2 * (qy * qz + w * qx)
            else:
                c0, c1, c2 = 2 * (qx * qz + w * qy), 2 * (qy * qz - w * qx), 1 - 2 * (qx * qx + qy * qy)
            s = np.float64(scales[i, k])
            h2 = s * (pose[2, 0] * c0 + pose[2, 1] * c1 + pose[2, 2] * c2)
            row_x[k] = fx / z * (s * (pose[0, 0] * c0 + pose[0, 1] * c1 + pose[0, 2] * c2) - tx * h2)
            row_y[k] = fy / z * (s * (pose[1, 0] * c0 + pose[1, 1] * c1 + pose[1, 2] * c2) - ty * h2)
        xx = row_x[0] ** 2 + row_x[1] ** 2 + row_x[2] ** 2
        yy = row_y[0] ** 2 + row_y[1] ** 2 + row_y[2] ** 2
        xy = row_x[0] * row_y[0] + row_x[1] * row_y[1] + row_x[2] * row_y[2]
        d0 = row_x[1] * row_y[2] - row_x[2] * row_y[1]
        d1 = row_x[2] * row_y[0] - row_x[0] * row_y[2]
        d2 = row_x[0] * row_y[1] - row_x[1] * row_y[0]
        det = d0 * d0 + d1 * d1 + d2 * d2 + eps2d * (xx + yy) + eps2d * eps2d
        r2 = 2 * math.log(opacity / ALPHA_MIN)
        u, v = fx * x / z + cx, fy * y / z + cy
        hu, hv = math.sqrt(r2 * (xx + eps2d)), math.sqrt(r2 * (yy + eps2d))
        if not (u + hu > 0 and u - hu < width and v + hv > 0 and v - hv < height):
            continue
        at = first + count
        out[i, 0], out[i, 1], out[i, 2], out[i, 3] = (u - x0) / dx, (v - y0) / dy, hu / dx, hv / dy
        out[i, 4], out[i, 6] = (yy + eps2d) / det * (dx * dx), (xx + eps2d) / det * (dy * dy)
        out[i, 5], out[i, 7], out[i, 8] = -xy / det * (dx * dy), r2, opacity
        index[at], depths[at] = i, z
        count += 1
    return count


def project(
    gaussians: Gaussians,
    pose: np.ndarray,
    K: np.ndarray,
    width: int,
    height: int,
    lattice: Lattice,
    *,
    eps2d: float,
    near: float,
) -> tuple[Float64[np.ndarray, "N 9"], Int32[np.ndarray, " M"], Float64[np.ndarray, " M"]]:
    """geometry.project for the M Gaussians that touch the image, in float64 without temporaries.

    Returns:
        u, v, half width, half height, conic a, b, c, squared radius, opacity in units of the lattice, where rays lie on
        whole numbers; the Gaussians that touch the image, ascending, whose rows alone are filled; and their depths.
    """
    n = len(gaussians.means)
    out, index, depths = np.empty((n, 9)), np.empty(n, np.int32), np.empty(n)
    cuts = np.linspace(0, n, PIECES + 1).astype(np.int64)
    pose, K = pose.astype(np.float64), K.astype(np.float64)
    arrays = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities)
    rays = (lattice.x0, lattice.y0, lattice.dx, lattice.dy)

    def work(piece: int) -> int:
        bounds, size = (cuts[piece], cuts[piece + 1]), (float(width), float(height))
        return _project(*bounds, *arrays, pose, K, size, eps2d, near, rays, out, index, depths)

    counts = parallel(work, range(PIECES))
    keep = [slice(start, start + count) for start, count in zip(cuts[:-1], counts, strict=True)]
    return out, np.concatenate([index[part] for part in keep]), np.concatenate([depths[part] for part in keep])


@kernel
@no_type_check
def bin_tiles(splats, index, order, tile, tiles_x, tiles_y, offset, last_u, last_v):
    """Counting sort of (tile, splat) pairs that keeps the depth order within a tile.

    Ray i is at i + offset. Splats (u, v, half width, half height, …) are rows `index`, front to back in `order`.

    Returns:
        The first entry of each tile in `members`, and the number of all; the splats of each tile; the first entry of
        each splat in `entries`, and the number of all; where in `members` each splat stands.
    """
    n = len(order)
    bounds = np.empty((n, 4), np.int32)
    starts = np.zeros(tiles_x * tiles_y + 1, np.int64)
    owners = np.zeros(n + 1, np.int64)
    for k in range(n):
        line = splats[index[k]]
        u, v, hu, hv = line[0], line[1], line[2], line[3]
        # Bounds are clipped as floats: a splat far outside the image overflows an integer.
        u0, u1 = max(np.ceil(u - hu - offset), 0.0), min(np.floor(u + hu - offset), last_u)
        v0, v1 = max(np.ceil(v - hv - offset), 0.0), min(np.floor(v + hv - offset), last_v)
        if not (u0 <= u1 and v0 <= v1):
            bounds[k, 0], bounds[k, 1], bounds[k, 2], bounds[k, 3] = 0, -1, 0, -1
            continue
        bounds[k, 0], bounds[k, 1] = int(u0) // tile, int(u1) // tile
        bounds[k, 2], bounds[k, 3] = int(v0) // tile, int(v1) // tile
        owners[k + 1] = (bounds[k, 1] - bounds[k, 0] + 1) * (bounds[k, 3] - bounds[k, 2] + 1)
        for ty in range(bounds[k, 2], bounds[k, 3] + 1):
            for tx in range(bounds[k, 0], bounds[k, 1] + 1):
                starts[ty * tiles_x + tx + 1] += 1
    for t in range(tiles_x * tiles_y):
        starts[t + 1] += starts[t]
    for k in range(n):
        owners[k + 1] += owners[k]
    where = starts[:-1].copy()
    members, entries = np.empty(starts[-1], np.int32), np.empty(starts[-1], np.int64)
    for k in order:
        at = owners[k]
        for ty in range(bounds[k, 2], bounds[k, 3] + 1):
            for tx in range(bounds[k, 0], bounds[k, 1] + 1):
                t = ty * tiles_x + tx
                members[where[t]] = index[k]
                entries[at] = where[t]
                where[t] += 1
                at += 1
    return starts, members, owners, entries


@kernel
@no_type_check
def _blend_tiles(
    first, last, starts, members, gaussians, depths, least, most, shape, stop, keep, counts, rows, cols, weights
):
    """Front-to-back compositing of tiles [first, last): entries (row, Gaussian, weight), depth-ordered in a row, and
    the number of entries of each row. Entries nearer than `least` of their row are composited but not stored, and a ray
    ends behind `most` of its row.

    Gaussians are the outer loop, so that one that several rays of a patch meet becomes a single entry at once. Along
    a line of rays exp(−quadratic) is a product of two geometric sequences: g(u+1) = g(u)·r(u), r(u+1) = r(u)·q.
    """
    height, width, side, tile, tiles_x = shape
    cells = tile // side
    cell_of = np.arange(tile) // side
    count = 0
    transmittance = np.empty((tile, tile), np.float64)
    # The first and the last open ray of each line: a Gaussian that only meets others there is passed over.
    open_from, open_to = np.empty(tile, np.int64), np.empty(tile, np.int64)
    sums = np.zeros(cells, np.float64)
    share = 1.0 / (side * side)
    for t in range(first, last):
        tile_u, tile_v = (t % tiles_x) * tile, (t // tiles_x) * tile
        end_u, end_v = min(tile, width * side - tile_u), min(tile, height * side - tile_v)
        transmittance[:] = 1.0
        tile_most = np.float32(-np.inf)
        for cj in range(end_v // side):
            for ci in range(end_u // side):
                tile_most = max(tile_most, most[(tile_v // side + cj) * width + tile_u // side + ci])
        open_from[:], open_to[:] = 0, end_u - 1
        open_rays = end_u * end_v
        for m in range(starts[t], starts[t + 1]):
            # Entries of one Gaussian in one tile are at most its cells: room is checked here, not at each of them.
            if count + cells * cells > len(rows):
                more = np.empty(len(rows) + 1024, np.int32)
                rows, cols = np.concatenate((rows, more)), np.concatenate((cols, more))
                weights = np.concatenate((weights, np.empty(len(more), np.float32)))
            g = members[m]
            z = depths[g]
            if z > tile_most:
                break
            gu, gv, half_height = gaussians[g, 0] - tile_u, gaussians[g, 1] - tile_v, gaussians[g, 3]
            a, b, c = gaussians[g, 4], gaussians[g, 5], gaussians[g, 6]
            limit, opacity = gaussians[g, 7], gaussians[g, 8]
            f0, f1 = max(np.ceil(gv - half_height), 0.0), min(np.floor(gv + half_height), float(end_v - 1))
            if f0 > f1:
                continue
            v0, v1 = int(f0), int(f1)
            inv_a, q = 1.0 / a, math.exp(-a)
            for cj in range(cell_of[v0], cell_of[v1] + 1):
                row = (tile_v // side + cj) * width + tile_u // side
                low_u, high_u = tile, -1
                for j in range(max(v0, cj * side), min(v1, cj * side + side - 1) + 1):
                    if open_from[j] > open_to[j]:
                        continue
                    dv = j - gv
                    root = b * b * dv * dv - a * (c * dv * dv - limit)
                    if root < 0:
                        continue
                    half, middle = math.sqrt(root) * inv_a, gu - b * dv * inv_a
                    f0, f1 = max(np.ceil(middle - half), 0.0), min(np.floor(middle + half), float(open_to[j]))
                    if f1 < max(f0, float(open_from[j])):
                        continue
                    u0, u1 = int(f0), int(f1)
                    du = u0 - gu
                    value = opacity * math.exp(-0.5 * (a * du * du + c * dv * dv) - b * du * dv)
                    ratio = math.exp(-a * (du + 0.5) - b * dv) if u1 > u0 else 0.0
                    low_u, high_u = min(low_u, u0), max(high_u, u1)
                    row_transmittance = transmittance[j]
                    open_before = open_rays
                    for i in range(u0, u1 + 1):
                        alpha = min(value, ALPHA_MAX)
                        value *= ratio
                        ratio *= q
                        before = row_transmittance[i]
                        # A negative transmittance marks a ray that has stopped.
                        if alpha < ALPHA_MIN or before < 0:
                            continue
                        after = before * (1.0 - alpha)
                        if after <= stop or z > most[row + cell_of[i]]:
                            row_transmittance[i] = -1.0
                            open_rays -= 1
                            continue
                        row_transmittance[i] = after
                        sums[cell_of[i]] += alpha * before
                    if open_rays < open_before:
                        while open_from[j] <= open_to[j] and row_transmittance[open_from[j]] < 0:
                            open_from[j] += 1
                        while open_from[j] <= open_to[j] and row_transmittance[open_to[j]] < 0:
                            open_to[j] -= 1
                if high_u < 0:
                    continue
                for ci in range(cell_of[low_u], cell_of[high_u] + 1):
                    weight = sums[ci] * share
                    sums[ci] = 0.0
                    if weight > 0 and weight >= keep and z >= least[row + ci]:
                        rows[count] = row + ci
                        cols[count] = g
                        weights[count] = weight
                        counts[row + ci] += 1
                        count += 1
            if open_rays == 0:
                break
    return rows[:count], cols[:count], weights[:count]


_free_scratch: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []


def _take_scratch(entries: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Room for entries, used again from call to call: filling fresh pages costs more than the compositing.

    Taking from the list and giving back are each one step, so that concurrent callers never share a room; what does
    not fit grows inside the kernel.
    """
    try:
        scratch = _free_scratch.pop()
    except IndexError:
        scratch = None
    if scratch is None or len(scratch[0]) < entries:
        return np.empty(entries, np.int32), np.empty(entries, np.int32), np.empty(entries, np.float32)
    return scratch


@kernel
@no_type_check
def _scatter(rows, cols, weights, where, out_cols, out_weights):
    for e in range(len(rows)):
        at = where[rows[e]]
        where[rows[e]] = at + 1
        out_cols[at] = cols[e]
        out_weights[at] = weights[e]


def _stable_order(depths: Float64[np.ndarray, " M"]) -> Int64[np.ndarray, " M"]:
    """A stable argsort: numpy's unstable one is four times as fast, and then the few equal depths are put in order."""
    order = np.argsort(depths)
    same = np.diff(depths[order]) == 0
    tied = np.flatnonzero(np.append(same, False) | np.append(False, same))
    rows = np.sort(order[tied])
    order[tied] = rows[np.argsort(depths[rows], kind="stable")]
    return order


def even_cuts(starts: Int64[np.ndarray, " n_plus_1"]) -> Int64[np.ndarray, " pieces_plus_1"]:
    """Cuts the rows of a compressed array into pieces with about equally many entries."""
    inner = np.searchsorted(starts, np.linspace(0, starts[-1], PIECES + 1)[1:-1])
    return np.concatenate(([0], inner, [len(starts) - 1]))


def blend_weights(
    gaussians: Gaussians,
    pose: np.ndarray,
    K: np.ndarray,
    size: tuple[int, int],
    lattice: Lattice,
    between: tuple[Float32[np.ndarray, " P"], Float32[np.ndarray, " P"]],
    *,
    eps2d: float,
    near: float,
    stop: float,
    keep: float,
) -> tuple[
    Int64[np.ndarray, " P_plus_1"], Int32[np.ndarray, " nnz"], Float32[np.ndarray, " nnz"], Float32[np.ndarray, " N"]
]:
    """CSR (crow, col, weight) of B, and the depths of all Gaussians, 0 for those that do not touch the image.

    Args:
        size: width and height of the image, pixels.
        between: smallest and largest depth of the entries that each row stores.
    """
    projected, index, z = project(gaussians, pose, K, *size, lattice, eps2d=eps2d, near=near)
    depths = np.zeros(len(projected), np.float32)
    depths[index] = z
    tile = lattice.tile
    tiles_x, tiles_y = -(-lattice.width * lattice.side // tile), -(-lattice.height * lattice.side // tile)
    last_u, last_v = float(tiles_x * tile - 1), float(tiles_y * tile - 1)
    starts, members, _, _ = bin_tiles(projected, index, _stable_order(z), tile, tiles_x, tiles_y, 0.0, last_u, last_v)
    shape = (lattice.height, lattice.width, lattice.side, tile, tiles_x)
    cuts = even_cuts(starts)
    room = np.concatenate(([0], np.cumsum(_ENTRIES * (tile // lattice.side) ** 2 * np.diff(cuts))))
    scratch = _take_scratch(int(room[-1]))
    crow = np.zeros(len(between[0]) + 1, np.int64)

    def work(piece: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        space = (part[room[piece] : room[piece + 1]] for part in scratch)
        ranges, tiles = (cuts[piece], cuts[piece + 1]), (starts, members, projected)
        return _blend_tiles(*ranges, *tiles, depths, *between, shape, stop, keep, crow[1:], *space)

    # A row belongs to one tile, a tile to one piece: the pieces write to disjoint places.
    pieces = parallel(work, range(PIECES))
    np.cumsum(crow, out=crow)
    where = crow[:-1].copy()
    cols, weights = np.empty(crow[-1], np.int32), np.empty(crow[-1], np.float32)
    parallel(lambda piece: _scatter(*pieces[piece], where, cols, weights), range(PIECES))
    if len(scratch[0]) <= _SCRATCH_KEPT:
        _free_scratch.append(scratch)
    return crow, cols, weights, depths


@kernel
@no_type_check
def _transpose(crow, cols, weights, where, out_rows, out_weights):
    for row in range(len(crow) - 1):
        for e in range(crow[row], crow[row + 1]):
            at = where[cols[e]]
            where[cols[e]] = at + 1
            out_rows[at] = row
            out_weights[at] = weights[e]


def transpose(
    crow: np.ndarray, cols: np.ndarray, weights: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The columns that occur, and Bᵀ restricted to them as CSR: (columns, crow, row, weight)."""
    uses = np.bincount(cols, minlength=count)
    ends = np.cumsum(uses)
    out_rows, out_weights = np.empty(len(cols), np.int32), np.empty(len(cols), weights.dtype)
    _transpose(crow, cols, weights, ends - uses, out_rows, out_weights)
    columns = np.flatnonzero(uses)
    return columns, np.concatenate(([0], ends[columns])), out_rows, out_weights


@kernel
@no_type_check
def _product(first, last, crow, cols, weights, values, targets, out):
    for row in range(first, last):
        line = out[targets[row]]
        e, end = crow[row], crow[row + 1]
        # Four entries at a time: the line is read and written once for four sources, which is what limits the speed.
        while e + 4 <= end:
            w0, w1, w2, w3 = weights[e], weights[e + 1], weights[e + 2], weights[e + 3]
            s0, s1, s2, s3 = values[cols[e]], values[cols[e + 1]], values[cols[e + 2]], values[cols[e + 3]]
            for d in range(len(line)):
                line[d] = (((line[d] + w0 * s0[d]) + w1 * s1[d]) + w2 * s2[d]) + w3 * s3[d]
            e += 4
        while e < end:
            weight, source = weights[e], values[cols[e]]
            for d in range(len(line)):
                line[d] += weight * source[d]
            e += 1


@kernel
@no_type_check
def _product_of_one_channel(first, last, crow, cols, weights, values, targets, out):
    for row in range(first, last):
        total = out[targets[row], 0]
        for e in range(crow[row], crow[row + 1]):
            total += weights[e] * values[cols[e], 0]
        out[targets[row], 0] = total


def product(
    crow: np.ndarray, cols: np.ndarray, weights: np.ndarray, values: np.ndarray, targets: np.ndarray, out: np.ndarray
) -> None:
    """Adds row i of CSR @ values to out[targets[i]]; targets are distinct, so that threads never meet."""
    cuts = even_cuts(crow)
    run = _product_of_one_channel if values.shape[1] == 1 else _product
    if values.shape[1] * crow[-1] < 1 << 16:
        run(0, len(crow) - 1, crow, cols, weights, values, targets, out)
        return
    parallel(
        lambda piece: run(cuts[piece], cuts[piece + 1], crow, cols, weights, values, targets, out),
        range(PIECES),
    )


@kernel
@no_type_check
def add_codes(crow, cols, weights, codes, out):
    """Adds the weight of each entry to out[column, code of its row]: the transposed product with one_hot(codes), in the
    order of rows, without the transposed matrix. On one thread: so it takes a third of the time of transposing alone.
    """
    for row in range(len(crow) - 1):
        code = codes[row]
        if code >= 0:
            for e in range(crow[row], crow[row + 1]):
                out[cols[e], code] += weights[e]


@kernel
@no_type_check
def _count_between(first, last, crow, cols, depths, least, most, counts):
    for row in range(first, last):
        count = 0
        for e in range(crow[row], crow[row + 1]):
            z = depths[cols[e]]
            count += (z >= least[row]) & (z <= most[row])
        counts[row] = count


@kernel
@no_type_check
def _copy_between(first, last, crow, cols, weights, depths, least, most, starts, out_cols, out_weights):
    for row in range(first, last):
        at = starts[row]
        for e in range(crow[row], crow[row + 1]):
            z = depths[cols[e]]
            if z >= least[row] and z <= most[row]:
                out_cols[at] = cols[e]
                out_weights[at] = weights[e]
                at += 1


def keep_between(
    crow: np.ndarray, cols: np.ndarray, weights: np.ndarray, depths: np.ndarray, least: np.ndarray, most: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """CSR with only the entries whose column's depth lies from least[row] to most[row]: (crow, cols, weights)."""
    cuts = even_cuts(crow)
    starts = np.zeros(len(crow), np.int64)
    parallel(
        lambda piece: _count_between(cuts[piece], cuts[piece + 1], crow, cols, depths, least, most, starts[1:]),
        range(PIECES),
    )
    np.cumsum(starts, out=starts)
    out_cols, out_weights = np.empty(starts[-1], cols.dtype), np.empty(starts[-1], weights.dtype)
    parallel(
        lambda piece: _copy_between(
            cuts[piece], cuts[piece + 1], crow, cols, weights, depths, least, most, starts, out_cols, out_weights
        ),
        range(PIECES),
    )
    return starts, out_cols, out_weights
