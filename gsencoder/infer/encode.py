"""Feed-forward inference: features of a splat in one pass, without photographs or teacher (SplatDistill, sec. 3.4).

Scenes of any size are encoded region by region, in chunks: boxes of Gaussians with a halo, which the network sees at
once.
"""

import math
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.files import write_bytes
from gsencoder.core.pretrained import find_file
from gsencoder.core.process import Device, Precision, Track, untracked
from gsencoder.core.settings import CheckedConfig, option
from gsencoder.core.threads import ahead
from gsencoder.data.up import scaled, upright_gaussians
from gsencoder.fusion.basis import field_error
from gsencoder.infer.onnx.runtime import SUFFIX, Network, OnnxNetwork
from gsencoder.models.grid import cut_scene_curves
from gsencoder.models.output_space import OutputSpace, OutputSpaces, find_weights
from gsencoder.text.table import TextTable
from gsencoder.types import FeatureSpace, GaussianFeatures, Gaussians, check_unit

MUCH_WORK, MANY_TIMES = 100_000, 3.0
"""A warning is given where chunks take the work of this number of Gaussians, and this many times that of the scene."""
WORK_OF_CHUNK = 200
"""Gaussians that take as long as a chunk by itself: 30 ms against 0.14 ms a Gaussian, on one thread."""
REGION_CELL = 256
"""Edge in voxels of the cells that separate regions: convolutions of the shipped encoders reach 73 voxels, and a patch
of attention on a surface is 180 voxels wide at their coarsest level, so no context lies beyond a gap of 256."""
LEAST_REGION = 1_000
"""Gaussians of a region that is encoded by itself; smaller ones are strays, and are encoded together."""
LAST_CELL = 2**20
"""Further cells along an axis count as this one, so that three numbers of cells fit into one integer."""
NAME_ROWS = 16_384
"""Gaussians whose names are compared at a time."""
TOLERANCE = 1e-4
"""Largest difference of an exported network from torch, as a share of the largest output."""
COSINE = 0.99
"""Smallest mean centered cosine of a cheaper precision's features to float32's."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EncodeConfig(CheckedConfig):
    """The size of chunks and their halo, and where and in what precision the encoder computes."""

    chunk: int = option(
        250_000, "largest number of Gaussians that the network sees at once, halo included; 0 = no chunks", ge=0
    )
    halo: float = option(
        0.64, "width in metres of the surroundings that the network sees around a chunk", ge=0, lt=math.inf
    )
    precision: Precision = option(
        "auto", "type that the encoder computes in; auto = bfloat16 on a CPU that multiplies it, else float32"
    )
    device: Device = option("auto", "where the encoder computes")
    grids: tuple[float, ...] = option(
        (), "edges of token grids, metres, whose outputs are averaged; empty = those of the weights", gt=0, lt=math.inf
    )


class Encoder:
    """Computes a feature for every Gaussian of a splat, by torch or by onnxruntime; `Encoder.load` reads one.

    Attributes:
        voxel: edge of the finest grid in metres.
        outputs: what the columns of the network's output mean.
        spaces: the feature spaces, by the names of their teachers.
        tables: the text tables next to the encoder, by the teacher in whose space they are.
        made_by: settings and results of the training, as JSON values.
    """

    def __init__(self, network: Network) -> None:
        self.network, header = network, network.header
        self.voxel: float = header.voxel
        self.outputs: OutputSpaces = header.outputs
        self.spaces: Mapping[str, FeatureSpace] = {
            name: outputs.space for name, outputs in header.outputs.by_teacher.items()
        }
        self.tables: Mapping[str, TextTable] = header.tables
        self.made_by: Mapping[str, Any] = header.made_by

    @staticmethod
    def load(weights: str, device: Device = "auto") -> "Encoder":
        """The encoder of a file, a folder or a name, such as "house" or "model.onnx", which runs without torch.

        Args:
            weights: a file that `gsencoder export` wrote, else what `gsencoder.models.output_space.find_weights` takes.
            device: where an exported graph runs; trained weights follow `EncodeConfig.device`.
        """
        if Path(weights).suffix.lower() == SUFFIX:
            return Encoder(OnnxNetwork(weights, device=device))
        from gsencoder.infer.torch_network import TorchNetwork

        return Encoder(TorchNetwork.load(weights))

    @property
    def words(self) -> TextTable | None:
        """The first of the text tables; None where there is none."""
        return next(iter(self.tables.values()), None)

    def precisions(self, device: Device) -> tuple[Precision, ...]:
        """The types that it computes in on a device, the most exact one first; others than that are cheaper."""
        return self.network.precisions(device)

    def encode(
        self,
        gaussians: Gaussians,
        config: EncodeConfig = EncodeConfig(),
        *,
        space: str | None = None,
        metres_per_unit: float = 1.0,
        up: Float64[np.ndarray, "3"] | None = None,
        track: Track = untracked,
    ) -> GaussianFeatures:
        """Features of every Gaussian in one space, all with weight 1.

        Args:
            space: name of a teacher or of its feature space; None = the only one.
            metres_per_unit: unit of length of the splat; the encoder's grid is in metres.
            up: the direction that is up in the splat (`Scene.up`), which is turned so that it is z, with the floor at
                0, as in training; None = the splat is taken as it is.
            track: wraps the loop over chunks to show progress.
        """
        teacher = self.outputs.resolve(space)
        return self._encode(gaussians, [teacher], config, metres_per_unit, up, track)[teacher]

    def encode_spaces(
        self,
        gaussians: Gaussians,
        config: EncodeConfig = EncodeConfig(),
        *,
        metres_per_unit: float = 1.0,
        up: Float64[np.ndarray, "3"] | None = None,
        track: Track = untracked,
    ) -> dict[str, GaussianFeatures]:
        """Features of every Gaussian in all spaces, by the names of their teachers; see `encode`."""
        return self._encode(gaussians, list(self.spaces), config, metres_per_unit, up, track)

    def _encode(
        self,
        gaussians: Gaussians,
        teachers: Sequence[str],
        config: EncodeConfig,
        metres_per_unit: float,
        up: Float64[np.ndarray, "3"] | None,
        track: Track,
    ) -> dict[str, GaussianFeatures]:
        """The mean of the outputs on each token grid."""
        check_unit(metres_per_unit, "metres_per_unit")
        if not len(gaussians):
            raise InputError("encode: the splat has no Gaussians")
        if up is not None:
            gaussians = upright_gaussians(gaussians, up)
        gaussians = scaled(gaussians, metres_per_unit)
        grids = config.grids or tuple(self.voxel * factor for factor in (1.0, *self.network.header.coarser))
        # An array for each space, since they are gigabytes, which are not copied.
        columns = {teacher: self.outputs.columns[teacher] for teacher in teachers}
        values: dict[str, Float32[np.ndarray, "N _channels"]] = {
            teacher: np.zeros((len(gaussians), part.stop - part.start), np.float32) for teacher, part in columns.items()
        }
        for number, grid in enumerate(grids):
            bad = 0
            for rows, features in self._on_grid(gaussians, grid, config, track, warn=not number):
                bad += int((~np.isfinite(features).all(axis=1)).sum())
                for teacher, part in columns.items():
                    values[teacher][rows] += features[:, part]
            if bad:
                raise InputError(f"encode: {bad} of {len(gaussians)} features are not finite; try precision=float32")
        if len(grids) > 1:
            for each in values.values():
                each /= len(grids)
        return {
            teacher: self.outputs[teacher].features(each, self._confidence(teacher, each, gaussians.means))
            for teacher, each in values.items()
        }

    def _on_grid(
        self, gaussians: Gaussians, voxel: float, config: EncodeConfig, track: Track, *, warn: bool
    ) -> Iterator[tuple[Int64[np.ndarray, " n"], Float32[np.ndarray, "n channels"]]]:
        """Rows and their restored outputs, chunk by chunk. Each region is a scene of its own: its features do not
        depend on what else the splat holds."""
        header = self.network.header
        run = self.network.runner(config.precision, config.device, voxel)
        regions = scene_regions(gaussians.means, voxel)
        chunks = list(track(_cut_regions(gaussians.means, regions, config.chunk, config.halo), "cutting into chunks"))
        if warn:
            _warn_of_work(chunks, len(gaussians), config)
        # Attention follows the curve of the complete region, wherever it is cut.
        curves = {
            region: cut_scene_curves(
                gaussians.means[regions == region],
                voxel,
                levels=header.levels,
                orders=header.orders,
                patch=header.patch,
            )
            for region, count in Counter(chunk.region for chunk in chunks).items()
            if count > 1
        }

        def run_chunk(number: int) -> Float32[np.ndarray, "n channels"]:
            chunk = chunks[number]
            subset = gaussians if len(chunks) == 1 else gaussians.select(chunk.rows)
            return run(subset, curves.get(chunk.region), len(chunk.core_rows))

        # Checking and storing a chunk takes one thread, while the next one is computed.
        numbers = range(len(chunks))
        computed = ahead(run_chunk, numbers) if len(chunks) > 1 else map(run_chunk, numbers)
        for chunk, features in zip(track(chunks, "encoding"), computed, strict=True):
            yield chunk.core_rows, features

    def _confidence(
        self, teacher: str, restored: Float32[np.ndarray, "N channels"], means: Float32[np.ndarray, "N 3"]
    ) -> Float32[np.ndarray, " N"] | None:
        """See `name_confidence`; None where the weights or the words next to them do not say enough."""
        outputs, words = self.outputs[teacher], self.tables.get(teacher)
        if not outputs.confidence or words is None or not words.trained:
            return None
        vectors = words.embeddings[[words.names.index(name) for name in words.trained]]
        evidence = name_evidence(outputs, vectors, restored, scene_regions(means, self.voxel))
        return name_confidence(evidence, outputs.confidence)

    def export(self, path: str | Path) -> None:
        """Writes the encoder as one ONNX file in float32, which runs without torch, after comparing the two."""
        from gsencoder.infer.onnx.export import export_onnx, random_cloud

        model = export_onnx(self.network.header, self.network.lower())
        check_parity(model, self, [Cloud("300 random Gaussians", random_cloud(300, self.voxel))])
        write_bytes(path, model)


load_encoder = Encoder.load
CONTRAST = 0.1
"""Temperature of the contrast that the encoder's names were trained with."""
MANY_NAMES, MANY_GAUSSIANS = 2.0, 4.5
"""Entropy of the names of a region, nats, and log10 of its Gaussians, from which on more says no more."""


