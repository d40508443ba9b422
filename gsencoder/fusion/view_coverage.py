"""Gaussians in blocks of space, so that those that rays may meet are looked for where a view shows anything at all.

Numba kernels that follow single rays: where a few Gaussians are met, and what is left of the light there.

`render.blend_cpu` composites every ray of a view. A sample of Gaussians needs the few rays that meet it, and of all
other Gaussians those alone that such a ray may meet. Ellipses, thresholds and depth intervals are those of Blend.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import no_type_check

import numpy as np
from jaxtyping import Float32, Int32, Int64

from gsencoder.core.threads import kernel, parallel
from gsencoder.fusion.lift import VisibilityConfig, depth_interval, row_mask
from gsencoder.geometry import ALPHA_MAX, ALPHA_MIN
from gsencoder.render import BlendConfig
from gsencoder.render import blend_cpu as cpu
from gsencoder.render.rays import Lattice, pixel_lattice
from gsencoder.types import Cameras, Gaussians, Views

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


BLOCKS, PARTS = 24, 2
"""Blocks along each axis, and parts of a block along each axis."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ShapeRows:
    """Gaussians without colors, as `Gaussians` has them; rows of checked ones are not checked again."""

    means: Float32[np.ndarray, "N 3"]
    quats: Float32[np.ndarray, "N 4"]
    scales: Float32[np.ndarray, "N 3"]
    opacities: Float32[np.ndarray, " N"]

    @classmethod
    def of(cls, gaussians: Gaussians, rows: Int64[np.ndarray, " n"]) -> "ShapeRows":
        return cls(
            means=gaussians.means[rows],
            quats=gaussians.quats[rows],
            scales=gaussians.scales[rows],
            opacities=gaussians.opacities[rows],
        )

    def __len__(self) -> int:
        return len(self.means)


