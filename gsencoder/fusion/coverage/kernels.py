"""Numba kernels that follow single rays: where a few Gaussians are met, and what is left of the light there.

`render.blend_cpu` composites every ray of a view. A sample of Gaussians needs the few rays that meet it, and of all
other Gaussians those alone that such a ray may meet. Ellipses, thresholds and depth intervals are those of Blend.
"""

from typing import no_type_check

import numpy as np

from gsencoder.core.process import kernel
from gsencoder.geometry import ALPHA_MAX, ALPHA_MIN

TILE = 8
"""Rays along a side of the squares in which rays are looked up."""
ACROSS = 10
"""Of a Gaussian that is wider, about so many lines of rays are looked at."""


@kernel
@no_type_check
def count_rays(projected, index, depths, least, most, shape, counts):
    """How many rays meet each Gaussian within their rows' depths, into `counts`. Of a large Gaussian some rays are
    looked at, and stand for all."""
    height, width, side = shape
    last_x, last_y = float(width * side - 1), float(height * side - 1)
    for k in range(len(index)):
        g = index[k]
        u, v, hu, hv = projected[g, 0], projected[g, 1], projected[g, 2], projected[g, 3]
        a, b, c, r2 = projected[g, 4], projected[g, 5], projected[g, 6], projected[g, 7]
        x0, x1 = max(np.ceil(u - hu), 0.0), min(np.floor(u + hu), last_x)
        y0, y1 = max(np.ceil(v - hv), 0.0), min(np.floor(v + hv), last_y)
        if x0 > x1 or y0 > y1:
            continue
        step = max(1, int(max(x1 - x0, y1 - y0)) // ACROSS)
        count = 0
        for y in range(int(y0) + step // 2, int(y1) + 1, step):
            for x in range(int(x0) + step // 2, int(x1) + 1, step):
                dx, dy = x - u, y - v
                if a * dx * dx + 2 * b * dx * dy + c * dy * dy <= r2:
                    row = (y // side) * width + x // side
                    if depths[k] >= least[row] and depths[k] <= most[row]:
                        count += 1
        counts[g] = count * step * step


@kernel
@no_type_check
def list_rays(projected, index, depths, least, most, shape, counts, limit, rays, owners):
    """Lists up to `limit` of the rays of each Gaussian that `count_rays` counts, evenly spaced; returns their
    number."""
    height, width, side = shape
    last_x, last_y = float(width * side - 1), float(height * side - 1)
    total = 0
    for k in range(len(index)):
        g = index[k]
        if counts[g] == 0:
            continue
        u, v, hu, hv = projected[g, 0], projected[g, 1], projected[g, 2], projected[g, 3]
        a, b, c, r2 = projected[g, 4], projected[g, 5], projected[g, 6], projected[g, 7]
        x0, x1 = max(np.ceil(u - hu), 0.0), min(np.floor(u + hu), last_x)
        y0, y1 = max(np.ceil(v - hv), 0.0), min(np.floor(v + hv), last_y)
        step = max(1, int(max(x1 - x0, y1 - y0)) // ACROSS)
        candidates = counts[g] // (step * step)
        sample_size = min(limit, candidates)
        number, sampled = 0, 0
        for y in range(int(y0) + step // 2, int(y1) + 1, step):
            for x in range(int(x0) + step // 2, int(x1) + 1, step):
                dx, dy = x - u, y - v
                if a * dx * dx + 2 * b * dx * dy + c * dy * dy > r2:
                    continue
                row = (y // side) * width + x // side
                if depths[k] < least[row] or depths[k] > most[row]:
                    continue
                # The middle of each of `sample_size` equal parts of the list.
                if sampled < sample_size and number == ((2 * sampled + 1) * candidates) // (2 * sample_size):
                    rays[total], owners[total] = y * (width * side) + x, g
                    total += 1
                    sampled += 1
                number += 1
    return total


@kernel
@no_type_check
def near_rays(centers, reaches, slack, parts, pose, K, near, lattice, ends, shape, out):
    """The balls that may touch a square of rays, of the ranges [first, last) of `parts`, into `out`; returns their
    number. `ends` are the depths behind which the rays of each square meet nothing; a ball lies up to slack · its reach
    before its center."""
    x0, y0, dx, dy = lattice
    count_x, count_y = shape
    fx, fy, cx, cy = K[0, 0] / dx, K[1, 1] / dy, (K[0, 2] - x0) / dx, (K[1, 2] - y0) / dy
    deepest = ends.max()
    count = 0
    for part in range(len(parts)):
        for row in range(parts[part, 0], parts[part, 1]):
            mx, my, mz = np.float64(centers[row, 0]), np.float64(centers[row, 1]), np.float64(centers[row, 2])
            z = pose[2, 0] * mx + pose[2, 1] * my + pose[2, 2] * mz + pose[2, 3]
            front = z - slack * reaches[row]
            if not z > near or front > deepest:
                continue
            inverse = 1 / z
            x = (pose[0, 0] * mx + pose[0, 1] * my + pose[0, 2] * mz + pose[0, 3]) * inverse
            y = (pose[1, 0] * mx + pose[1, 1] * my + pose[1, 2] * mz + pose[1, 3]) * inverse
            # A ball seen at a slant is drawn out by the perspective; 1 + x² + y² bounds that.
            reach = reaches[row] * inverse * (1.0 + x * x + y * y)
            u, v, reach_x, reach_y = fx * x + cx, fy * y + cy, fx * reach + 2.0 / dx, fy * reach + 2.0 / dy
            left, right = (u - reach_x) / TILE, (u + reach_x) / TILE
            top, bottom = (v - reach_y) / TILE, (v + reach_y) / TILE
            if right < 0 or bottom < 0 or left >= count_x or top >= count_y:
                continue
            first, last = int(max(left, 0.0)), int(min(right, count_x - 1.0))
            hit = False
            for ty in range(int(max(top, 0.0)), int(min(bottom, count_y - 1.0)) + 1):
                for tx in range(first, last + 1):
                    if ends[ty * count_x + tx] >= front:
                        hit = True
                        break
                if hit:
                    break
            if hit:
                out[count] = row
                count += 1
    return count


@kernel
@no_type_check
def follow_rays(
    order, index, depths, projected, rows, starts, rays, owners, least, most, shape, stop, weights, remains
):
    """Front-to-back compositing of single rays, sorted by square: what its owner gets from each ray (`weights`), and
    the transmittance behind it (`remains`, 0 where the ray ends before)."""
    height, width, side = shape
    line = width * side
    count_x, count_y = (line + TILE - 1) // TILE, (height * side + TILE - 1) // TILE
    transmittance = np.ones(len(rays))
    for k in order:
        g = index[k]
        z = depths[k]
        u, v, hu, hv = projected[g, 0], projected[g, 1], projected[g, 2], projected[g, 3]
        a, b, c, r2, opacity = projected[g, 4], projected[g, 5], projected[g, 6], projected[g, 7], projected[g, 8]
        left, right = max(np.floor((u - hu) / TILE), 0.0), min(np.floor((u + hu) / TILE), count_x - 1.0)
        top, bottom = max(np.floor((v - hv) / TILE), 0.0), min(np.floor((v + hv) / TILE), count_y - 1.0)
        if left > right or top > bottom:
            continue
        for ty in range(int(top), int(bottom) + 1):
            for tx in range(int(left), int(right) + 1):
                tile = ty * count_x + tx
                for r in range(starts[tile], starts[tile + 1]):
                    before = transmittance[r]
                    if before < 0:
                        continue
                    x, y = rays[r] % line, rays[r] // line
                    dx, dy = x - u, y - v
                    q = a * dx * dx + 2 * b * dx * dy + c * dy * dy
                    if q > r2:
                        continue
                    alpha = min(opacity * np.exp(-0.5 * q), ALPHA_MAX)
                    if alpha < ALPHA_MIN:
                        continue
                    after = before * (1.0 - alpha)
                    row = (y // side) * width + x // side
                    if after <= stop or z > most[row]:
                        transmittance[r] = -1.0
                        continue
                    transmittance[r] = after
                    if rows[g] == owners[r] and z >= least[row]:
                        weights[r], remains[r] = alpha * before, after
