"""An encoding within a budget: the setting is chosen on parts of the scene, used, and measured.

What a setting of encoding changes and costs, measured on parts of a scene.

The network sees what lies around a Gaussian up to where its chunk ends. How much its features turn depends on how near
that is. A part of the scene that is encoded whole and in two halves tells by how much at every distance from the cut,
and the boxes of the chunks how many Gaussians of the scene are how far from theirs.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError
from gsencoder.core.process import Precision, Track, untracked
from gsencoder.core.settings import MEGABYTE, best_setting, shown_value, within_seconds
from gsencoder.fusion.errors import FieldError, judge, row_cosines
from gsencoder.fusion.folder import features_bytes
from gsencoder.infer.chunks import Chunk, EncodeBudget, EncodeConfig, cut, exact_encoding, scene_regions
from gsencoder.infer.load import Encoder
from gsencoder.types import FeatureBasis, GaussianFeatures, Gaussians

SAMPLE = 20_000
"""Gaussians from which axes are computed."""
BLOCK = 65_536


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PrincipalAxes:
    """The axes of some features.

    Attributes:
        axes: in the coordinates of the features, those with most energy first.
        errors: mean of 1 − centered cosine with the first 1, 2, … of them.
        energies: shares of the energy of directions that these keep.
    """

    axes: Float64[np.ndarray, "R R"]
    errors: Float64[np.ndarray, " R"]
    energies: Float64[np.ndarray, " R"]

    def left_out(self, rank: int) -> float:
        """The error with so many axes."""
        return float(self.errors[rank - 1])

    def rank_within(self, error: float) -> int:
        """The smallest number of axes that keeps an error; all of them where none does."""
        within = np.flatnonzero(self.errors <= error)
        return int(within[0]) + 1 if len(within) else len(self.errors)

    def reduced(self, features: GaussianFeatures, rank: int) -> GaussianFeatures:
        """The features with so many coordinates.

        Args:
            features: those that the axes are of.
            rank: 1 or more.
        """
        axes = self.axes[:rank]
        values = np.empty((len(features), rank), np.float32)
        for start in range(0, len(values), BLOCK):
            values[start : start + BLOCK] = (
                _about_mean(features, np.arange(start, min(start + BLOCK, len(values)))) @ axes.T
            )
        basis = features.basis
        components = axes if basis is None else axes @ basis.components
        return GaussianFeatures(
            features=values,
            weights=features.weights,
            mean=features.mean,
            space=features.space,
            basis=FeatureBasis(
                mean=features.mean,
                components=np.ascontiguousarray(components, np.float32),
                energy_kept=float(self.energies[rank - 1]) * (1.0 if basis is None else basis.energy_kept),
                space=features.space,
            ),
        )


def principal_axes(features: GaussianFeatures) -> PrincipalAxes:
    """The axes of features without an index, on an evenly spaced sample; each direction counts the same."""
    values = _about_mean(features, even_indices(len(features), SAMPLE))
    norms = np.linalg.norm(values, axis=1, keepdims=True)
    unit = values[norms[:, 0] > 0] / norms[norms[:, 0] > 0]
    _, vectors = np.linalg.eigh(unit.T @ unit)
    axes = vectors[:, ::-1].T
    shares = np.square(unit @ axes.T).cumsum(axis=1)
    if not len(unit):
        return PrincipalAxes(axes=axes, errors=np.zeros(len(axes)), energies=np.ones(len(axes)))
    return PrincipalAxes(
        axes=axes,
        errors=np.maximum(1 - np.sqrt(shares).mean(axis=0), 0),
        energies=np.minimum(shares.mean(axis=0), 1),
    )


def _about_mean(features: GaussianFeatures, rows: np.ndarray) -> Float64[np.ndarray, "n R"]:
    values = features.stored(rows).astype(np.float64)
    return values if features.basis is not None else values - features.mean


PARTS = 2
LEAST_ROWS, MOST_ROWS, SHARE = 256, 4096, 64
"""A part holds one of so many Gaussians of the scene, within these bounds. Larger parts did not predict better."""
ROUNDING_ROWS = 512
"""Gaussians on which precisions are compared: parts of a scene differ in it by less than a tenth."""
BINS = 8
"""Number of distances at which the error of cutting is stated."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """A part of the scene that was encoded whole, and in halves where the scene is cut.

    Attributes:
        rows: its number of Gaussians.
        seconds: of encoding it whole, by precision; empty if they do not matter.
        distances: from which on an error of `cutting` is made, ascending, metres; empty where the scene is not cut.
        cutting: error where the scene is cut so far away; never rises.
    """

    rows: int
    seconds: Mapping[Precision, float]
    distances: Float64[np.ndarray, " b"]
    cutting: Float64[np.ndarray, " b"]

    def cutting_error(self, seen: Float[np.ndarray, " n"]) -> float:
        """Mean error over Gaussians around which the network sees so far, in metres; infinite = to the end."""
        if not len(self.cutting):
            return 0.0
        number = np.maximum(np.searchsorted(self.distances, seen, side="right") - 1, 0)
        return float(np.where(np.isfinite(seen), self.cutting[number], 0).mean())


def measure_rounding(
    gaussians: Gaussians,
    encoder: Encoder,
    config: EncodeConfig,
    precisions: Sequence[Precision],
    *,
    metres_per_unit: float,
    seed: int,
) -> dict[Precision, float]:
    """The error of each precision, on a small part of the scene.

    Args:
        gaussians: the splat.
        encoder: whose teachers count as the worst of them.
        config: whose device is used.
        precisions: the exact one first, whose error is 0 by definition.
        metres_per_unit: see `Encoder.encode`.
        seed: of the part.
    """
    if len(precisions) < 2:
        return dict.fromkeys(precisions, 0.0)
    part = gaussians.select(_box_around(gaussians, _centers(gaussians, seed)[0], ROUNDING_ROWS))
    exact, *others = (
        encoder.encode_spaces(part, replace(config, chunk=0, precision=precision), metres_per_unit=metres_per_unit)
        for precision in precisions
    )
    errors = (0.0, *(float(_errors(each, exact).mean()) for each in others))
    return dict(zip(precisions, errors, strict=True))


def measure_parts(
    gaussians: Gaussians,
    encoder: Encoder,
    config: EncodeConfig,
    precisions: Sequence[Precision],
    *,
    is_cut: bool,
    metres_per_unit: float,
    seed: int,
    clock: Callable[[], float] | None,
) -> list[Part]:
    """Encodes parts of a scene whole, and in halves where the scene is cut into chunks.

    Args:
        gaussians: the splat.
        encoder: whose teachers count as the worst of them.
        config: whose device and precision are used.
        precisions: whose seconds are measured; the cheapest one last.
        is_cut: whether a region of the scene has several chunks.
        metres_per_unit: see `Encoder.encode`.
        seed: of the parts.
        clock: seconds; None if they do not matter.
    """
    if not is_cut and clock is None:
        return []
    count = max(min(len(gaussians) // SHARE, MOST_ROWS), LEAST_ROWS)
    # What a cut changes is the same in each precision, and the last one is the cheapest.
    uncut, parts = replace(config, chunk=0, precision=precisions[-1]), []
    for center in _centers(gaussians, seed):
        part = gaussians.select(_box_around(gaussians, center, count))
        seconds: dict[Precision, float] = {}
        for precision in precisions if clock is not None else ():
            assert clock is not None
            begun = clock()
            encoder.encode_spaces(part, replace(uncut, precision=precision), metres_per_unit=metres_per_unit)
            seconds[precision] = clock() - begun
        distances, cutting = np.zeros(0), np.zeros(0)
        if is_cut:
            exact = encoder.encode_spaces(part, uncut, metres_per_unit=metres_per_unit)
            halves = replace(uncut, chunk=max(len(part) * 2 // 3, 1), halo=0.0)
            halved = encoder.encode_spaces(part, halves, metres_per_unit=metres_per_unit)
            regions = scene_regions(part.means, encoder.voxel / metres_per_unit)
            seen = seen_around(part.means, cut(part.means, halves.chunk, 0.0, regions)) * metres_per_unit
            distances, cutting = _never_rising(seen, _errors(halved, exact))
        parts.append(Part(rows=len(part), seconds=seconds, distances=distances, cutting=cutting))
    return parts


def _centers(gaussians: Gaussians, seed: int) -> list[int]:
    """Gaussians around which parts lie."""
    chosen = np.random.default_rng(seed).choice(len(gaussians), min(PARTS, len(gaussians)), replace=False)
    return [int(center) for center in chosen]


def seen_around(means: Float32[np.ndarray, "N 3"], chunks: Sequence[Chunk]) -> Float64[np.ndarray, " N"]:
    """How far the network sees around each Gaussian of a scene in chunks, world units; infinite where nothing is
    cut."""
    seen = np.empty(len(means))
    for chunk in chunks:
        seen[chunk.core_rows] = chunk.seen_around(means)
    return seen


def _box_around(gaussians: Gaussians, center: int, count: int) -> Int64[np.ndarray, " n"]:
    """The Gaussians of the cube around one that holds so many."""
    if count >= len(gaussians):
        return np.arange(len(gaussians))
    far = np.abs(gaussians.means - gaussians.means[center]).max(axis=1)
    return np.sort(np.argpartition(far, count - 1)[:count])


def _errors(features: dict[str, GaussianFeatures], exact: dict[str, GaussianFeatures]) -> Float64[np.ndarray, " n"]:
    """1 − centered cosine of each Gaussian, of the teacher that is off the most."""
    each = [
        1
        - row_cosines(
            *((encoded.decode().astype(np.float64) - encoded.mean) for encoded in (features[name], exact[name]))
        )
        for name in exact
    ]
    return np.asarray(max(each, key=lambda values: float(values.mean())))


def _never_rising(
    seen: Float64[np.ndarray, " n"], errors: Float64[np.ndarray, " n"]
) -> tuple[Float64[np.ndarray, " b"], Float64[np.ndarray, " b"]]:
    """Distances, and the mean error from each of them to the next, where a larger one further on counts before it."""
    order = np.argsort(seen, kind="stable")
    groups = [group for group in np.array_split(order, BINS) if len(group)]
    means = np.array([errors[group].mean() for group in groups])
    return np.array([seen[group[0]] for group in groups]), np.maximum.accumulate(means[::-1])[::-1]


HALOS = (0.0, 0.16, 0.32, 0.64, 1.28)
"""Halos that are chosen among, metres; the last is that of preset=exact."""
EXPONENT = 0.8
"""Seconds of a chunk grow with its Gaussians to this power: measured from 7,000 to 216,000 on one thread."""
COSTS = {"auto": 1.0, "float32": 1.0, "bfloat16": 0.55}
"""Of precisions. Stated and not measured, so that one scene makes one choice, on a busy machine too."""
SMALL_SCENE = 20_000
"""Scenes of fewer Gaussians that are not cut are encoded exactly: choosing would cost more than it saves."""
CUT_ROWS = 100_000
"""Chunks of larger scenes are counted on so many of their Gaussians, in chunks that are as much smaller."""
SAFETY, DEVIATIONS = 5.0, 2.0
"""The bound of an error is `SAFETY` times the predicted one plus `DEVIATIONS` of its standard errors: the error that
parts of a scene predict was a third to five times that of the whole scene."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """A halo and a precision, with what is predicted of them.

    Attributes:
        config: of the encoding.
        knobs: values that differ between settings, by name.
        error: predicted.
        bound: what the error stays below in all likelihood.
        cost: of all chunks; 1 = a Gaussian by itself in float32.
        seconds: of all chunks.
    """

    config: EncodeConfig
    knobs: Mapping[str, float | str]
    error: float
    bound: float
    cost: float
    seconds: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BudgetEncoding:
    """An encoding within a budget.

    Attributes:
        features: by teacher, with as few coordinates as a budget of megabytes asks for.
        encoded: the same before any were left out.
        setting: that was chosen.
        exact: the setting that errors are measured against.
        ranks: coordinates, by teacher; empty without a budget of megabytes.
        sampled: Gaussians of the parts that the choice encoded.
        choosing: seconds of the choice.
        seconds: from its beginning to the features.
        predicted: error of the setting and of leaving out coordinates.
        notes: what budgets in conflict do not keep.
    """

    features: dict[str, GaussianFeatures]
    encoded: dict[str, GaussianFeatures]
    setting: Setting
    exact: EncodeConfig
    ranks: dict[str, int]
    sampled: int
    choosing: float
    seconds: float
    predicted: float
    notes: tuple[str, ...]


def encode_within(
    gaussians: Gaussians,
    encoder: Encoder,
    teachers: Sequence[str],
    config: EncodeConfig,
    budget: EncodeBudget,
    *,
    metres_per_unit: float = 1.0,
    header: Mapping[str, Any] = {},
    track: Track = untracked,
    clock: Callable[[], float] = time.perf_counter,
) -> BudgetEncoding:
    """Encodes a splat by the setting that keeps a budget.

    Args:
        gaussians: the splat.
        encoder: from `load_encoder`.
        teachers: whose features are wanted.
        config: options that the budget does not choose.
        budget: at least one promise.
        metres_per_unit: see `Encoder.encode`.
        header: what the files of features say of their making, which takes bytes.
        track: wraps the loop over chunks to show progress.
        clock: seconds.

    Raises:
        InputError: no budget, megabytes into which not even one coordinate fits, or what encoding refuses.
    """
    if not budget.promised:
        raise InputError("budget: expected budget.error=, budget.seconds= or budget.megabytes=, got none of them")
    start = clock()
    exact = replace(exact_encoding(config), precision=encoder.precisions(config.device)[0])
    if budget.megabytes is not None and budget.error is None:
        _check_size(encoder, teachers, len(gaussians), header, budget.megabytes)
    settings, sampled = all_settings(gaussians, encoder, exact, budget, metres_per_unit=metres_per_unit, clock=clock)
    setting, notes, spent = best_setting(settings, budget.error), tuple[str, ...](), clock() - start
    if budget.seconds is not None:
        setting, notes = within_seconds(settings, setting, budget, lambda each: spent + each.seconds)
    encoding_start = clock()
    by_teacher = encoder.encode_spaces(gaussians, setting.config, metres_per_unit=metres_per_unit, track=track)
    encoded = {name: by_teacher[name] for name in teachers}
    features, ranks, left_out = encoded, dict[str, int](), 0.0
    if budget.megabytes is not None:
        features, ranks, left_out, broken = _within_megabytes(encoded, header, setting, budget)
        notes += broken
    return BudgetEncoding(
        features=features,
        encoded=encoded,
        setting=setting,
        exact=exact,
        ranks=ranks,
        sampled=sampled,
        choosing=encoding_start - start,
        seconds=clock() - start,
        predicted=min(setting.error + left_out, 1.0),
        notes=notes,
    )


def all_settings(
    gaussians: Gaussians,
    encoder: Encoder,
    exact: EncodeConfig,
    budget: EncodeBudget,
    *,
    metres_per_unit: float,
    clock: Callable[[], float] = time.perf_counter,
) -> tuple[list[Setting], int]:
    """All settings, the exact one first, and the number of Gaussians that were encoded to predict them."""
    regions = scene_regions(gaussians.means, encoder.voxel / metres_per_unit)
    is_cut = 0 < exact.chunk < int(np.bincount(regions).max())
    precisions, timed = encoder.precisions(exact.device), budget.seconds is not None
    if len(gaussians) < SMALL_SCENE and not is_cut and not timed:
        precisions = precisions[:1]
    unit, seed = metres_per_unit, budget.seed
    rounding = measure_rounding(gaussians, encoder, exact, precisions, metres_per_unit=unit, seed=seed)
    parts = measure_parts(
        gaussians,
        encoder,
        exact,
        precisions,
        is_cut=is_cut,
        metres_per_unit=unit,
        seed=seed,
        clock=clock if timed else None,
    )
    rows, settings = even_indices(len(gaussians), CUT_ROWS), []
    means = gaussians.means[rows]
    scale = len(gaussians) / len(means)
    for halo in reversed(HALOS) if is_cut else (exact.halo,):
        chunks = cut(means, math.ceil(exact.chunk / scale), halo / metres_per_unit, regions[rows])
        sizes = scale * np.array([len(chunk.rows) for chunk in chunks], np.float64)
        cutting = np.zeros(1)
        # Where the exact setting cuts the scene is right by definition.
        if halo != exact.halo:
            seen = seen_around(means, chunks) * metres_per_unit
            cutting = np.array([part.cutting_error(seen) for part in parts])
        for precision in precisions:
            error = min(rounding[precision] + float(cutting.mean()), 1.0)
            deviation = float(cutting.std() / max(len(cutting) - 1, 1) ** 0.5)
            paces = [part.seconds[precision] * ((sizes / part.rows) ** EXPONENT).sum() for part in parts if timed]
            config = replace(exact, halo=halo, precision=precision)
            settings.append(
                Setting(
                    config=config,
                    knobs={"precision": precision, **({"halo": halo} if is_cut else {})},
                    error=error,
                    bound=min(SAFETY * error + DEVIATIONS * deviation, 1.0),
                    cost=float((sizes**EXPONENT).sum()) * COSTS[precision],
                    # The first pass of a process loads kernels, which no later one pays for.
                    seconds=float(min(paces, default=0.0)),
                )
            )
    sampled = sum(part.rows for part in parts) + (ROUNDING_ROWS if len(precisions) > 1 else 0)
    return settings, min(sampled, len(gaussians))


def _check_size(encoder: Encoder, teachers: Sequence[str], count: int, header: Mapping[str, Any], size: float) -> None:
    """Refuses a size into which not even one coordinate of each teacher fits."""
    least = sum(features_bytes(encoder.spaces[name], count, 1, header) for name in teachers)
    if least > size * MEGABYTE:
        raise InputError(
            f"budget.megabytes={shown_value(size)}: one coordinate of each Gaussian takes "
            f"{math.ceil(least / 10) / 1e5:.6g} MB; give more"
        )


def _within_megabytes(
    encoded: Mapping[str, GaussianFeatures], header: Mapping[str, Any], setting: Setting, budget: EncodeBudget
) -> tuple[dict[str, GaussianFeatures], dict[str, int], float, tuple[str, ...]]:
    """Features with as many coordinates as fit, or as a promised error needs; their numbers, the error that this adds,
    and notes about a promise that is not kept."""
    assert budget.megabytes is not None
    limit = budget.megabytes * MEGABYTE

    def bytes_of(name: str, rank: int) -> int:
        features = encoded[name]
        # All channels have no basis, which takes bytes of its own.
        all_channels = features.basis is None and rank == features.features.shape[1]
        return features_bytes(features.space, len(features), rank, header, basis=not all_channels)

    full = {name: features.features.shape[1] for name, features in encoded.items()}
    sizes = {name: bytes_of(name, rank) for name, rank in full.items()}
    ranks, axes = dict(full), dict[str, PrincipalAxes]()
    if sum(sizes.values()) > limit:
        for name, features in encoded.items():
            share, axes[name] = limit * sizes[name] / sum(sizes.values()), principal_axes(features)
            fitting = [rank for rank in range(1, full[name] + 1) if bytes_of(name, rank) <= share]
            needed = 1
            if budget.error is not None:
                needed = axes[name].rank_within(budget.error - setting.bound)
            ranks[name] = max([needed, *fitting])
    reduced = {
        name: each if ranks[name] == full[name] else axes[name].reduced(each, ranks[name])
        for name, each in encoded.items()
    }
    left_out = max((axes[name].left_out(ranks[name]) for name in axes), default=0.0)
    size = sum(bytes_of(name, rank) for name, rank in ranks.items())
    is_broken = size > limit and budget.error is not None
    notes = (budget.conflict("error", "megabytes", size / MEGABYTE),) if is_broken else ()
    return reduced, ranks, left_out, notes


def realised_error(
    encoding: BudgetEncoding,
    gaussians: Gaussians,
    encoder: Encoder,
    *,
    metres_per_unit: float = 1.0,
    seed: int = 0,
    track: Track = untracked,
) -> dict[str, FieldError]:
    """The error of each teacher's features against those of the exact setting, on a tenth of the Gaussians, drawn now.
    Where the exact setting was chosen, nothing is encoded again."""
    exact: Mapping[str, GaussianFeatures] = encoding.encoded
    if encoding.setting.config != encoding.exact:
        exact = encoder.encode_spaces(gaussians, encoding.exact, metres_per_unit=metres_per_unit, track=track)
    return {name: judge(features, exact[name], seed=seed) for name, features in encoding.features.items()}
