"""Sweeps of a stage's knobs: one at a time, all combinations, or the knobs that matter together."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gsencoder.core.arrays import first_repeated
from gsencoder.core.errors import InputError
from gsencoder.core.process import Track, untracked
from gsencoder.core.settings import Knob, changed_knobs, describe_values, read_value, value_at, with_knobs
from gsencoder.evaluate.tradeoff.encoder import encoder_stage
from gsencoder.evaluate.tradeoff.fusion import fusion_stage
from gsencoder.evaluate.tradeoff.halving import HalvingConfig, Rung, draw_settings, successive_halving
from gsencoder.evaluate.tradeoff.localization import localization_stage
from gsencoder.evaluate.tradeoff.measure import Knobs, measure
from gsencoder.evaluate.tradeoff.packages import packages_stage
from gsencoder.evaluate.tradeoff.reconstruction import reconstruction_stage
from gsencoder.evaluate.tradeoff.records import Record, Records
from gsencoder.evaluate.tradeoff.results import Phase, SettingResult, mark_front, summarize
from gsencoder.evaluate.tradeoff.stage import HIGHER_IS_BETTER, Cost, Inputs, Stage, StageName
from gsencoder.evaluate.tradeoff.views import views_stage

STAGES: Mapping[StageName, Callable[[Inputs], Stage]] = {
    "reconstruction": reconstruction_stage,
    "fusion": fusion_stage,
    "encoder": encoder_stage,
    "packages": packages_stage,
    "localization": localization_stage,
    "views": views_stage,
}
"""The stages that have knobs, in the order of the pipeline."""
LEAST_EFFECT = 0.02
"""A knob that changes CPU time by less than this share does not matter for it, however well that is measured."""
NOISE_ERRORS = 2.0
"""An effect is noise if it is not larger than so many standard errors."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SweepConfig:
    """Which values are tried, and how often each is timed."""

    knobs: tuple[str, ...] = field(default=(), metadata={"names": True, "help": "knobs that are tried; empty = all"})
    values: tuple[str, ...] = field(
        default=(),
        metadata={
            "names": True,
            "help": "values in place of the usual ones, KNOB:VALUE/VALUE, such as views:4/8,rays_per_patch:1",
        },
    )
    grid: bool = field(default=False, metadata={"help": "try all combinations instead of changing one knob at a time"})
    rounds: int = field(default=3, metadata={"help": "timed runs of each setting, of which the median is reported"})
    seed: int = field(default=0, metadata={"help": "of the order of the runs, and of the settings tried together"})
    cost: Cost | None = field(
        default=None,
        metadata={
            "help": "what is held against accuracy: cpu_seconds, seconds, mib or bytes; empty = bytes for packages, "
            "cpu_seconds for all others"
        },
    )

    def __post_init__(self) -> None:
        if self.rounds < 1:
            raise InputError(f"rounds: expected 1 or more, got {self.rounds}")
        if self.seed < 0:
            raise InputError(f"seed: expected 0 or more, got {self.seed}")


@dataclass(frozen=True, slots=True, kw_only=True)
class StageResult:
    """What a sweep of one stage gave.

    Attributes:
        stage: see there.
        cost: what the front is drawn with.
        results: the base first.
        records: what they are of, by setting and scene.
        matter: the knobs whose effect is no noise.
        rungs: of successive halving; empty where nothing was tried together.
    """

    stage: Stage
    cost: Cost
    results: tuple[SettingResult, ...]
    records: tuple[Record, ...]
    matter: tuple[str, ...]
    rungs: tuple[Rung, ...]


