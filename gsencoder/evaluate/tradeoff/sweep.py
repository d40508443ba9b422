"""Sweeps of a stage's knobs: one at a time, all combinations, or the knobs that matter together."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from gsencoder.core.arrays import first_repeated
from gsencoder.core.errors import InputError
from gsencoder.core.process import Track, untracked
from gsencoder.core.settings import Knob, changed_knobs, describe_values, read_value, value_at, with_knobs
from gsencoder.evaluate.tradeoff.measure import Knobs, Record, Records, measure
from gsencoder.evaluate.tradeoff.stage import HIGHER_IS_BETTER, Cost, Inputs, Score, Stage, StageName
from gsencoder.evaluate.tradeoff.stages import (
    encoder_stage,
    fusion_stage,
    localization_stage,
    packages_stage,
    reconstruction_stage,
    views_stage,
)


def non_dominated_ranks(costs: Float64[np.ndarray, "n k"]) -> Int64[np.ndarray, " n"]:
    """The rank of each point: 0 for the front, 1 for the front of what is left without it, and so on.

    A point dominates another if it is no worse in every column and better in one. Less is better; NaN is worse than
    any number.
    """
    values = np.where(np.isnan(costs), np.inf, costs)
    no_worse = np.all(values[:, None] <= values[None], axis=2)
    better = np.any(values[:, None] < values[None], axis=2)
    dominates = np.asarray(no_worse & better)
    ranks = np.full(len(values), -1, np.int64)
    rank = 0
    while (ranks < 0).any():
        unranked = ranks < 0
        front = unranked & ~dominates[unranked].any(axis=0)
        ranks[front] = rank
        rank += 1
    return ranks


def crowding(costs: Float64[np.ndarray, "n k"]) -> Float64[np.ndarray, " n"]:
    """How alone each point stands among others (NSGA-II, Deb et al. 2002): the summed gaps to its neighbors in each
    column, as shares of the column's range; infinite at both ends."""
    distance = np.zeros(len(costs))
    for column in np.where(np.isfinite(costs), costs, np.nan).T:
        # Points that are alike in all columns must not all be taken for an end.
        order = np.argsort(column, kind="stable")
        ends = column[order]
        span = np.nanmax(ends, initial=-np.inf) - np.nanmin(ends, initial=np.inf)
        if not span > 0:
            continue
        distance[order[0]] = distance[order[-1]] = np.inf
        distance[order[1:-1]] += np.nan_to_num((ends[2:] - ends[:-2]) / span)
    return distance


def best_first(costs: Float64[np.ndarray, "n k"]) -> Int64[np.ndarray, " n"]:
    """Indices of points from the front backwards; within a front those that stand alone come first, and points that are
    alike in their order."""
    ranks = non_dominated_ranks(costs)
    spread = np.zeros(len(costs))
    for rank in range(int(ranks.max(initial=-1)) + 1):
        rows = np.flatnonzero(ranks == rank)
        spread[rows] = crowding(costs[rows])
    return np.lexsort((np.arange(len(costs)), -spread, ranks))


def on_front(costs: Sequence[Sequence[float]]) -> list[bool]:
    """Whether each point is on the front; less is better."""
    if not costs:
        return []
    return [bool(rank == 0) for rank in non_dominated_ranks(np.asarray(costs, np.float64))]


