"""Encoding within a budget: the choice of a setting, the encoding, and the check of what was promised."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError
from gsencoder.core.process import Track, untracked
from gsencoder.core.settings import MEGABYTE, best_setting, shown_value, within_seconds
from gsencoder.fusion.errors import FieldError, judge
from gsencoder.fusion.folder import features_bytes
from gsencoder.infer.encode.chunks import EncodeConfig, cut, scene_regions
from gsencoder.infer.encode_budget.config import EncodeBudget, exact_encoding
from gsencoder.infer.encode_budget.principal_axes import PrincipalAxes, principal_axes
from gsencoder.infer.encode_budget.sample import ROUNDING_ROWS, measure_parts, measure_rounding, seen_around
from gsencoder.infer.load_encoder import Encoder
from gsencoder.types import GaussianFeatures, Gaussians

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