def values_of(stage: Stage, sweep: SweepConfig) -> dict[str, tuple[Any, ...]]:
    """The values of each knob that is tried, the base's first.

    Raises:
        InputError: a value of another type, or one that the stage refuses.
    """
    values = dict(_given(text) for text in sweep.values)
    by_name: dict[str, tuple[Any, ...]] = {}
    for knob in stage.knobs:
        if sweep.knobs and knob.name not in sweep.knobs:
            continue
        candidates = knob.values
        if knob.name in values:
            candidates = tuple(read_value(stage.base, knob, text) for text in values[knob.name])
        by_name[knob.name] = tuple(dict.fromkeys((value_at(stage.base, knob.key), *candidates)))
    return by_name


def _given(text: str) -> tuple[str, list[str]]:
    name, colon, text_of_values = text.partition(":")
    values = [value for value in text_of_values.split("/") if value]
    if not colon or not values:
        raise InputError(f"sweep.values: expected KNOB:VALUE/VALUE, got {text!r}")
    return name, values


def check_sweep(stages: Sequence[Stage], sweep: SweepConfig) -> None:
    """Complains about a sweep before hours of work.

    Raises:
        InputError: an unknown knob, one that is given twice or left out by `knobs`, no value, or one that its stage
            refuses.
    """
    knob_names = [knob.name for stage in stages for knob in stage.knobs]
    names = [_given(text)[0] for text in sweep.values]
    if (repeated := first_repeated(names)) is not None:
        raise InputError(f"sweep.values: {repeated[0]} is given twice; give all of its values at once")
    for option, names_of_option in (("knobs", sweep.knobs), ("values", names)):
        for name in names_of_option:
            if name not in knob_names:
                raise InputError(
                    f"sweep.{option}: {name!r} is no knob of {', '.join(stage.name for stage in stages)}; expected "
                    f"some of {', '.join(knob_names)}"
                )
    if sweep.knobs and (left_out := [name for name in names if name not in sweep.knobs]):
        raise InputError(
            f"sweep.values: {left_out[0]} is not among sweep.knobs={','.join(sweep.knobs)}; add it there, or leave its "
            "values out"
        )
    for stage in stages:
        for knobs in settings_of(stage, sweep):
            with_knobs(stage.base, stage.knobs, knobs)


def settings_of(stage: Stage, sweep: SweepConfig) -> list[Knobs]:
    """The settings of a sweep as changes of the base: the base, then each other value, or each combination."""
    values = values_of(stage, sweep)
    if sweep.grid:
        count = math.prod(map(len, values.values()))
        return [changed_knobs(stage.base, stage.knobs, each) for each in draw_settings(values, count, sweep.seed)]
    changes: list[Knobs] = [{}]
    for knob in stage.knobs:
        base_changes = changed_knobs(stage.base, stage.knobs, knob.needs)
        alternatives = [{**base_changes, knob.name: value} for value in values.get(knob.name, ())[1:]]
        changes += [each for each in ([base_changes] if alternatives else []) + alternatives if each not in changes]
    return changes


