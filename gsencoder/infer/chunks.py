"""Scenes of any size, region by region, in chunks: boxes of Gaussians with a halo, which an encoder sees at once."""

import math
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Int64

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.process import Device, Precision, Track, untracked
from gsencoder.core.threads import ahead
from gsencoder.models.grid import SceneCurves
from gsencoder.types import Gaussians

MUCH_WORK, MANY_TIMES = 100_000, 3.0
"""A warning is given where chunks take the work of so many Gaussians, and of so many times those of the scene."""
WORK_OF_CHUNK = 200
"""Gaussians that take as long as a chunk by itself: 30 ms against 0.14 ms a Gaussian, on one thread."""
REGION_CELL = 256
"""Edge in voxels of the cells that separate regions: convolutions of the shipped encoders reach 73 voxels, and a patch
of attention on a surface is 180 voxels wide at their coarsest level, so no context lies beyond a gap of 256."""
LEAST_REGION = 1_000
"""Gaussians of a region that is encoded by itself; smaller ones are strays, and are encoded together."""
LAST_CELL = 2**20
"""Further cells along an axis count as this one, so that three numbers of cells fit into one integer."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EncodeConfig:
    """The size of chunks and their halo, and where and in what precision the encoder computes."""

    chunk: int = field(
        default=250_000,
        metadata={"help": "largest number of Gaussians that the network sees at once, halo included; 0 = no chunks"},
    )
    halo: float = field(
        default=0.64, metadata={"help": "width in metres of the surroundings that the network sees around a chunk"}
    )
    precision: Precision = field(
        default="auto",
        metadata={
            "help": "type that the encoder computes in; auto = bfloat16 on a CPU that multiplies it, else float32"
        },
    )
    device: Device = field(default="auto", metadata={"help": "where the encoder computes"})

    def __post_init__(self) -> None:
        if self.chunk < 0:
            raise InputError(f"chunk: expected 0 (all) or more, got {self.chunk}")
        if not 0 <= self.halo < math.inf:
            raise InputError(f"halo: expected 0 or more metres, got {self.halo}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Chunk:
    """A part of a scene.

    Attributes:
        core_rows: rows whose features come from this chunk.
        rows: what the network sees, `core_rows` first.
        low, high: the box that it was cut to, world units; infinite where the region was not cut.
        halo: width of what the network sees around the box.
        region: number of the region that it is a part of.
    """

    core_rows: Int64[np.ndarray, " n"]
    rows: Int64[np.ndarray, " m"]
    low: Float[np.ndarray, "3"]
    high: Float[np.ndarray, "3"]
    halo: float
    region: int = 0

    def seen_around(self, means: Float32[np.ndarray, "N 3"]) -> Float[np.ndarray, " n"]:
        """How far the network sees around each row of the core; infinite where the scene is not cut off."""
        points = means[self.core_rows]
        return self.halo + np.minimum(points - self.low, self.high - points).min(axis=1)


def encode_by_chunks(
    gaussians: Gaussians,
    run: Callable[[Gaussians, SceneCurves | None, int], Float32[np.ndarray, "n channels"]],
    curves: Callable[[Float32[np.ndarray, "n 3"]], SceneCurves | None],
    config: EncodeConfig,
    *,
    voxel: float,
    metres_per_unit: float,
    columns: Mapping[str, slice],
    track: Track = untracked,
) -> dict[str, Float32[np.ndarray, "N _channels"]]:
    """Features of every Gaussian, computed chunk by chunk, by space: an array each, since they are gigabytes, which are
    not copied. Each region is a scene of its own: its features do not depend on what else the splat holds.

    Args:
        run: the encoder: features of the first n Gaussians of a subset, given the subset, the curves of the complete
            region where it has several chunks, and n.
        curves: computes these curves, given the centers of a region.
        voxel: edge of the encoder's finest cells, world units.
        metres_per_unit: unit of length of the splat.
        track: wraps the loops that cut and encode to show progress.
    """
    if not len(gaussians):
        raise InputError("encode: the splat has no Gaussians")
    results = {space: np.zeros((len(gaussians), part.stop - part.start), np.float32) for space, part in columns.items()}
    bad = 0
    regions = scene_regions(gaussians.means, voxel)
    chunks = _planned(gaussians.means, regions, config, metres_per_unit, track)
    parts = Counter(chunk.region for chunk in chunks)
    region_curves = {region: curves(gaussians.means[regions == region]) for region in parts if parts[region] > 1}

    def run_chunk(number: int) -> Float32[np.ndarray, "n channels"]:
        chunk = chunks[number]
        subset = gaussians if len(chunks) == 1 else gaussians.select(chunk.rows)
        return run(subset, region_curves.get(chunk.region), len(chunk.core_rows))

    # Checking and storing a chunk takes one thread, while the next one is computed.
    numbers = range(len(chunks))
    computed = ahead(run_chunk, numbers) if len(chunks) > 1 else map(run_chunk, numbers)
    for chunk, features in zip(track(chunks, "encoding"), computed, strict=True):
        bad += int((~np.isfinite(features).all(axis=1)).sum())
        for space, part in columns.items():
            results[space][chunk.core_rows] = features[:, part]
    if bad:
        raise InputError(f"encode: {bad} of {len(gaussians)} features are not finite; try precision=float32")
    return results


def scene_regions(means: Float32[np.ndarray, "N 3"], voxel: float) -> Int64[np.ndarray, " N"]:
    """Numbers from 0 of the region of each Gaussian. Regions are cells of `REGION_CELL` voxels that touch one another,
    by corners as well; those of fewer than `LEAST_REGION` Gaussians count as one, the last.

    Args:
        means: centers in world units.
        voxel: edge of the encoder's finest cells, world units.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    keys = np.zeros(len(means), np.int64)
    for column in means.T:
        # Borders lie at multiples of the edge in the world, so that a region is the same whatever else there is.
        cells = np.floor(column.astype(np.float64) / (REGION_CELL * voxel))
        keys = keys * (LAST_CELL + 1) + np.minimum(cells - cells.min(), LAST_CELL).astype(np.int64)
    occupied = np.unique(keys)
    tree = cKDTree(np.stack(np.unravel_index(occupied, (LAST_CELL + 1,) * 3), axis=1))
    pairs = tree.query_pairs(1.5, p=np.inf, output_type="ndarray")
    touching = coo_array((np.ones(len(pairs), bool), pairs.T), shape=(len(occupied), len(occupied)))
    count, components = connected_components(touching, directed=False)
    if count == 1:
        return np.zeros(len(means), np.int64)
    numbers = components[np.searchsorted(occupied, keys)]
    is_large = np.bincount(numbers) >= LEAST_REGION
    return np.where(is_large, np.cumsum(is_large) - 1, np.count_nonzero(is_large))[numbers]


