"""Speed against accuracy of fusion: scenes fused with many settings in one run.

Each setting is compared with a reference fused at the most exact settings. Teacher maps are computed once and cached,
so that only what the settings change is timed: blending, visibility, basis and lift. Rounds alternate between the
settings (A B C, A B C), so that other load on the machine affects all of them equally.
"""

import itertools
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from gsencoder.core.errors import InputError
from gsencoder.core.runtime.peak_memory import memory_growth
from gsencoder.core.runtime.tracking import Track, untracked
from gsencoder.data.scenes import SceneConfig, load_scene
from gsencoder.data.seeding.seed import SeedConfig, seed
from gsencoder.data.truth.scene_labels import with_counted_views
from gsencoder.evaluate.boxes import Hit, accuracy
from gsencoder.evaluate.protocols.localization import LocalizationProtocol, score_queries
from gsencoder.fusion.feature_error import FieldError, field_error
from gsencoder.fusion.fuse import FuseConfig, fuse
from gsencoder.fusion.teacher_maps import CachedTeacher
from gsencoder.fusion.teachers import Teacher
from gsencoder.fusion.teachers.build import TeacherConfig, build_teacher, text_table_of
from gsencoder.infer.localize.localize import LocalizeConfig
from gsencoder.text.table import TextTable
from gsencoder.types import GaussianFeatures, Scene