def name_evidence(
    outputs: OutputSpace,
    names: Float32[np.ndarray, "C D"],
    restored: Float32[np.ndarray, "N channels"],
    regions: Int64[np.ndarray, " N"],
) -> Float32[np.ndarray, "N 4"]:
    """What speaks for the most probable of some names to be right: the log-odds that the contrast of training gives it,
    and of the Gaussian's region the mean log-odds, the entropy of its names (at most `MANY_NAMES`) and log10 of the
    number of its Gaussians (at most `MANY_GAUSSIANS`). An encoder is as sure of single Gaussians of a statue as of
    those of a sofa, but calls terrain one name, and a hammer that stands alone is small for a room.

    Args:
        names: their vectors; those of synonyms are equal, and count once.
        restored: coordinates in the basis, or vectors, of Gaussians.
        regions: from `scene_regions`.
    """
    from scipy.special import entr

    vectors = np.unique(names, axis=0)
    codes = outputs.project(vectors)
    odds, name = np.empty(len(restored), np.float32), np.empty(len(restored), np.int64)
    for start in range(0, len(restored), NAME_ROWS):
        block = outputs.standardize(restored[start : start + NAME_ROWS])
        scores = (block @ codes.T - 0.5 * np.square(codes).sum(axis=1)) / (CONTRAST * codes.shape[1])
        name[start : start + NAME_ROWS] = scores.argmax(axis=1)
        scores.sort(axis=1)
        others = np.log(np.exp(scores[:, :-1] - scores[:, -2:-1]).sum(axis=1)) + scores[:, -2]
        odds[start : start + NAME_ROWS] = scores[:, -1] - others
    counts = np.maximum(np.bincount(regions), 1)
    tally = np.bincount(regions * len(vectors) + name, minlength=len(counts) * len(vectors))
    shares = tally.reshape(len(counts), -1) / counts[:, None]
    of_regions = np.stack(
        [
            np.bincount(regions, odds) / counts,
            np.minimum(entr(shares).sum(axis=1), MANY_NAMES),
            np.minimum(np.log10(counts), MANY_GAUSSIANS),
        ],
        axis=1,
    )
    return np.concatenate([odds[:, None], of_regions[regions].astype(np.float32)], axis=1)