def cut(
    means: Float32[np.ndarray, "N 3"], chunk: int, halo: float, regions: Int64[np.ndarray, " N"] | None = None
) -> list[Chunk]:
    """Cuts the regions of a scene into boxes, halved along their longest side until each fits into a chunk with its
    halo.

    Every row is in the core of exactly one chunk. Where a box has become small beside its halo, the halo is cut
    instead: the nearest rows that fit remain in it.

    Args:
        means: centers in world units.
        chunk: largest number of rows of a chunk; 0 = one chunk a region.
        halo: width of the halo in world units.
        regions: from `scene_regions`; None = all is one.
    """
    return list(_cut_regions(means, np.zeros(len(means), np.int64) if regions is None else regions, chunk, halo))


def _cut_regions(
    means: Float32[np.ndarray, "N 3"], regions: Int64[np.ndarray, " N"], chunk: int, halo: float
) -> Iterator[Chunk]:
    """The chunks of `cut`, one after the other: thousands of them take a while."""
    by_region, counts = np.argsort(regions, kind="stable"), np.bincount(regions)
    for region, rows in enumerate(np.split(by_region, np.cumsum(counts)[:-1])):
        for part in _cut(means[rows], chunk, halo) if len(rows) else ():
            yield replace(part, core_rows=rows[part.core_rows], rows=rows[part.rows], region=region)


