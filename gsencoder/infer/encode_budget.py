"""An encoding within a budget: the halo of chunks and the precision, measured on parts of the scene.

The network sees what lies around a Gaussian up to where its chunk ends. How much its features turn depends on how near
that is. A part of the scene that is encoded whole and in two halves tells by how much at every distance from the cut,
and the boxes of the chunks how many Gaussians of the scene are how far from theirs.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64

from gsencoder.core.arrays import even_indices
from gsencoder.core.budget import (
    MEGABYTE,
    Budget,
    Choice,
    Estimate,
    check_any_limit,
    choose,
    error_bound,
    reject_options_set_by_budget,
)
from gsencoder.core.process import Precision, Track, untracked
from gsencoder.core.settings import option
from gsencoder.fusion.basis import FieldError, judge, row_cosines
from gsencoder.fusion.folder import features_bytes, reduce_to_fit
from gsencoder.infer.encode import Chunk, EncodeConfig, Encoder, cut, scene_regions
from gsencoder.types import GaussianFeatures, Gaussians

OPTIONS_SET_BY_BUDGET = ("halo", "precision")
"""`chunk` remains a limit of memory."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EncodeBudget(Budget):
    """What an encoding may cost, or must reach. Where they conflict, the one that stands first here wins."""

    error: float | None = option(
        None,
        "largest mean of 1 − centered cosine to the features of preset=exact, over all Gaussians; of "
        "several teachers that of the worst",
    )
    seconds: float | None = option(None, "largest time from the choice of the setting to the features")
    megabytes: float | None = option(None, "largest size of the files of features, in units of 1,000,000 bytes")
    check: bool = option(
        True, "measure the error afterwards, which encodes at preset=exact; false = leave it unmeasured"
    )


def check_encode_budget(budget: EncodeBudget, config: EncodeConfig) -> None:
    reject_options_set_by_budget(budget, config, EncodeConfig(), OPTIONS_SET_BY_BUDGET, "encode")


def exact_encoding(config: EncodeConfig) -> EncodeConfig:
    """The encoding that errors are measured against: the values of `preset=exact`."""
    return replace(config, precision="float32", halo=1.28)


PARTS = 2
LEAST_ROWS, MOST_ROWS, SHARE = 256, 4096, 64
"""Gaussians of the scene for each one in a part, within these bounds. Larger parts did not predict better."""
ROUNDING_ROWS = 512
"""Gaussians on which precisions are compared: parts of a scene differ in it by less than a tenth."""
BINS = 8
"""Number of distances at which the error of cutting is known."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SampledRegion:
    """A part of the scene, of `rows` Gaussians, that was encoded whole, and in halves where the scene is cut.

    Attributes:
        seconds: of encoding it whole, by precision; empty if they do not matter.
        distances: from which on an error of `cutting` is made, ascending, metres; empty where the scene is not cut.
        cutting: error where the scene is cut this far away; never rises.
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