REFERENCE = "reference"
"""Label of the reference, which is neither on the Pareto front nor picked."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SweepConfig:
    """The values that each setting takes: one setting changed at a time, or all combinations with grid=true."""

    rays_per_patch: tuple[int, ...] = field(default=(1, 4, 16), metadata={"help": "numbers of rays per patch to try"})
    min_weight: tuple[float, ...] = field(
        default=(0.001, 0.01, 0.1), metadata={"help": "smallest blending weights to try"}
    )
    stop_transmittance: tuple[float, ...] = field(
        default=(0.001, 0.01, 0.1), metadata={"help": "transmittances at which a ray ends, to try"}
    )
    energy: tuple[float, ...] = field(
        default=(0.9, 0.95, 0.99), metadata={"help": "shares of the energy that the basis keeps, to try"}
    )
    max_rank: tuple[int, ...] = field(default=(8, 16, 32, 64), metadata={"help": "largest ranks of the basis to try"})
    views: tuple[int, ...] = field(default=(4, 8, 16), metadata={"help": "numbers of evenly spaced views to try"})
    grid: bool = field(
        default=False, metadata={"help": "try all combinations instead of changing one setting at a time"}
    )
    rounds: int = field(default=3, metadata={"help": "timed runs of each setting, of which the median is reported"})
    reference_rays: int = field(default=196, metadata={"help": "rays per patch of the reference"})

    def __post_init__(self) -> None:
        if self.rounds < 1:
            raise InputError(f"rounds: expected 1 or more, got {self.rounds}")


@dataclass(frozen=True, slots=True, kw_only=True)
class BudgetConfig:
    """Limits of time and error; the best setting within them is reported."""

    seconds: float | None = field(
        default=None, metadata={"help": "largest time for fusing one scene without the teacher, seconds"}
    )
    error: float | None = field(
        default=None, metadata={"help": "largest error against the reference, 1 − centered cosine"}
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class SettingResult:
    """Measurements of one setting over all scenes.

    Attributes:
        label: the changes from the defaults as text.
        knobs: the changes as values by name; empty for the defaults and the reference.
        seconds: time per scene, median over rounds and mean over scenes.
        mib: growth of the process's peak memory in MiB, largest over scenes.
        rank: columns of the features, mean over scenes.
        error: 1 − centered cosine to the reference over the Gaussians that it saw, mean over scenes; a Gaussian that
            this setting did not see counts as 1.
        raw_error: the same without centering, over the Gaussians that both saw.
        covered: share of the Gaussians seen by the reference that this setting saw too.
        hits: one for each queried object; empty if the teacher has no words or the scenes have no objects.
        on_front: whether the setting is on the Pareto front of seconds and error.
    """

    label: str
    knobs: dict[str, Any]
    seconds: float
    mib: float
    rank: float
    error: float
    raw_error: float
    covered: float
    hits: tuple[Hit, ...]
    on_front: bool = False


def sweep_settings(sweep: SweepConfig, base: FuseConfig) -> list[tuple[dict[str, Any], FuseConfig]]:
    """Expands a sweep: the defaults, then every other setting once, each with its changes from the defaults.

    Raises:
        InputError: a value is out of range.
    """
    defaults = {
        "rays_per_patch": base.blend.rays_per_patch,
        "min_weight": base.blend.min_weight,
        "stop_transmittance": base.blend.stop_transmittance,
        "energy": base.energy,
        "max_rank": base.max_rank,
        "views": base.views,
    }
    values_of = {name: list(dict.fromkeys((defaults[name], *getattr(sweep, name)))) for name in defaults}
    if sweep.grid:
        settings = [dict(zip(values_of, values, strict=True)) for values in itertools.product(*values_of.values())]
    else:
        settings = [
            defaults,
            *({**defaults, name: value} for name, values in values_of.items() for value in values[1:]),
        ]
    return [({k: v for k, v in knobs.items() if v != defaults[k]}, _with_knobs(base, knobs)) for knobs in settings]


def _with_knobs(base: FuseConfig, knobs: dict[str, Any]) -> FuseConfig:
    blend = {name: knobs[name] for name in ("rays_per_patch", "min_weight", "stop_transmittance")}
    fusion = {name: knobs[name] for name in ("energy", "max_rank", "views")}
    return replace(base, blend=replace(base.blend, **blend), **fusion)


def measure_tradeoff(
    paths: Sequence[str | Path],
    *,
    teacher: TeacherConfig,
    sweep: SweepConfig = SweepConfig(),
    base: FuseConfig = FuseConfig(),
    protocol: LocalizationProtocol = LocalizationProtocol(),
    data: SceneConfig = SceneConfig(),
    seeds: SeedConfig = SeedConfig(),
    localization: LocalizeConfig = LocalizeConfig(),
    track: Track = untracked,
) -> list[SettingResult]:
    """Measures every setting of a sweep on every scene.

    Args:
        paths: folders of the scenes.
        teacher: the teacher whose maps are fused. If it has words and scenes have labeled objects, localization is
            measured too.
        sweep: the values to try.
        base: settings of fusion that the sweep does not change, and the defaults of those that it does.
        protocol: which objects are queried.
        data: how scenes are read.
        seeds: how Gaussians are made for scenes without.
        localization: settings of `localize`.
        track: wraps the loops to show progress.

    Returns:
        Results of the reference, of the defaults, and of the other settings, with the Pareto front marked.

    Raises:
        InputError: a value is out of range, or a scene cannot be used.
    """
    settings = sweep_settings(sweep, base)
    exact = replace(base.blend, rays_per_patch=sweep.reference_rays, min_weight=0.0, stop_transmittance=1e-6)
    reference: tuple[dict[str, Any], FuseConfig] = ({}, replace(base, blend=exact, basis=False, views=0))
    words = text_table_of(teacher)
    per_scene: list[list[SettingResult]] = []
    for path in track(list(paths), "scenes"):
        scene = load_scene(path, options=data)
        scene = with_counted_views(scene) if words is not None else scene
        if scene.gaussians is None:
            scene = replace(scene, gaussians=seed(scene, seeds))
        with tempfile.TemporaryDirectory(prefix="gsencoder_maps_") as maps:
            cached = CachedTeacher(build_teacher(teacher, scene, words), Path(maps))
            scene_results = _measure_scene(
                scene, cached, [reference, *settings], words, protocol, localization, sweep, track
            )
        per_scene.append(scene_results)
    reference_result, *results = [_average_over_scenes([row[i] for row in per_scene]) for i in range(len(settings) + 1)]
    return [replace(reference_result, label=REFERENCE), *mark_pareto_front(results)]


def _measure_scene(
    scene: Scene,
    teacher: Teacher,
    settings: list[tuple[dict[str, Any], FuseConfig]],
    words: TextTable | None,
    protocol: LocalizationProtocol,
    localization: LocalizeConfig,
    sweep: SweepConfig,
    track: Track,
) -> list[SettingResult]:
    """Results of all settings on one scene; the first setting is the reference."""
    seconds: list[list[float]] = [[] for _ in settings]
    measured: list[tuple[float, int, FieldError, tuple[Hit, ...]]] = []
    reference: GaussianFeatures | None = None
    for round_number in track(range(sweep.rounds), "rounds"):
        for number, (_, config) in enumerate(track(settings, "settings")):
            with memory_growth() as growth:
                fusion = fuse(scene, teacher, config)
            seconds[number].append(sum(value for step, value in fusion.seconds.items() if step != "teacher"))
            reference = fusion.features if reference is None else reference
            if round_number == 0:
                error = field_error(fusion.features, reference)
                hits = (
                    score_queries(scene, fusion.features, words, protocol, localization)[0] if words is not None else []
                )
                measured.append((growth.mib, fusion.features.features.shape[1], error, tuple(hits)))
    return [
        SettingResult(
            label=", ".join(f"{name}={value}" for name, value in knobs.items()) or "defaults",
            knobs=knobs,
            seconds=float(np.median(times)),
            mib=mib,
            rank=float(rank),
            error=error.total,
            raw_error=error.raw,
            covered=error.covered,
            hits=hits,
        )
        for (knobs, _), times, (mib, rank, error, hits) in zip(settings, seconds, measured, strict=True)
    ]


def _average_over_scenes(results: list[SettingResult]) -> SettingResult:
    def mean(name: str) -> float:
        return float(np.mean([getattr(result, name) for result in results]))

    return SettingResult(
        label=results[0].label,
        knobs=results[0].knobs,
        mib=max(result.mib for result in results),
        hits=tuple(hit for result in results for hit in result.hits),
        seconds=mean("seconds"),
        rank=mean("rank"),
        error=mean("error"),
        raw_error=mean("raw_error"),
        covered=mean("covered"),
    )


def mark_pareto_front(results: Sequence[SettingResult]) -> list[SettingResult]:
    """Marks the results that no other result dominates in seconds and error."""

    def is_dominated(result: SettingResult) -> bool:
        return any(
            other.seconds <= result.seconds
            and other.error <= result.error
            and (other.seconds < result.seconds or other.error < result.error)
            for other in results
        )

    return [replace(result, on_front=not is_dominated(result)) for result in results]


def pick_within_budget(results: Sequence[SettingResult], budget: BudgetConfig) -> SettingResult:
    """Picks the fastest setting within a budget of error, or with a budget of seconds alone the most exact within it.

    Raises:
        InputError: no setting is within the budget; the fastest and the most exact are named.
    """
    results = [result for result in results if result.label != REFERENCE]
    affordable = [
        result
        for result in results
        if (budget.seconds is None or result.seconds <= budget.seconds)
        and (budget.error is None or result.error <= budget.error)
    ]
    if not affordable:
        fastest = min(results, key=lambda result: result.seconds)
        most_exact = min(results, key=lambda result: result.error)
        raise InputError(
            f"budget: no setting is within it; the fastest ({fastest.label}) takes {fastest.seconds:.3g} s at an error "
            f"of {fastest.error:.3g}, the most exact ({most_exact.label}) {most_exact.seconds:.3g} s at "
            f"{most_exact.error:.3g}"
        )
    if budget.error is None:
        return min(affordable, key=lambda result: (result.error, result.seconds))
    return min(affordable, key=lambda result: (result.seconds, result.error))


def table_row(result: SettingResult) -> dict[str, Any]:
    """The result as a row of the table; accuracies are NaN if no object was queried."""
    return {
        "setting": result.label,
        "seconds": result.seconds,
        "mib": result.mib,
        "rank": result.rank,
        "error": result.error,
        "raw_error": result.raw_error,
        "covered": result.covered,
        "acc_25": accuracy(result.hits, 0.25),
        "acc_50": accuracy(result.hits, 0.5),
        "objects": len(result.hits),
        "on_front": result.on_front,
    }