class Blocks:
    """Gaussians sorted by the block of space that their means lie in.

    Attributes:
        gaussians: all of them, in the order in which they came.
    """

    def __init__(self, gaussians: Gaussians) -> None:
        self.gaussians = gaussians
        # The opacity falls to ALPHA_MIN at this many standard deviations from the center.
        largest = math.sqrt(2 * math.log(max(float(gaussians.opacities.max(initial=0)) / ALPHA_MIN, 1)))
        reaches = largest * gaussians.scales.max(axis=1)
        means = gaussians.means
        # Most means lie between these quantiles; the others count to the blocks at the border.
        some = means[:: max(1, len(means) // 10_000)]
        low, high = np.quantile(some, (0.01, 0.99), axis=0).astype(np.float32)
        fine = BLOCKS * PARTS
        cell = np.clip((means - low) * (fine / np.maximum(high - low, 1e-12)), 0, fine - 1).astype(np.int32)
        block, part = np.divmod(cell, PARTS)
        codes = ((block[:, 0] * BLOCKS + block[:, 1]) * BLOCKS + block[:, 2]) * PARTS**3
        codes += (part[:, 0] * PARTS + part[:, 1]) * PARTS + part[:, 2]
        self._order = np.argsort(codes, kind="stable")
        codes = codes[self._order]
        self._block_starts = _starts(codes // PARTS**3)
        self._block_of = np.empty(len(means), np.int32)
        self._block_of[self._order] = np.repeat(np.arange(len(self._block_starts) - 1), np.diff(self._block_starts))
        self._starts = _starts(codes)
        self._means, self._reaches = means[self._order], reaches[self._order]
        first = np.minimum.reduceat(self._means, self._starts[:-1], axis=0).astype(np.float64)
        last = np.maximum.reduceat(self._means, self._starts[:-1], axis=0).astype(np.float64)
        reach = np.maximum.reduceat(self._reaches, self._starts[:-1])
        self._centers, self._radii = (first + last) / 2, np.linalg.norm(last - first, axis=1) / 2 + reach

    def near(
        self,
        cameras: Cameras,
        view: int,
        lattice: Lattice,
        ends: Float32[np.ndarray, " squares"],
        shape: tuple[int, int],
        near: float,
    ) -> Int64[np.ndarray, " n"]:
        """The rows of Gaussians that may touch a square of rays, ascending.

        Args:
            cameras: of the views.
            view: which of them.
            lattice: of its rays.
            ends: for each square, `kernels.TILE` rays along a side, the depth behind which its rays meet nothing; −inf
                where it has none.
            shape: number of squares in a line, and of lines.
            near: near plane, world units.
        """
        pose, K = cameras.cam_from_world[view].astype(np.float64), cameras.Ks[view].astype(np.float64)
        rays = (lattice.x0, lattice.y0, lattice.dx, lattice.dy)
        z = self._centers @ pose[2, :3] + pose[2, 3]
        # The ball of a block that reaches behind the camera has no bounds in the picture.
        ahead, around = np.flatnonzero(z > 2 * self._radii + near), np.flatnonzero(np.abs(z) <= 2 * self._radii + near)
        settings = (pose, K, near, rays, ends, shape)
        out = np.empty(len(ahead), np.int64)
        each = np.stack([ahead, ahead + 1], axis=1)
        count = near_rays(self._centers, 2 * self._radii, 1.0, each, *settings, out)
        blocks = np.concatenate([around, out[:count]])
        parts = np.stack([self._starts[blocks], self._starts[blocks + 1]], axis=1)
        out = np.empty(int((parts[:, 1] - parts[:, 0]).sum()), np.int64)
        count = near_rays(self._means, self._reaches, 0.0, parts, *settings, out)
        return np.sort(self._order[out[:count]])

    def around(self, row: int, count: int) -> Int64[np.ndarray, " n"]:
        """Up to so many Gaussians of the block of a Gaussian: those nearest to it, itself among them."""
        block = self._block_of[row]
        rows = self._order[self._block_starts[block] : self._block_starts[block + 1]]
        distances = np.square(self.gaussians.means[rows] - self.gaussians.means[row]).sum(axis=1)
        return rows[np.argsort(distances, kind="stable")[:count]]


def _starts(codes: Int32[np.ndarray, " N"]) -> Int64[np.ndarray, " starts"]:
    """Where runs of equal codes begin, and where the last one ends."""
    return np.concatenate(([0], np.flatnonzero(np.diff(codes)) + 1, [len(codes)]))


def view_order(
    weights: Float32[np.ndarray, "V n"], singles: int, scatter: float, first: Sequence[int] = ()
) -> Int64[np.ndarray, " V"]:
    """All views, each the one that lowers the predicted error most once those before it are taken.

    Args:
        weights: of the exact settings.
        singles: how many Gaussians at first are single ones; those and the groups count as much as each other.
        scatter: ρ.
        first: views that are taken before any other.
    """
    n = weights.shape[1]
    importance = np.full(n, 1 / max(singles, 1))
    importance[singles:] = 1 / max(n - singles, 1)
    return np.asarray(_greedy(weights, importance, scatter, np.asarray(first, np.int64)))


@kernel
@no_type_check
def _gain(w, importance, scatter, all_sum, all_squares, chosen_sum, chosen_squares):
    gain = 0.0
    for g in range(len(w)):
        if w[g] <= 0:
            continue
        x = np.float64(w[g])
        total, squares = all_sum[g], all_squares[g]
        s, q = chosen_sum[g], chosen_squares[g]
        before = 1.0
        if s > 0:
            before = min(1.0, scatter * max(q * (1 / (s * s) - 2 / (s * total)) + squares / (total * total), 0.0))
        s, q = s + x, q + x * x
        after = min(1.0, scatter * max(q * (1 / (s * s) - 2 / (s * total)) + squares / (total * total), 0.0))
        gain += importance[g] * (before - after)
    return gain


@kernel
@no_type_check
def _greedy(weights, importance, scatter, first):
    count, n = weights.shape
    all_sum, all_squares = np.zeros(n), np.zeros(n)
    for v in range(count):
        for g in range(n):
            x = np.float64(weights[v, g])
            all_sum[g] += x
            all_squares[g] += x * x
    chosen_sum, chosen_squares = np.zeros(n), np.zeros(n)
    order, is_chosen, bounds = np.empty(count, np.int64), np.zeros(count, np.bool_), np.full(count, np.inf)
    for step in range(count):
        best = -1
        if step < len(first):
            best = first[step]
        else:
            fresh = np.zeros(count, np.bool_)
            while True:
                # Gains shrink as views are taken, so that an old one is a bound.
                best = -1
                for v in range(count):
                    if not is_chosen[v] and (best < 0 or bounds[v] > bounds[best]):
                        best = v
                if fresh[best]:
                    break
                bounds[best] = _gain(
                    weights[best], importance, scatter, all_sum, all_squares, chosen_sum, chosen_squares
                )
                fresh[best] = True
        order[step], is_chosen[best] = best, True
        for g in range(n):
            x = np.float64(weights[best, g])
            chosen_sum[g] += x
            chosen_squares[g] += x * x
    return order


SAMPLE = 6000
"""Gaussians of the sample that are looked at without following rays. Views are chosen by one half of them; by the
other, a share of 0.01 is known to ±0.0018."""
GROUPS, GROUP = 48, 16
"""Groups of neighboring Gaussians to which rays are followed, and Gaussians in each: rays to neighbors meet the same
Gaussians, and all others need not be projected."""
RAYS_EACH = 2
"""At most so many rays are followed to a Gaussian in one view."""
RAY_SHARE, FEW_RAYS, FEW_SHARE = 0.005, 4000, 0.05
"""At most this share of the rays of all views is followed, or so many rays if they are a small share, too; there are
fewer groups where they would take more."""

LatticeOf = Callable[[int], Lattice]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rays:
    """The rays of one view that are followed, each to one Gaussian of the sample.

    Attributes:
        owners: number of that Gaussian among those in groups.
        rays: number of the ray in the view's lattice of rays.
        rows: the lattice's row that the ray belongs to.
        weights: blending weight of the Gaussian on the ray, 0 where the ray ends before it.
        remains: transmittance behind it, 0 where the ray ends before it.
    """

    owners: Int32[np.ndarray, " n"]
    rays: Int64[np.ndarray, " n"]
    rows: Int64[np.ndarray, " n"]
    weights: Float32[np.ndarray, " n"]
    remains: Float32[np.ndarray, " n"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sight:
    """What views see of a sample of Gaussians.

    Attributes:
        sample: rows of the Gaussians of the sample: at first single ones, then those of groups.
        singles: number of the single ones, to which no rays are followed: Gaussians in front of them hide nothing.
        groups: the group of each of the others.
        gaussians: number of all Gaussians.
        weights: blending weight that each gets from each view at the exact settings, in rows of the lattice; of a
            single one as if it were alone.
        remains: largest transmittance behind it on any ray of the view, 0 = not seen: of rays that end where less than
            `stop` of their light is left, those see it for which this is above `stop`.
        areas: how much of the rows those rays cover that would meet it alone.
        rays: that were followed, by view.
        all_rays: of whole views.
        complete: whether the single ones are all Gaussians that can be seen.
    """

    sample: Int64[np.ndarray, " n"]
    singles: int
    groups: Int32[np.ndarray, " m"]
    gaussians: int
    weights: Float32[np.ndarray, "V n"]
    remains: Float32[np.ndarray, "V n"]
    areas: Float32[np.ndarray, "V n"]
    rays: tuple[Rays, ...]
    all_rays: int
    complete: bool

    def halves(self) -> tuple["Sight", "Sight"]:
        """The same of every second single Gaussian, and of the others; the groups are in both.

        Views that are chosen by a sample show more of it than of the scene, so that the share that they leave out is to
        be counted on another one. A complete sample is not parted.
        """
        if self.complete:
            return self, self
        return self._half(0), self._half(1)

    def _half(self, first: int) -> "Sight":
        single = np.arange(first, self.singles, 2)
        columns = np.concatenate([single, np.arange(self.singles, len(self.sample))])
        return replace(
            self,
            sample=self.sample[columns],
            singles=len(single),
            weights=self.weights[:, columns],
            remains=self.remains[:, columns],
            areas=self.areas[:, columns],
        )

    @property
    def followed(self) -> int:
        """Number of rays that were followed."""
        return sum(len(each.owners) for each in self.rays)


def pixels_of(views: Views) -> LatticeOf:
    """A ray for each pixel of a view."""
    return lambda view: pixel_lattice(int(views.cameras.widths[view]), int(views.cameras.heights[view]))


def trace_sight(
    gaussians: Gaussians,
    views: Views,
    lattice_of: LatticeOf,
    visibility: VisibilityConfig,
    config: BlendConfig,
    *,
    size: int = SAMPLE,
    seed: int = 0,
) -> Sight:
    """Follows rays from all views to a random sample of Gaussians.

    Args:
        gaussians: the splat.
        views: all that may be chosen.
        lattice_of: the rays that the exact settings have in a view.
        visibility: resolved; against sensor depth, or nothing.
        config: of the exact settings.
        size: of the sample.
        seed: of the sample.
    """
    blocks = Blocks(gaussians)
    possible = np.flatnonzero(gaussians.opacities > ALPHA_MIN)
    generator = np.random.default_rng(seed)
    singles = np.sort(generator.choice(possible, min(size, len(possible)), replace=False))
    seeds = generator.choice(possible, min(GROUPS, len(possible)), replace=False)
    around = [blocks.around(int(row), GROUP) for row in seeds]
    around = [rows[gaussians.opacities[rows] > ALPHA_MIN] for rows in around]
    groups = np.repeat(np.arange(len(around), dtype=np.int32), [len(rows) for rows in around])
    sample = np.concatenate([singles, *around]).astype(np.int64)
    chosen = ShapeRows.of(gaussians, sample)

    def prepare(view: int) -> _ViewRays:
        return _view_rays(chosen, views, view, lattice_of(view), visibility, config, len(singles))

    prepared = parallel(prepare, range(len(views)))
    all_rays = sum(each.lattice.rows * each.lattice.side**2 for each in prepared)
    number = sum((np.bincount(groups[each.owners], minlength=len(around)) for each in prepared), np.zeros(len(around)))
    allowed = max(RAY_SHARE * all_rays, min(FEW_SHARE * all_rays, FEW_RAYS))
    fits = int(np.searchsorted(np.cumsum(number), allowed, side="right"))
    groups = groups[groups < max(fits, 1)]
    sample = sample[: len(singles) + len(groups)]
    rays = parallel(
        lambda view: _follow(prepared[view], blocks, views, view, sample[len(singles) :], config), range(len(views))
    )
    areas = np.stack([each.areas[: len(sample)] for each in prepared])
    remains = (areas > 0).astype(np.float32)
    weights = areas * gaussians.opacities[sample]
    for view, each in enumerate(rays):
        followed, behind = np.maximum(np.bincount(each.owners, minlength=len(groups)), 1), remains[view, len(singles) :]
        weights[view, len(singles) :] = (
            np.bincount(each.owners, each.weights, len(groups)) / followed * areas[view, len(singles) :]
        )
        behind[:] = 0
        np.maximum.at(behind, each.owners, each.remains)
    return Sight(
        sample=sample,
        singles=len(singles),
        groups=groups,
        gaussians=len(gaussians),
        weights=weights,
        remains=remains,
        areas=areas,
        rays=tuple(rays),
        all_rays=all_rays,
        complete=len(singles) == len(possible),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _ViewRays:
    """The rays of a view that meet the sample: where they are, and how much of the rows they cover in all."""

    lattice: Lattice
    least: Float32[np.ndarray, " P"]
    most: Float32[np.ndarray, " P"]
    rays: Int64[np.ndarray, " n"]
    owners: Int32[np.ndarray, " n"]
    areas: Float32[np.ndarray, " s"]


def _view_rays(
    chosen: ShapeRows,
    views: Views,
    view: int,
    lattice: Lattice,
    visibility: VisibilityConfig,
    config: BlendConfig,
    singles: int,
) -> _ViewRays:
    if visibility.against:
        assert views.depths is not None
        least, most = depth_interval([views.depths[view]], lattice, visibility)
    else:
        least, most = np.full(lattice.rows, -np.inf, np.float32), np.full(lattice.rows, np.inf, np.float32)
    if views.masks is not None:
        least = np.where(row_mask(views.masks[view], lattice) > 0, least, np.float32(np.inf))
    projected, index, depths = _project(chosen, views, view, lattice, config)
    depths = depths.astype(np.float32)

    counts = np.zeros(len(chosen), np.int32)
    shape = lattice.height, lattice.width, lattice.side
    count_rays(projected, index, depths, least, most, shape, counts)
    areas = (counts / lattice.side**2).astype(np.float32)
    first = int(np.searchsorted(index, singles))
    index, depths = index[first:], depths[first:]
    limit = int(np.minimum(counts[singles:], RAYS_EACH).sum())
    rays, owners = np.empty(limit, np.int64), np.empty(limit, np.int32)
    number = list_rays(projected, index, depths, least, most, shape, counts, RAYS_EACH, rays, owners)
    owners = owners[:number] - np.int32(singles)
    return _ViewRays(lattice=lattice, least=least, most=most, rays=rays[:number], owners=owners, areas=areas)


def _project(
    gaussians: ShapeRows, views: Views, view: int, lattice: Lattice, config: BlendConfig
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    cameras = views.cameras
    size = int(cameras.widths[view]), int(cameras.heights[view])
    return cpu.project(
        gaussians, cameras.cam_from_world[view], cameras.Ks[view], *size, lattice, eps2d=config.eps2d, near=config.near
    )


def _follow(
    meeting: _ViewRays,
    blocks: Blocks,
    views: Views,
    view: int,
    sample: Int64[np.ndarray, " n"],
    config: BlendConfig,
) -> Rays:
    lattice = meeting.lattice
    line = lattice.width * lattice.side
    count_x, count_y = -(-line // TILE), -(-lattice.height * lattice.side // TILE)
    tile = (meeting.rays // line // TILE) * count_x + meeting.rays % line // TILE
    order = np.argsort(tile, kind="stable")
    order = order[meeting.owners[order] < len(sample)]
    rays, owners, tile = meeting.rays[order], meeting.owners[order], tile[order]
    row = (rays // line // lattice.side) * lattice.width + rays % line // lattice.side
    starts = np.searchsorted(tile, np.arange(count_x * count_y + 1))
    weights, remains = np.zeros(len(rays), np.float32), np.zeros(len(rays), np.float32)
    if len(rays):
        ends = np.full(count_x * count_y, -np.inf, np.float32)
        np.maximum.at(ends, tile, meeting.most[row])
        rows = blocks.near(views.cameras, view, lattice, ends, (count_x, count_y), config.near)
        projected, index, depths = _project(ShapeRows.of(blocks.gaussians, rows), views, view, lattice, config)
        between, shape = (meeting.least, meeting.most), (lattice.height, lattice.width, lattice.side)
        follow_rays(
            np.argsort(depths, kind="stable"),
            index,
            depths.astype(np.float32),
            projected,
            rows,
            starts,
            rays,
            sample[owners],
            *between,
            shape,
            config.stop_transmittance,
            weights,
            remains,
        )
    return Rays(owners=owners, rays=rays, rows=row, weights=weights, remains=remains)


SCATTER = 0.05
"""ρ of no teacher in particular: once a Gaussian is seen, seeing it again is worth a twentieth as much."""


def covering_views(
    gaussians: Gaussians, views: Views, visibility: VisibilityConfig, config: BlendConfig, count: int
) -> tuple[int, ...]:
    """Row numbers of `count` views, ascending, chosen on a sample of Gaussians: each is the view that shows most of
    what those before it do not.

    Args:
        gaussians: the splat.
        views: to choose from.
        visibility: resolved; a test against rendered depth does not count.
        config: of the fusion.
        count: how many.
    """
    if count >= len(views):
        return tuple(range(len(views)))
    against = VisibilityConfig(
        against=tuple(source for source in visibility.against if source == "sensor"),
        relative=visibility.relative,
        absolute=visibility.absolute,
    )
    sight = trace_sight(gaussians, views, pixels_of(views), against, config)
    order = view_order(sight.weights, sight.singles, SCATTER)
    return tuple(int(view) for view in np.sort(order[:count]))