HALOS = (0.0, 0.16, 0.32, 0.64, 1.28)
"""Halos that are chosen among, metres; the last is that of preset=exact."""
EXPONENT = 0.8
"""Seconds of a chunk grow with its Gaussians to this power: measured from 7,000 to 216,000 on one thread."""
SMALL_SCENE = 20_000
"""Scenes of fewer Gaussians that are not cut are encoded exactly: choosing would cost more than it saves."""
CUT_ROWS = 100_000
"""Chunks of larger scenes are counted on this many of their Gaussians, in chunks that are as much smaller."""
SAFETY = 5.0
"""The error that parts of a scene predict was a third to five times that of the whole scene."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BudgetEncoding:
    """An encoding within a budget.

    Attributes:
        features: by teacher, with as few coordinates as a limit of megabytes asks for; `encoded` before that.
        exact: the setting that errors are measured against.
        ranks: coordinates, by teacher; empty without a limit of megabytes.
        choosing: seconds of the choice; `seconds` from its beginning to the features.
        notes: warnings about limits that are expected to be broken.
    """

    features: dict[str, GaussianFeatures]
    encoded: dict[str, GaussianFeatures]
    choice: Choice[EncodeConfig]
    exact: EncodeConfig
    ranks: dict[str, int]
    predicted: Mapping[str, float]
    choosing: float
    seconds: float
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

    A budget of error alone takes the cheapest setting that keeps it; budgets of seconds and megabytes without one take
    the most exact setting that keeps them.

    Args:
        config: options that the budget does not choose.
        header: the settings that are written with the features, which take bytes.
    """
    check_any_limit(budget)
    start = clock()
    exact = replace(exact_encoding(config), precision=encoder.precisions(config.device)[0])
    if budget.megabytes is not None and budget.error is None:
        # Known before anything is encoded.
        least = sum(features_bytes(encoder.spaces[name], len(gaussians), 1, header) for name in teachers) / MEGABYTE
        if least > budget.megabytes:
            raise budget.too_small(least)
    sample = SampledEncoding(gaussians, encoder, exact, metres_per_unit, clock if budget.seconds is not None else None)

    def measure(setting: EncodeConfig) -> Estimate:
        error, bound = sample.error(setting)
        return Estimate(error=error, bound=bound, seconds=sample.seconds(setting) + clock() - start)

    choice = choose(sample.settings, measure, replace(budget, megabytes=None))
    choosing = clock() - start
    by_teacher = encoder.encode_spaces(gaussians, choice.setting, metres_per_unit=metres_per_unit, track=track)
    features = encoded = {name: by_teacher[name] for name in teachers}
    predicted, ranks = {"error": choice.estimate.error, "seconds": choice.estimate.seconds}, dict[str, int]()
    notes = choice.notes
    if budget.megabytes is not None:
        spare = (budget.error or 0.0) - choice.estimate.bound
        features, ranks, lost, megabytes = reduce_to_fit(encoded, budget, header, error=max(spare, 0.0))
        predicted |= {"error": min(choice.estimate.error + lost, 1.0), "megabytes": megabytes}
        if megabytes > budget.megabytes:
            notes += (budget.conflict("megabytes", megabytes),)
    return BudgetEncoding(
        features=features,
        encoded=encoded,
        choice=choice,
        exact=exact,
        ranks=ranks,
        predicted=predicted,
        choosing=choosing,
        seconds=clock() - start,
        notes=notes,
    )