def name_confidence(evidence: Float32[np.ndarray, "N 4"], coefficients: Sequence[float]) -> Float32[np.ndarray, " N"]:
    """The probability that the most probable name of each Gaussian is right: a logistic model of `name_evidence`, whose
    intercept comes first."""
    logits = coefficients[0] + evidence @ np.array(coefficients[1:], np.float32)
    return (0.5 * (1 + np.tanh(logits / 2))).astype(np.float32)


def file_of_encoder(weights: str) -> Path:
    """The file of an encoder; what lies next to it belongs to it."""
    return find_file(weights, "weights") if Path(weights).suffix.lower() == SUFFIX else find_weights(weights)


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

    # Borders lie at multiples of the edge in the world, so that a cell is the same whatever else there is.
    keys = np.zeros(len(means), np.int64)
    for column in means.T:
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

    Every row is in the core of exactly one chunk. Where a box is small for its halo, the halo is cut
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


def _warn_of_work(chunks: Sequence[Chunk], count: int, config: EncodeConfig) -> None:
    """Warns where chunks take many times the work of one pass over a scene of `count` Gaussians."""
    seen = sum(len(chunk.rows) for chunk in chunks)
    work = seen + WORK_OF_CHUNK * len(chunks)
    if work > MUCH_WORK and work > MANY_TIMES * count:
        narrow = sum(chunk.halo < 0.99 * config.halo for chunk in chunks)
        narrower = f"; {narrow:,} of them have no room for a halo of {config.halo:g} m and see less" if narrow else ""
        warnings.warn(
            f"encode.chunk={config.chunk}: {len(chunks):,} chunks, which with their halos hold {seen:,} Gaussians, "
            f"take about {work / count:.0f} times the work of one pass over the {count:,} of the scene{narrower}; give "
            "a larger encode.chunk= or a smaller encode.halo=",
            SceneWarning,
            stacklevel=4,
        )


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