Evaluate = Callable[[Sequence[Knobs], int], Sequence[Sequence[float]]]
"""Costs of settings on the first so many scenes, one row each; less is better in every column."""
KEEP = 1 / 3
"""Share of the settings that the next, longer rung takes over."""
LEAST = 4
"""Settings that go on from any rung: a front of cost and accuracy has two ends, and something between them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HalvingConfig:
    """How the knobs that matter are changed together."""

    settings: int = field(
        default=0, metadata={"help": "combinations of the knobs that matter that are tried together; 0 = none"}
    )
    first: int = field(default=1, metadata={"help": "scenes of the first rung; each rung has three times as many"})

    def __post_init__(self) -> None:
        for name, least in (("settings", 0), ("first", 1)):
            if getattr(self, name) < least:
                raise InputError(f"{name}: expected {least} or more, got {getattr(self, name)}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Rung:
    """One rung: what was measured, and what went on.

    Attributes:
        scenes: of the rung.
        settings: that were measured on them.
        survivors: those of the next rung; after the last rung, all in the order in which they are best.
    """

    scenes: int
    settings: tuple[Knobs, ...]
    survivors: tuple[Knobs, ...]


def draw_settings(values: Mapping[str, Sequence[Any]], count: int, seed: int) -> list[dict[str, Any]]:
    """Different combinations of values: all of them where there are no more than `count`, else a random choice.

    Args:
        values: of each knob, the default first.
        count: of the settings.
        seed: of the choice.
    """
    names = list(values)
    total = math.prod(len(values[name]) for name in names)
    if total <= count:
        return [dict(zip(names, combination, strict=True)) for combination in product(*values.values())]
    numbers = np.random.default_rng(seed).choice(total, size=count, replace=False)
    shape = [len(values[name]) for name in names]
    return [
        {name: values[name][index] for name, index in zip(names, np.unravel_index(number, shape), strict=True)}
        for number in np.sort(numbers)
    ]


def successive_halving(
    settings: Sequence[Knobs], scenes: int, evaluate: Evaluate, config: HalvingConfig = HalvingConfig(settings=1)
) -> list[Rung]:
    """Measures settings on few scenes and the best of them on more, until all scenes are used.

    Those that go on are the first of `best_first`: by non-dominated rank, and within a rank those that stand alone, so
    that cheap ones and exact ones both go on.

    Args:
        settings: to begin with.
        scenes: how many there are.
        evaluate: see there.
        config: settings.
    """
    rungs: list[Rung] = []
    current, count = list(settings), min(config.first, scenes)
    while current:
        costs = np.asarray(evaluate(current, count), np.float64).reshape(len(current), -1)
        order = [current[index] for index in best_first(costs)]
        last = count == scenes
        survivors = order if last else order[: max(LEAST, math.ceil(KEEP * len(order) - 1e-9))]
        rungs.append(Rung(scenes=count, settings=tuple(current), survivors=tuple(survivors)))
        if last:
            break
        current, count = survivors, min(scenes, max(count + 1, round(count / KEEP)))
    return rungs


Phase = Literal["base", "one at a time", "grid", "joint"]
NORMAL_MAD = 1.4826
"""Standard deviations in a median absolute deviation of a normal distribution."""


class Estimate(NamedTuple):
    """A score over several scenes.

    Attributes:
        value: over all things that were scored.
        error: standard error over the scenes; NaN for one scene.
        things: that were scored.
    """

    value: float
    error: float
    things: float


@dataclass(frozen=True, slots=True, kw_only=True)
class SettingResult:
    """Measurements of one setting over its scenes.

    Attributes:
        stage: its name.
        knobs: the values that differ from the stage's base; empty for the base.
        phase: the part of the sweep that it belongs to.
        scenes: how many it was measured on.
        seconds, cpu_seconds: median over rounds, mean over scenes.
        spread: of `cpu_seconds` over rounds, a standard deviation as a share of it, median over scenes.
        ratio: CPU time as a share of that of the base, in the same rounds: geometric mean over scenes.
        ratio_error: standard error of its logarithm.
        mib: growth of peak memory, median over rounds, largest over scenes.
        bytes: mean over scenes.
        scores: by name.
        differences: of the scores from those of the base on the same scenes, by name; empty for the base. Their errors
            are smaller than those of the scores, since what is hard about a scene is hard for both.
        on_front: whether no other setting of the stage that was measured on as many scenes beats it in cost and
            accuracy.
    """

    stage: str
    knobs: Mapping[str, Any]
    phase: Phase
    scenes: int
    seconds: float
    cpu_seconds: float
    spread: float
    ratio: float
    ratio_error: float
    mib: float
    bytes: float
    scores: Mapping[str, Estimate]
    differences: Mapping[str, Estimate] = field(default_factory=dict)
    on_front: bool = False

    @property
    def label(self) -> str:
        return describe_values(self.knobs)

    def cost(self, kind: Cost) -> float:
        return float(getattr(self, kind))

    def score(self, name: str) -> float:
        """A score, or NaN where the stage or its scenes do not give it."""
        return self.scores[name].value if name in self.scores else math.nan

    def loss(self, name: str) -> float:
        """A score of which less is better."""
        return -self.score(name) if HIGHER_IS_BETTER[name] else self.score(name)

    def row(self) -> dict[str, Any]:
        """The result as a row of a table."""
        row: dict[str, Any] = {
            "stage": self.stage,
            "setting": self.label,
            "phase": self.phase,
            "scenes": self.scenes,
            "seconds": self.seconds,
            "cpu_seconds": self.cpu_seconds,
            "spread": self.spread,
            "ratio": self.ratio,
            "ratio_error": self.ratio_error,
            "mib": self.mib,
            "bytes": self.bytes,
            "on_front": self.on_front,
        }
        for name, estimate in self.scores.items():
            row |= {name: estimate.value, f"{name}_error": estimate.error, f"{name}_things": estimate.things}
        for name, estimate in self.differences.items():
            row |= {f"{name}_difference": estimate.value, f"{name}_difference_error": estimate.error}
        return row


def estimate(scores: Sequence[Score]) -> Estimate:
    """The ratio of sums over scenes, with the standard error that scenes drawn at random give it (Cochran 1977,
    sec. 2.11): objects of one scene have its light and its clutter in common, so scenes are what is drawn."""
    value, residuals, things = _ratio_of_sums(scores)
    return Estimate(value, _standard_error(residuals), things)


def estimate_difference(scores: Sequence[Score], base: Sequence[Score]) -> Estimate:
    """The ratio of sums over scenes less that of the base, with its standard error where scenes are drawn at random.

    Args:
        scores: of the scenes.
        base: of the same scenes.
    """
    (value, residuals, things), (other, of_base, _) = _ratio_of_sums(scores), _ratio_of_sums(base)
    return Estimate(value - other, _standard_error(residuals - of_base), things)


def _ratio_of_sums(scores: Sequence[Score]) -> tuple[float, Float64[np.ndarray, " scenes"], float]:
    """The ratio, what each scene adds to its deviation, and the number of things; NaN without things."""
    totals = np.array([each.total for each in scores], np.float64)
    counts = np.array([each.things for each in scores], np.float64)
    if not (things := float(counts.sum())):
        return math.nan, np.full(len(scores), math.nan), 0.0
    value = float(totals.sum()) / things
    return value, (totals - value * counts) / things, things


def _standard_error(residuals: Float64[np.ndarray, " scenes"]) -> float:
    n = len(residuals)
    return math.sqrt(n / (n - 1) * float((residuals**2).sum())) if n > 1 else math.nan


def summarize(records: Sequence[Record], base: Sequence[Record], phase: Phase) -> SettingResult:
    """One setting's records, each of another scene, beside those of the base on the same scenes."""
    by_scene = {record.scene: record for record in base}
    logs, spreads = [], []
    for record in records:
        cpu = _column(record, "cpu_seconds")
        middle = float(np.median(cpu))
        spreads.append(NORMAL_MAD * float(np.median(np.abs(cpu - middle))) / max(middle, 1e-12))
        if (other := by_scene.get(record.scene)) is not None:
            reference = _column(other, "cpu_seconds")
            rounds = min(len(cpu), len(reference))
            logs.append(float(np.median(np.log(np.maximum(cpu[:rounds], 1e-9) / np.maximum(reference[:rounds], 1e-9)))))
    names = list(dict.fromkeys(name for record in records for name in record.scores))
    differences = {name: _difference(name, records, by_scene) for name in names} if records[0].knobs else {}
    n = len(logs)
    return SettingResult(
        stage=records[0].stage,
        knobs=records[0].knobs,
        phase=phase,
        scenes=len(records),
        seconds=_mean_of_medians(records, "seconds"),
        cpu_seconds=_mean_of_medians(records, "cpu_seconds"),
        spread=float(np.median(spreads)),
        ratio=float(np.exp(np.mean(logs))) if logs else math.nan,
        ratio_error=float(np.std(logs, ddof=1) / math.sqrt(n)) if n > 1 else math.nan,
        mib=max(float(np.median(_column(record, "mib"))) for record in records),
        bytes=float(np.mean([record.bytes for record in records])),
        scores={name: estimate([record.scores[name] for record in records if name in record.scores]) for name in names},
        differences=differences,
    )