def sweep_stage(
    stage: Stage,
    paths: Sequence[Path],
    records: Records,
    sweep: SweepConfig = SweepConfig(),
    halving: HalvingConfig = HalvingConfig(),
    track: Track = untracked,
) -> StageResult:
    """Measures a stage's settings on all scenes, and then those that matter together.

    Args:
        stage: see there.
        paths: folders of the scenes.
        records: what is measured already, and where results go.
        sweep: what is tried.
        halving: how many settings are tried together.
        track: progress.
    """
    cost = sweep.cost or stage.cost

    def measured(settings: Sequence[Knobs], scenes: int) -> list[list[Record]]:
        return measure(stage, paths[:scenes], settings, records, rounds=sweep.rounds, seed=sweep.seed, track=track)

    first = settings_of(stage, sweep)
    rows = measured(first, len(paths))
    base = rows[first.index({})]
    phase: Phase = "grid" if sweep.grid else "one at a time"
    results = [summarize(row, base, phase if row[0].knobs else "base") for row in rows]
    matter = tuple(knobs_that_matter(stage.knobs, rows, base, cost))
    rungs: list[Rung] = []
    if halving.settings and matter:
        values = {name: candidates for name, candidates in values_of(stage, sweep).items() if name in matter}
        samples = [
            changed_knobs(stage.base, stage.knobs, each) for each in draw_settings(values, halving.settings, sweep.seed)
        ]
        samples = [each for each in samples if _is_accepted(stage, each)]
        last: dict[str, list[Record]] = {}

        def costs(settings: Sequence[Knobs], scenes: int) -> list[tuple[float, float]]:
            measurements = measured(settings, scenes)
            summaries = [summarize(row, base, "joint") for row in measurements]
            last.update({summary.label: row for summary, row in zip(summaries, measurements, strict=True)})
            return [(summary.cost(cost), summary.loss(stage.accuracy)) for summary in summaries]

        rungs = successive_halving(samples, len(paths), costs, halving)
        measured_labels = {result.label for result in results}
        joint = [row for label, row in last.items() if label not in measured_labels]
        results += [summarize(row, base, "joint") for row in joint]
        rows += joint
    results.sort(key=lambda result: result.phase != "base")
    return StageResult(
        stage=stage,
        cost=cost,
        results=tuple(mark_front(results, stage.accuracy, cost)),
        records=tuple(record for row in rows for record in row),
        matter=matter,
        rungs=tuple(rungs),
    )


def _is_accepted(stage: Stage, knobs: Knobs) -> bool:
    """Whether a stage takes a combination; each of its values alone was accepted."""
    try:
        with_knobs(stage.base, stage.knobs, knobs)
    except InputError:
        return False
    return True


def knobs_that_matter(
    knobs: Sequence[Knob], rows: Sequence[Sequence[Record]], base: Sequence[Record], cost: Cost
) -> list[str]:
    """Knobs of which a value, changed alone or beside what it needs, moves cost or a score by more than noise."""
    by_label = {row[0].label: row for row in rows}
    with_effect = set()
    for knob in knobs:
        for row in rows:
            others = {name: value for name, value in row[0].knobs.items() if name != knob.name}
            beside = by_label.get(describe_values(others), base)
            changes_one = knob.name in row[0].knobs and (not others or others == dict(beside[0].knobs))
            if changes_one and (_moves_cost(row, beside, cost) or _moves_score(row, beside)):
                with_effect.add(knob.name)
    return [knob.name for knob in knobs if knob.name in with_effect]


def _moves_cost(row: Sequence[Record], base: Sequence[Record], cost: Cost) -> bool:
    """Whether the logarithm of a cost differs from the base's by more than its standard error over rounds and scenes
    explains."""
    logs: list[float] = []
    for record, reference in zip(row, base, strict=True):
        if cost == "bytes":
            logs.append(math.log(max(record.bytes, 1) / max(reference.bytes, 1)))
            continue
        for timing, reference_timing in zip(record.timings, reference.timings, strict=False):
            logs.append(math.log(max(getattr(timing, cost), 1e-9) / max(getattr(reference_timing, cost), 1e-9)))
    return _is_effect(logs, LEAST_EFFECT)


def _moves_score(row: Sequence[Record], base: Sequence[Record]) -> bool:
    """Whether any score differs from the base's, scene by scene, by more than its standard error over scenes."""
    for name in HIGHER_IS_BETTER:
        differences = [
            record.scores[name].total / record.scores[name].things
            - reference.scores[name].total / reference.scores[name].things
            for record, reference in zip(row, base, strict=True)
            if name in record.scores and name in reference.scores and record.scores[name].things
        ]
        if _is_effect(differences, 1e-9):
            return True
    return False


def _is_effect(values: Sequence[float], least: float) -> bool:
    finite = np.array([value for value in values if math.isfinite(value)])
    if not len(finite):
        return False
    mean = float(np.abs(finite.mean()))
    error = float(finite.std(ddof=1) / math.sqrt(len(finite))) if len(finite) > 1 else 0.0
    return mean > max(least, NOISE_ERRORS * error)