class SampledEncoding:
    """Parts of a scene that are encoded where a setting is measured.

    Attributes:
        settings: worth trying, cheapest first and the exact one last.
        is_cut: whether a region of the scene has several chunks.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        encoder: Encoder,
        exact: EncodeConfig,
        metres_per_unit: float,
        clock: Callable[[], float] | None = None,
    ) -> None:
        """`clock` gives seconds; None if they do not matter."""
        self._gaussians, self._encoder, self._exact, self._unit = gaussians, encoder, exact, metres_per_unit
        self._clock = clock
        self._regions = scene_regions(gaussians.means, encoder.voxel / metres_per_unit)
        self.is_cut = 0 < exact.chunk < int(np.bincount(self._regions).max())
        precisions = encoder.precisions(exact.device)
        if len(gaussians) < SMALL_SCENE and not self.is_cut and clock is None:
            precisions = precisions[:1]
        halos = HALOS if self.is_cut else (exact.halo,)
        # Precision changes less than a cut and costs more: the exact one is for the exact setting.
        self.settings = [replace(exact, halo=halo, precision=precisions[-1]) for halo in halos]
        self.settings += [replace(exact, precision=precision) for precision in precisions[-2::-1]]
        self._rounding = cache(self._measured_rounding)
        self._chunks = cache(self._counted_chunks)

    def error(self, setting: EncodeConfig) -> tuple[float, float]:
        """The error of a setting, and what it stays below."""
        if setting == self._exact:
            return 0.0, 0.0
        errors = np.full(1, self._rounding(setting.precision))
        if setting.halo != self._exact.halo:
            _, seen = self._chunks(setting.halo)
            errors = errors + np.array([part.cutting_error(seen) for part in self._parts])
        return float(errors.mean()), error_bound(errors, SAFETY)

    def seconds(self, setting: EncodeConfig) -> float:
        """Seconds of encoding all chunks; NaN without a clock."""
        if self._clock is None:
            return math.nan
        sizes, _ = self._chunks(setting.halo)
        # The first pass of a process loads kernels, which no later one pays for.
        return min(
            float(part.seconds[setting.precision] * ((sizes / part.rows) ** EXPONENT).sum()) for part in self._parts
        )

    def _counted_chunks(self, halo: float) -> tuple[Float64[np.ndarray, " C"], Float64[np.ndarray, " n"]]:
        """The sizes of chunks, and how far the network sees around each Gaussian, in metres."""
        rows = even_indices(len(self._gaussians), CUT_ROWS)
        means, scale = self._gaussians.means[rows], len(self._gaussians) / len(rows)
        chunks = cut(means, math.ceil(self._exact.chunk / scale), halo / self._unit, self._regions[rows])
        sizes = scale * np.array([len(chunk.rows) for chunk in chunks], np.float64)
        return sizes, seen_around(means, chunks) * self._unit

    def _measured_rounding(self, precision: Precision) -> float:
        """The error of a precision, on a small part of the scene."""
        if precision == self._exact.precision:
            return 0.0
        part = self._gaussians.select(_box_around(self._gaussians, self._centers()[0], ROUNDING_ROWS))
        rounded, exact = (
            self._encode(part, replace(self._exact, chunk=0, precision=each))
            for each in (precision, self._exact.precision)
        )
        return float(_errors(rounded, exact).mean())

    @cached_property
    def _parts(self) -> list[SampledRegion]:
        """Parts that are encoded whole, and in halves where the scene is cut into chunks."""
        count = max(min(len(self._gaussians) // SHARE, MOST_ROWS), LEAST_ROWS)
        precisions = dict.fromkeys(setting.precision for setting in self.settings)
        # What a cut changes is the same in each precision, and the first setting's is the cheapest.
        uncut, parts = replace(self.settings[0], chunk=0), []
        for center in self._centers():
            part = self._gaussians.select(_box_around(self._gaussians, center, count))
            seconds: dict[Precision, float] = {}
            if self._clock is not None:
                for precision in precisions:
                    begun = self._clock()
                    self._encode(part, replace(uncut, precision=precision))
                    seconds[precision] = self._clock() - begun
            distances, cutting = np.zeros(0), np.zeros(0)
            if self.is_cut:
                halves = replace(uncut, chunk=max(len(part) * 2 // 3, 1), halo=0.0)
                errors = _errors(self._encode(part, halves), self._encode(part, uncut))
                regions = scene_regions(part.means, self._encoder.voxel / self._unit)
                seen = seen_around(part.means, cut(part.means, halves.chunk, 0.0, regions)) * self._unit
                distances, cutting = _never_rising(seen, errors)
            parts.append(SampledRegion(rows=len(part), seconds=seconds, distances=distances, cutting=cutting))
        return parts

    def _encode(self, part: Gaussians, config: EncodeConfig) -> dict[str, GaussianFeatures]:
        return self._encoder.encode_spaces(part, config, metres_per_unit=self._unit)

    def _centers(self) -> list[int]:
        """Gaussians around which parts lie."""
        count = len(self._gaussians)
        return [int(row) for row in np.random.default_rng(0).choice(count, min(PARTS, count), replace=False)]


def seen_around(means: Float32[np.ndarray, "N 3"], chunks: Sequence[Chunk]) -> Float64[np.ndarray, " N"]:
    """How far the network sees around each Gaussian of a scene in chunks, world units; infinite where nothing is
    cut."""
    seen = np.empty(len(means))
    for chunk in chunks:
        seen[chunk.core_rows] = chunk.seen_around(means)
    return seen


def _box_around(gaussians: Gaussians, center: int, count: int) -> Int64[np.ndarray, " n"]:
    """The Gaussians of the cube around one that holds this many."""
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


def realised_error(
    encoding: BudgetEncoding,
    gaussians: Gaussians,
    encoder: Encoder,
    *,
    metres_per_unit: float = 1.0,
    track: Track = untracked,
) -> dict[str, FieldError]:
    """The error of each teacher's features against those of the exact setting, on a tenth of the Gaussians, drawn now.
    Where the exact setting was chosen, nothing is encoded again."""
    exact: Mapping[str, GaussianFeatures] = encoding.encoded
    if encoding.choice.setting != encoding.exact:
        exact = encoder.encode_spaces(gaussians, encoding.exact, metres_per_unit=metres_per_unit, track=track)
    return {name: judge(features, exact[name]) for name, features in encoding.features.items()}