def _difference(name: str, records: Sequence[Record], base: Mapping[str, Record]) -> Estimate:
    """A score less that of the base, over the scenes that both have it of."""
    both = [
        (record.scores[name], other.scores[name])
        for record in records
        if (other := base.get(record.scene)) is not None and name in record.scores and name in other.scores
    ]
    return estimate_difference([score for score, _ in both], [score for _, score in both])


def scene_row(record: Record) -> dict[str, Any]:
    """One setting on one scene as a row of a table: medians over rounds, and each score with the things it is of."""
    row: dict[str, Any] = {"stage": record.stage, "setting": record.label, "scene": record.scene}
    row |= {name: float(np.median(_column(record, name))) for name in ("seconds", "cpu_seconds", "mib")}
    row["bytes"] = record.bytes
    for name, score in record.scores.items():
        row |= {name: score.total / score.things if score.things else math.nan, f"{name}_things": score.things}
    return row


def _column(record: Record, name: str) -> np.ndarray:
    return np.array([getattr(timing, name) for timing in record.timings])


def _mean_of_medians(records: Sequence[Record], name: str) -> float:
    return float(np.mean([np.median(_column(record, name)) for record in records]))


def mark_front(results: Sequence[SettingResult], accuracy: str, cost: Cost) -> list[SettingResult]:
    """Marks the results of one stage that no other of as many scenes beats in cost and accuracy."""
    most = max((result.scenes for result in results), default=0)
    full = [result for result in results if result.scenes == most]
    marks = iter(on_front([(result.cost(cost), result.loss(accuracy)) for result in full]))
    return [replace(result, on_front=result.scenes == most and next(marks)) for result in results]


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
    cost = stage.cost

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