class Cloud(NamedTuple):
    """Gaussians to compare on."""

    name: str
    gaussians: Gaussians
    metres_per_unit: float = 1.0


def check_parity(
    model: bytes,
    encoder: Encoder,
    clouds: Sequence[Cloud],
    *,
    tolerance: float = TOLERANCE,
    track: Track = untracked,
) -> dict[str, float]:
    """Runs an exported model in float32, and the encoder that it was made from, on the same clouds.

    Returns:
        The largest difference on each cloud, as a share of the largest output of the space.
    """
    runtime = Encoder(OnnxNetwork(model, device="cpu"))
    config = EncodeConfig(precision="float32", device="cpu")
    errors: dict[str, float] = {}
    for name, cloud, unit in track(clouds, "comparing"):
        ours, theirs = (each.encode_spaces(cloud, config, metres_per_unit=unit) for each in (runtime, encoder))
        errors[name] = max(_largest_error(ours[space].stored(), theirs[space].stored()) for space in theirs)
        if not errors[name] <= tolerance:
            raise InputError(
                f"export: on {name} onnxruntime and torch differ by {errors[name]:.2g} of the largest output, more "
                f"than {tolerance:.2g}; no file was written"
            )
    return errors


def _largest_error(ours: np.ndarray, theirs: np.ndarray) -> float:
    return float(np.abs(ours - theirs).max() / max(float(np.abs(theirs).max()), 1e-30))


def check_cosines(
    model: bytes, exact: bytes, clouds: Sequence[Cloud], *, cosine: float = COSINE, track: Track = untracked
) -> dict[str, float]:
    """Runs a model of a cheaper precision, and the same in float32, on the same clouds.

    Returns:
        The mean centered cosine of the two's features on each cloud, in the space where it is smallest.
    """
    cheap, full = (Encoder(OnnxNetwork(each, device="cpu")) for each in (model, exact))
    config = EncodeConfig(device="cpu")
    cosines: dict[str, float] = {}
    for name, cloud, unit in track(clouds, "comparing"):
        ours, theirs = (each.encode_spaces(cloud, config, metres_per_unit=unit) for each in (cheap, full))
        cosines[name] = min(1 - field_error(ours[space], theirs[space]).centered for space in theirs)
        if not cosines[name] >= cosine:
            raise InputError(
                f"export: on {name} {cheap.network.header.precision} gives features whose mean centered cosine to "
                f"float32's is {cosines[name]:.4f}, below cosine={cosine}; no file was written. Take another precision"
            )
    return cosines