def _cut(means: Float32[np.ndarray, "N 3"], chunk: int, halo: float) -> Iterator[Chunk]:
    """The chunks of one region."""
    all_rows = np.arange(len(means))
    if chunk == 0 or len(means) <= chunk:
        yield Chunk(core_rows=all_rows, rows=all_rows, low=np.full(3, -np.inf), high=np.full(3, np.inf), halo=halo)
        return
    columns, in_core = np.ascontiguousarray(means.T), np.zeros(len(means), bool)
    pending = [(all_rows, all_rows, np.full(3, -np.inf), np.full(3, np.inf))]
    while pending:
        core_rows, surroundings, low, high = pending.pop()
        # The surroundings of a box lie within those of the box that it was cut from.
        surroundings = _rows_near(columns, surroundings, low - halo, high + halo)
        if len(surroundings) <= chunk or len(core_rows) <= max(1, chunk // 4):
            in_core[core_rows] = True
            halo_rows, width = surroundings[~in_core[surroundings]], halo
            in_core[core_rows] = False
            if len(surroundings) > chunk:
                inside = means[halo_rows].clip(low, high)
                nearest, far = _smallest(np.square(means[halo_rows] - inside).sum(axis=1), chunk - len(core_rows))
                # Rows in the corners of the halo are farther than it is wide.
                halo_rows, width = halo_rows[nearest], min(halo, math.sqrt(far))
            rows = np.concatenate((core_rows, halo_rows))
            yield Chunk(core_rows=core_rows, rows=rows, low=low, high=high, halo=width)
            continue
        points = [column[core_rows] for column in columns]
        axis = int(np.argmax([values.max() - values.min() for values in points]))
        lower_half, middle = _smallest(points[axis], len(core_rows) // 2)
        upper, lower = high.copy(), low.copy()
        upper[axis] = lower[axis] = middle
        pending += [
            (core_rows[~lower_half], surroundings, lower, high),
            (core_rows[lower_half], surroundings, low, upper),
        ]


def _is_much_work(chunks: int, seen: int, count: int) -> bool:
    """Whether chunks that hold `seen` Gaussians together take many times the work of a scene of `count`."""
    work = seen + WORK_OF_CHUNK * chunks
    return work > MUCH_WORK and work > MANY_TIMES * count


def _planned(
    means: Float32[np.ndarray, "N 3"],
    regions: Int64[np.ndarray, " N"],
    config: EncodeConfig,
    metres_per_unit: float,
    track: Track,
) -> list[Chunk]:
    """The chunks of a scene; warns where they take many times its work, before it is cut where that is certain then:
    to cut it into thousands of chunks takes minutes."""
    count = len(means)
    least = math.ceil(count / config.chunk) if config.chunk else 1
    certain = _is_much_work(least, count, count)
    if certain:
        warnings.warn(
            f"encode.chunk={config.chunk}: {least:,} chunks or more, which take at least "
            f"{1 + WORK_OF_CHUNK * least / count:.0f} times the work of one pass over the {count:,} Gaussians; give a "
            "larger encode.chunk=",
            SceneWarning,
            stacklevel=3,
        )
    parts = _cut_regions(means, regions, config.chunk, config.halo / metres_per_unit)
    chunks = list(track(parts, "cutting into chunks"))
    seen = sum(len(chunk.rows) for chunk in chunks)
    if _is_much_work(len(chunks), seen, count) and not certain:
        narrow = sum(chunk.halo * metres_per_unit < 0.99 * config.halo for chunk in chunks)
        narrower = f"; {narrow:,} of them have no room for a halo of {config.halo:g} m and see less" if narrow else ""
        warnings.warn(
            f"encode.chunk={config.chunk}: {len(chunks):,} chunks, which with their halos hold {seen:,} Gaussians, "
            f"{seen / count:.1f} times the {count:,} of the scene, and take about "
            f"{(seen + WORK_OF_CHUNK * len(chunks)) / count:.0f} times the work of one pass{narrower}; give a larger "
            "encode.chunk= or a smaller encode.halo=",
            SceneWarning,
            stacklevel=3,
        )
    return chunks


def _rows_near(
    columns: Float32[np.ndarray, "3 N"], rows: Int64[np.ndarray, " m"], low: np.ndarray, high: np.ndarray
) -> Int64[np.ndarray, " n"]:
    """Those of some rows that lie in a box."""
    for column, least, most in zip(columns, low, high, strict=True):
        if least > -np.inf or most < np.inf:
            values = column[rows]
            rows = rows[(values >= least) & (values <= most)]
    return rows


def _smallest(values: Float[np.ndarray, " n"], count: int) -> tuple[Bool[np.ndarray, " n"], float]:
    """Which values a stable sort would put first, and the one that comes after them."""
    following = np.partition(values, count)[count]
    smallest = values < following
    smallest[np.flatnonzero(values == following)[: count - np.count_nonzero(smallest)]] = True
    return smallest, float(following)
