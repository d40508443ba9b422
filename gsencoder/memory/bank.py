"""Memory banks, the principal scene components of a scene's feature maps (M3 sec. 3.3, Algorithm 1), and queries
without training: the coordinates of fused or predicted features in the principal directions of a bank."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64

from gsencoder.core.archive import RowFile
from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError, error_prefix
from gsencoder.core.settings import check_limits, option
from gsencoder.memory.reduction import (
    ROUNDING,
    CoverReduction,
    largest_threshold,
    reduce_algorithm1,
    unit_rows,
)
from gsencoder.types import FeatureMap, FeatureSpace, GaussianFeatures, MemoryBank
from gsencoder.types.features import Scoring, attention_keys

MapStream = Callable[[], Iterator[tuple[int, FeatureMap]]]
"""Gives the maps of a scene with the numbers of their views, any number of times."""


def raw_features(view: int, feature_map: FeatureMap) -> tuple[Float32[np.ndarray, "n D"], Int32[np.ndarray, "n 3"]]:
    """The features of a map, and the view, row and column of their cells: of every cell that has a feature; of a coded
    map each vector that occurs, once, in the first cell that has it."""
    if feature_map.codes is not None:
        assert feature_map.table is not None
        codes, cells = np.unique(feature_map.codes.ravel(), return_index=True)
        rows, cells = feature_map.table[codes[codes >= 0]], cells[codes >= 0]
    else:
        rows = feature_map.rows()
        cells = np.flatnonzero(~np.isnan(rows[:, 0]))
        rows = rows[cells]
    line, column = np.divmod(cells, feature_map.width)
    return rows, np.stack([np.full(len(cells), view), line, column], axis=1).astype(np.int32)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RawSample:
    """Raw features of one teacher in one scene, in the order of the maps, and how many they were drawn from."""

    features: Float32[np.ndarray, "n D"]
    total: int


def draw_sample(maps: MapStream, space: FeatureSpace, limit: int, *, seed: int = 0) -> RawSample:
    """Draws raw features without replacement, each with the same probability.

    Every feature gets a random number, and those with the smallest numbers are the sample. Every n-th feature would
    come from the same few columns of maps whose width divides n."""
    features = np.zeros((0, space.channels), np.float32)
    numbers, total = np.zeros(0), 0
    for view, feature_map in maps():
        rows, _ = raw_features(view, feature_map)
        drawn = np.random.default_rng([seed, view]).random(len(rows))
        total += len(rows)
        if len(numbers) == limit:
            # Most views give few features or none, and the sample is not copied for these.
            better = drawn < numbers.max()
            rows, drawn = rows[better], drawn[better]
        if not len(rows):
            continue
        features, numbers = np.concatenate([features, rows]), np.concatenate([numbers, drawn])
        if len(numbers) > limit:
            smallest = np.sort(np.argsort(numbers, kind="stable")[:limit])
            features, numbers = features[smallest], numbers[smallest]
    return RawSample(features=features, total=total)


BLOCK = 4096
"""Features that are compared with the components at once."""
SAMPLE = 20_000
"""Features among which a threshold is searched for a mean cosine."""
MIN_RELATIVE_NORM = 1e-3
"""Share of the mean's length below which a centered feature is rounding, not direction."""
MAX_NAMES = 1000
"""Up to this many vectors of coded maps are all components, unless another number or threshold is asked for."""
SAME_KIND_COSINE = 0.95
"""Features within this of another one are of its kind."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BankConfig:
    """How raw features are reduced to principal scene components."""

    method: Literal["cover", "paper"] = option(
        "cover",
        "cover = every feature is within the threshold of a component; paper = M3's Algorithm 1, which skips features "
        "near one that is in use, though no component may be near them",
    )
    center: bool = option(
        True, "compare features by the cosine after their mean has been subtracted; false = as the paper"
    )
    cosine: float = option(
        0.9,
        "mean cosine with the nearest component that the threshold is chosen for, over features and over kinds of "
        "features, unless threshold= or components= is given; names and captions are all components",
        gt=0,
        le=1,
    )
    threshold: float = option(0.0, "cosine θ within which a component stands for a feature; 0 = chosen", ge=0, le=1)
    components: int = option(0, "largest number of components, for which the threshold is chosen; 0 = any", ge=0)
    drop_last: int = option(
        0, "method=paper: a chunk size whose last, incomplete chunk gives no components, as printed", ge=0
    )

    def __post_init__(self) -> None:
        check_limits(self)
        if self.threshold and self.components:
            raise InputError(
                f"threshold, components: expected one of the two, got {self.threshold} and {self.components}"
            )
        if self.method == "cover" and self.drop_last:
            raise InputError("drop_last: expected 0 with method=cover, which has no chunks")


def build_bank(
    maps: MapStream, space: FeatureSpace, mean: Float32[np.ndarray, " D"], config: BankConfig = BankConfig()
) -> MemoryBank:
    """Reduces the raw features of all maps to a bank.

    A cover reads the maps view by view and holds nothing but the bank. The published algorithm compares each feature
    with all others, and keeps all of them in a temporary file. The mean is that of the space."""
    return _Builder(maps, space, mean if config.center else np.zeros_like(mean), config).build()


class _Builder:
    """The maps of a scene as rows, less a mean; features without a direction have one component for all of them."""

    def __init__(
        self, maps: MapStream, space: FeatureSpace, mean: Float32[np.ndarray, " D"], config: BankConfig
    ) -> None:
        self._maps, self._space, self._mean, self._config = maps, space, mean, config
        self._grids: dict[int, Float64[np.ndarray, "2 3"]] = {}
        self._coded: dict[int, bool] = {}
        self._floor = MIN_RELATIVE_NORM * float(np.linalg.norm(mean.astype(np.float64)))

    def build(self) -> MemoryBank:
        threshold, cover = self._threshold(), self._config.method == "cover"
        components, sources = self._at(self._cover(threshold).rows if cover else self._published(threshold))
        for rows, cells, directed in self._rows() if cover else ():
            if not directed.all():
                components = np.concatenate([components, rows[~directed][:1]])
                sources = np.concatenate([sources, cells[~directed][:1]])
                break
        if not len(components):
            raise InputError(f"memory: no view has a cell with a feature of {self._space.name}")
        components += self._mean
        coverage, cosine = self._score(components, threshold)
        return MemoryBank(
            components=components,
            sources=sources,
            grid_from_image=np.stack([self._grids[view] for view in sources[:, 0].tolist()]),
            mean=self._mean,
            threshold=threshold,
            coverage=coverage,
            cosine=cosine,
            space=self._space,
        )

    def _rows(self) -> Iterator[tuple[Float32[np.ndarray, "n D"], Int32[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]]:
        """For each view its raw features less the mean, where they are, and which of them have a direction."""
        for view, feature_map in self._maps():
            rows, sources = raw_features(view, feature_map)
            self._grids[view], self._coded[view] = feature_map.grid_from_image, feature_map.codes is not None
            with error_prefix(f"view {view}"):
                centered = rows - self._mean
                lengths = np.abs(centered).max(axis=1, initial=0)
                if not np.isfinite(lengths).all():
                    bad = int((~np.isfinite(lengths)).sum())
                    raise InputError(f"{bad:,} of {len(rows):,} features of {self._space.name} are not finite")
            # A vector whose largest entry is above the floor has a direction; squares might overflow.
            yield centered, sources, lengths * np.sqrt(self._space.channels) > self._floor

    def _threshold(self) -> float:
        config = self._config
        if config.threshold:
            return config.threshold
        if config.components:
            counts = np.array([(len(rows), directed.sum()) for rows, _, directed in self._rows()]).reshape(-1, 2)
            features, directed = counts.sum(axis=0).tolist()
            # One component is for features without a direction.
            most = min(config.components, features) - (directed < features)
            if most < 1 and directed:
                raise InputError(
                    f"bank.components={config.components}: cells at the mean need a component besides that of others; "
                    "give 2 or more"
                )
            most = max(1, most)
            threshold = largest_threshold(lambda each: len(self._cover(each, most)) <= most)
            if len(self._cover(threshold, most)) > most:
                raise InputError(
                    f"bank.components={config.components}: the features point in more directions than that even at a "
                    f"threshold of {threshold:.4f}; give more"
                )
            return threshold
        count = sum(int(directed.sum()) for _, _, directed in self._rows())
        sample, _ = self._at(even_indices(count, SAMPLE))
        if not len(sample):
            return 1.0
        if all(self._coded.values()) and len(np.unique(sample, axis=0)) <= MAX_NAMES:
            # The vectors are names or captions, and none of these may stand for another one.
            return 1.0
        # A feature that few cells have counts little in a mean over all of them, and as much as others among kinds.
        kinds = sample[_cover_of(sample, SAME_KIND_COSINE).rows]
        return 1 - largest_threshold(
            lambda each: _mean_cosine(sample, _cover_of(sample, 1 - each), kinds) >= config.cosine
        )

    def _at(self, chosen: Int64[np.ndarray, " k"]) -> tuple[Float32[np.ndarray, "k D"], Int32[np.ndarray, "k 3"]]:
        """Features with a direction, by their numbers among those of all views, ascending; and their cells."""
        parts = [np.zeros((0, self._space.channels), np.float32)]
        sources = [np.zeros((0, 3), np.int32)]
        start = 0
        for rows, cells, directed in self._rows():
            stop = start + int(directed.sum())
            within = chosen[(chosen >= start) & (chosen < stop)] - start
            parts.append(rows[directed][within])
            sources.append(cells[directed][within])
            start = stop
        return np.concatenate(parts), np.concatenate(sources)

    def _cover(self, threshold: float, limit: int | None = None) -> CoverReduction:
        cover = CoverReduction(self._space.channels, threshold)
        for rows, _, directed in self._rows():
            cover.add(rows[directed], limit=limit)
            if limit is not None and len(cover) > limit:
                break
        return cover

    def _published(self, threshold: float) -> Int64[np.ndarray, " M"]:
        # Each feature is compared with all others: they are in a file, so that no more than a block is held.
        with RowFile(self._space.channels) as file:
            for rows, _, directed in self._rows():
                file.append(unit_rows(rows[directed]))
            unit = file.array()
            count = len(unit)
            chosen, _ = reduce_algorithm1(unit, threshold, drop_last=self._config.drop_last)
            del unit
        if count and not len(chosen):
            raise InputError(
                f"bank.drop_last={self._config.drop_last}: all {count:,} features are in the last, incomplete chunk"
            )
        return chosen

    def _score(self, components: Float32[np.ndarray, "M D"], threshold: float) -> tuple[float, float]:
        """The share of features with a component within the threshold, and the mean cosine with the nearest one."""
        keys = components - self._mean
        directed_keys = np.abs(keys).max(axis=1) * np.sqrt(keys.shape[1]) > self._floor
        unit = unit_rows(keys[directed_keys])
        covered, total, count = 0, 0.0, 0
        for rows, _, directed in self._rows():
            count += len(rows)
            undirected = int((~directed).sum())
            if undirected and not directed_keys.all():
                covered, total = covered + undirected, total + undirected
            chosen = rows[directed] if len(unit) else rows[:0]
            for start in range(0, len(chosen), BLOCK):
                best = (unit_rows(chosen[start : start + BLOCK]) @ unit.T).max(axis=1)
                # A feature is its own component at a threshold of 1, whatever its product with itself rounds to.
                covered += int((best >= min(threshold, 1 - ROUNDING)).sum())
                total += float(best.sum(dtype=np.float64))
        return covered / count, total / count


def _cover_of(rows: Float32[np.ndarray, "n D"], threshold: float) -> CoverReduction:
    cover = CoverReduction(rows.shape[1], threshold)
    cover.add(rows)
    return cover


def _mean_cosine(sample: Float32[np.ndarray, "n D"], cover: CoverReduction, kinds: Float32[np.ndarray, "k D"]) -> float:
    """The mean cosine with the nearest component, over a sample of features or over their kinds: the smaller one."""

    def mean(rows: Float32[np.ndarray, "n D"]) -> float:
        blocks = [unit_rows(rows[start : start + BLOCK]) for start in range(0, len(rows), BLOCK)]
        return float(np.concatenate([(block @ cover.unit.T).max(axis=1) for block in blocks]).mean(dtype=np.float64))

    return min(mean(sample), mean(kinds))


QUERY_BLOCK = 1 << 14
"""Rows that are taken at a time."""


def principal_queries(
    features: GaussianFeatures, bank: MemoryBank, channels: int, scoring: Scoring = "centered"
) -> tuple[Float32[np.ndarray, "N s"], Float32[np.ndarray, "s D"]]:
    """Queries and a projection W_m whose product is the features about their mean, in the s directions in which the
    components of the bank differ most.

    Each component counts once, by its direction about the mean: where many Gaussians are walls, the principal
    directions of the Gaussians' features would leave out those that tell a mug from a cup.

    A cosine that is not centered depends on the mean as well, whose coordinate, the first one, is 1 for every Gaussian.
    With cosines queries have unit variance and rows of the projection the length √D, so that one learning rate serves
    both; with products they are in the units of the space. Gaussians that were never seen have queries of zero, and
    where the components have fewer directions, further channels are zero."""
    if features.space != bank.space:
        raise InputError(
            f"memory: the features are of ({features.space.describe()}), and the bank is of ({bank.space.describe()})"
        )
    seen = np.flatnonzero(features.seen)
    if not len(seen):
        raise InputError("memory: no Gaussian has features")
    basis, space = features.basis, features.space
    offset = features.mean if basis is None else np.zeros(basis.rank, np.float32)
    constant = int(scoring != "centered")
    keys = attention_keys(bank.components, features.mean, "centered").astype(np.float64)
    if basis is not None:
        keys = keys @ basis.components.T
    directions = np.linalg.eigh(keys.T @ keys)[1][:, ::-1][:, : max(0, channels - constant)].astype(np.float32)
    part = slice(constant, constant + directions.shape[1])
    queries = np.zeros((len(features), channels), np.float32)
    for start in range(0, len(seen), QUERY_BLOCK):
        chunk = seen[start : start + QUERY_BLOCK]
        queries[chunk, part] = (features.stored(chunk) - offset) @ directions
    projection = np.zeros((channels, space.channels), np.float32)
    projection[part] = directions.T if basis is None else directions.T @ basis.components
    if constant:
        queries[seen, 0], projection[0] = 1, features.mean
    if scoring == "dot":
        return queries, projection
    spread = np.float32(float(queries[seen].std()) or 1.0)
    return queries / spread, projection * np.float32(math.sqrt(space.channels))
