"""What each view sees of a sample of Gaussians, by following a few rays to each: no teacher, and no whole pictures."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Int32, Int64

from gsencoder.core.process import parallel
from gsencoder.fusion.coverage.blocks import Blocks, ShapeRows
from gsencoder.fusion.coverage.kernels import TILE, count_rays, follow_rays, list_rays
from gsencoder.fusion.visibility import VisibilityConfig, row_mask, visible_depths
from gsencoder.geometry import ALPHA_MIN
from gsencoder.render import BlendConfig
from gsencoder.render import blend_cpu as cpu
from gsencoder.render.rays import Lattice, pixel_lattice
from gsencoder.types import Gaussians, Views

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
        least, most = visible_depths(views.depths[view], lattice, visibility)
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
