"""Sweeps of a stage's knobs: one at a time, all combinations, or the knobs that matter together; and their plots."""

import io
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64, Int64

from gsencoder.core.arrays import first_repeated
from gsencoder.core.errors import InputError
from gsencoder.core.files import plain
from gsencoder.core.process import Track, untracked
from gsencoder.core.settings import (
    CheckedConfig,
    Knob,
    changed_knobs,
    describe_values,
    option,
    read_value,
    value_at,
    with_knobs,
)
from gsencoder.evaluate.tradeoff.measure import Knobs, Record, Records, measure
from gsencoder.evaluate.tradeoff.stages import HIGHER_IS_BETTER, Score, Stage


@dataclass(frozen=True, slots=True, kw_only=True)
class SweepConfig(CheckedConfig):
    """Which values are tried, and how often each is timed."""

    knobs: tuple[str, ...] = option((), "knobs that are tried; empty = all", names=True)
    values: tuple[str, ...] = option(
        (),
        "values in place of the usual ones, KNOB:VALUE/VALUE, such as views:4/8,rays_per_patch:1",
        names=True,
    )
    grid: bool = option(False, "try all combinations instead of changing one knob at a time")
    rounds: int = option(3, "timed runs of each setting, of which the median is reported", ge=1)


@dataclass(frozen=True, slots=True, kw_only=True)
class HalvingConfig(CheckedConfig):
    """How the knobs that matter are changed together."""

    settings: int = option(0, "combinations of the knobs that matter that are tried together; 0 = none", ge=0)


Phase = Literal["base", "one at a time", "grid", "joint"]


@dataclass(frozen=True, slots=True, kw_only=True)
class SettingResult:
    """One setting over its scenes.

    Attributes:
        knobs: the values that differ from the stage's base; empty for the base.
        row: of the table:
            stage, setting, phase, scenes;
            seconds, cpu_seconds: median over rounds, mean over scenes;
            spread: of the CPU time over rounds, a standard deviation as a share of it, median over scenes;
            ratio: CPU time as a share of that of the base in the same rounds, geometric mean over scenes;
            ratio_error: standard error of its logarithm;
            mib: median over rounds, largest over scenes;
            bytes: mean over scenes;
            on_front: whether no other setting on as many scenes beats it in cost and accuracy;
            and of each score its value, NAME_error, NAME_things (see `estimate`), and, but for the base,
            NAME_difference from the base on the same scenes and NAME_difference_error. That error is smaller than that
            of the score, since what is hard about a scene is hard for both.
    """

    knobs: Knobs
    row: dict[str, Any]

    def score(self, name: str) -> float:
        """A score or a cost, NaN where the stage or its scenes do not give it."""
        return float(self.row.get(name, math.nan))

    def loss(self, name: str) -> float:
        """A score of which less is better."""
        return -self.score(name) if HIGHER_IS_BETTER[name] else self.score(name)


@dataclass(frozen=True, slots=True, kw_only=True)
class Rung:
    """One rung of successive halving: the number of scenes, the settings that were measured on them, and those of the
    next rung; after the last rung, all in the order in which they are best."""

    scenes: int
    settings: tuple[Knobs, ...]
    survivors: tuple[Knobs, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class StageResult:
    """What a sweep of one stage gave: results, the base first, the records that they are of, the knobs whose effect is
    no noise, and the rungs, none where nothing was tried together."""

    stage: Stage
    results: tuple[SettingResult, ...]
    records: tuple[Record, ...]
    matter: tuple[str, ...]
    rungs: tuple[Rung, ...]


def sweep_stage(
    stage: Stage,
    paths: Sequence[Path],
    records: Records,
    sweep: SweepConfig = SweepConfig(),
    halving: HalvingConfig = HalvingConfig(),
    track: Track = untracked,
) -> StageResult:
    """Measures a stage's settings on all scenes, and then those that matter together; `records` has what is measured
    already, and takes the rest."""

    def measured(settings: Sequence[Knobs], scenes: int) -> list[list[Record]]:
        return measure(stage, paths[:scenes], settings, records, rounds=sweep.rounds, track=track)

    rows = measured(settings_of(stage, sweep), len(paths))
    (base,) = (row for row in rows if not row[0].knobs)
    phase: Phase = "grid" if sweep.grid else "one at a time"
    results = [summarize(row, base, phase if row[0].knobs else "base") for row in rows]
    matter = tuple(effective_knobs(stage.knobs, rows, base, stage.cost))
    rungs: list[Rung] = []
    if halving.settings and matter:
        values = {name: candidates for name, candidates in values_of(stage, sweep).items() if name in matter}
        drawn = draw_settings(values, halving.settings)
        samples = [changed_knobs(stage.base, stage.knobs, each) for each in drawn]
        joint: dict[str, list[Record]] = {}

        def costs(settings: Sequence[Knobs], scenes: int) -> list[tuple[float, float]]:
            measurements = measured(settings, scenes)
            joint.update({row[0].label: row for row in measurements})
            summaries = [summarize(row, base, "joint") for row in measurements]
            return [(each.score(stage.cost), each.loss(stage.accuracy)) for each in summaries]

        rungs = successive_halving([each for each in samples if _is_accepted(stage, each)], len(paths), costs)
        known = {row[0].label for row in rows}
        more = [row for label, row in joint.items() if label not in known]
        results += [summarize(row, base, "joint") for row in more]
        rows += more
    results.sort(key=lambda result: bool(result.knobs))
    mark_front(results, stage)
    return StageResult(
        stage=stage,
        results=tuple(results),
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


def check_sweep(stages: Sequence[Stage], sweep: SweepConfig) -> None:
    """Complains about a sweep before hours of work."""
    knob_names = [knob.name for stage in stages for knob in stage.knobs]
    names = [_parse_values(text)[0] for text in sweep.values]
    if (repeated := first_repeated(names)) is not None:
        raise InputError(f"sweep.values: {repeated[0]} is given twice; give all of its values at once")
    for name_of_option, names_of_option in (("knobs", sweep.knobs), ("values", names)):
        for name in names_of_option:
            if name not in knob_names:
                raise InputError(
                    f"sweep.{name_of_option}: {name!r} is no knob of {', '.join(stage.name for stage in stages)}; "
                    f"expected some of {', '.join(knob_names)}"
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
        every = draw_settings(values, math.prod(map(len, values.values())))
        return [changed_knobs(stage.base, stage.knobs, each) for each in every]
    changes: list[Knobs] = [{}]
    for knob in stage.knobs:
        base_changes = changed_knobs(stage.base, stage.knobs, knob.needs)
        alternatives = [{**base_changes, knob.name: value} for value in values.get(knob.name, ())[1:]]
        changes += [each for each in ([base_changes] if alternatives else []) + alternatives if each not in changes]
    return changes


def values_of(stage: Stage, sweep: SweepConfig) -> dict[str, tuple[Any, ...]]:
    """The values of each knob that is tried, the base's first."""
    given = dict(_parse_values(text) for text in sweep.values)
    by_name: dict[str, tuple[Any, ...]] = {}
    for knob in stage.knobs:
        if sweep.knobs and knob.name not in sweep.knobs:
            continue
        candidates = knob.values
        if knob.name in given:
            candidates = tuple(read_value(stage.base, knob, text) for text in given[knob.name])
        by_name[knob.name] = tuple(dict.fromkeys((value_at(stage.base, knob.key), *candidates)))
    return by_name


def _parse_values(text: str) -> tuple[str, list[str]]:
    name, colon, text_of_values = text.partition(":")
    values = [value for value in text_of_values.split("/") if value]
    if not colon or not values:
        raise InputError(f"sweep.values: expected KNOB:VALUE/VALUE, got {text!r}")
    return name, values


def draw_settings(values: Mapping[str, Sequence[Any]], count: int) -> list[dict[str, Any]]:
    """Different combinations of the values of knobs: all where there are no more than `count`, else a random choice."""
    total = math.prod(map(len, values.values()))
    numbers = np.arange(total)
    if total > count:
        numbers = np.sort(np.random.default_rng(0).choice(total, size=count, replace=False))
    every = list(product(*values.values()))
    return [dict(zip(values, every[number], strict=True)) for number in numbers]


KEEP = 1 / 3
"""Share of the settings that the next rung takes over, on three times as many scenes."""
LEAST = 4
"""Settings that go on from any rung: a front of cost and accuracy has two ends, and something between them."""


def successive_halving(
    settings: Sequence[Knobs], scenes: int, evaluate: Callable[[Sequence[Knobs], int], Sequence[Sequence[float]]]
) -> list[Rung]:
    """Measures settings on one scene and the best of them on more, until all scenes are used.

    Those that go on are the first of `best_first`: by non-dominated rank, and within a rank those that stand alone, so
    that cheap ones and exact ones both go on.

    Args:
        evaluate: the costs of settings on the first n scenes, one row each; less is better in every column.
    """
    rungs: list[Rung] = []
    current, count = list(settings), 1
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


def non_dominated_ranks(costs: Float64[np.ndarray, "n k"]) -> Int64[np.ndarray, " n"]:
    """The rank of each point: 0 for the front, 1 for the front of what is left without it, and so on.

    A point dominates another if it is no worse in every column and better in one. Less is better; NaN is worse than
    any number.
    """
    values = np.where(np.isnan(costs), np.inf, costs)
    no_worse = np.all(values[:, None] <= values[None], axis=2)
    dominates = no_worse & np.any(values[:, None] < values[None], axis=2)
    ranks = np.full(len(values), -1, np.int64)
    rank = 0
    while (ranks < 0).any():
        unranked = ranks < 0
        ranks[unranked & ~dominates[unranked].any(axis=0)] = rank
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
    for rank in np.unique(ranks):
        spread[ranks == rank] = crowding(costs[ranks == rank])
    return np.lexsort((np.arange(len(costs)), -spread, ranks))


def mark_front(results: Sequence[SettingResult], stage: Stage) -> None:
    """Marks the results of one stage that no other on as many scenes beats in cost and accuracy."""
    most = max(result.row["scenes"] for result in results)
    full = [result for result in results if result.row["scenes"] == most]
    costs = np.array([(result.score(stage.cost), result.loss(stage.accuracy)) for result in full])
    for result, rank in zip(full, non_dominated_ranks(costs), strict=True):
        result.row["on_front"] = bool(rank == 0)


NORMAL_MAD = 1.4826
"""Standard deviations in a median absolute deviation of a normal distribution."""


def summarize(records: Sequence[Record], base: Sequence[Record], phase: Phase) -> SettingResult:
    """One setting's records, each of another scene, and those of the base on the same scenes."""
    by_scene = {record.scene: record for record in base}
    pairs = [(record, by_scene[record.scene]) for record in records if record.scene in by_scene]
    logs = [float(np.median(_log_ratios(record, other, "cpu_seconds"))) for record, other in pairs]
    spreads = []
    for record in records:
        cpu = record.costs("cpu_seconds")
        middle = float(np.median(cpu))
        spreads.append(NORMAL_MAD * float(np.median(np.abs(cpu - middle))) / max(middle, 1e-12))
    first, n = records[0], len(logs)
    medians = {name: [np.median(each.costs(name)) for each in records] for name in ("seconds", "cpu_seconds", "mib")}
    row: dict[str, Any] = {
        "stage": first.stage,
        "setting": first.label,
        "phase": phase,
        "scenes": len(records),
        "seconds": float(np.mean(medians["seconds"])),
        "cpu_seconds": float(np.mean(medians["cpu_seconds"])),
        "spread": float(np.median(spreads)),
        "ratio": float(np.exp(np.mean(logs))) if logs else math.nan,
        "ratio_error": float(np.std(logs, ddof=1) / math.sqrt(n)) if n > 1 else math.nan,
        "mib": float(max(medians["mib"])),
        "bytes": float(np.mean([record.bytes for record in records])),
        "on_front": False,
    }
    names = list(dict.fromkeys(name for record in records for name in record.scores or {}))
    for name in names:
        scores = [record.scores[name] for record in records if record.scores and name in record.scores]
        row[name], row[f"{name}_error"], row[f"{name}_things"] = estimate(scores)
    for name in names if first.knobs else ():
        both = [
            (record.scores[name], other.scores[name])
            for record, other in pairs
            if record.scores and other.scores and name in record.scores and name in other.scores
        ]
        difference, error, _ = estimate([score for score, _ in both], [score for _, score in both])
        row |= {f"{name}_difference": difference, f"{name}_difference_error": error}
    return SettingResult(knobs=first.knobs, row=row)


def _log_ratios(record: Record, base: Record, cost: str) -> Float64[np.ndarray, " n"]:
    """Logarithms of a cost as a share of that of the base, in the rounds that both have."""
    a, b = record.costs(cost), base.costs(cost)
    rounds = min(len(a), len(b))
    return np.log(np.maximum(a[:rounds], 1e-9) / np.maximum(b[:rounds], 1e-9))


def estimate(scores: Sequence[Score], base: Sequence[Score] | None = None) -> tuple[float, float, float]:
    """The ratio of sums over scenes, its standard error where scenes are drawn at random (Cochran 1977, sec. 2.11), and
    the number of things: objects of one scene have its light and its clutter in common, so scenes are what is drawn.

    Args:
        base: scores of the same scenes, whose ratio is subtracted. The error is NaN for one scene.
    """
    value, residuals, things = _ratio_of_sums(scores)
    if base is not None:
        other, of_base, _ = _ratio_of_sums(base)
        value, residuals = value - other, residuals - of_base
    n = len(residuals)
    error = math.sqrt(n / (n - 1) * float((residuals**2).sum())) if n > 1 else math.nan
    return value, error, things


def _ratio_of_sums(scores: Sequence[Score]) -> tuple[float, Float64[np.ndarray, " scenes"], float]:
    """The ratio, what each scene adds to its deviation, and the number of things; NaN without things."""
    totals = np.array([each.total for each in scores], np.float64)
    counts = np.array([each.things for each in scores], np.float64)
    if not (things := float(counts.sum())):
        return math.nan, np.full(len(scores), math.nan), 0.0
    value = float(totals.sum()) / things
    return value, (totals - value * counts) / things, things


def scene_row(record: Record) -> dict[str, Any]:
    """One setting on one scene as a row of a table: medians over rounds, and each score with the things it is of."""
    row: dict[str, Any] = {"stage": record.stage, "setting": record.label, "scene": record.scene}
    row |= {name: float(np.median(record.costs(name))) for name in ("seconds", "cpu_seconds", "mib")}
    row["bytes"] = record.bytes
    for name, score in (record.scores or {}).items():
        row |= {name: score.total / score.things if score.things else math.nan, f"{name}_things": score.things}
    return row


LEAST_EFFECT = 0.02
"""A knob that changes the cost by less than this share does not matter for it, however well that is measured."""
NOISE_ERRORS = 2.0
"""An effect is noise if it is not larger than this number of standard errors."""


def effective_knobs(
    knobs: Sequence[Knob], rows: Sequence[Sequence[Record]], base: Sequence[Record], cost: str
) -> list[str]:
    """Knobs of which a value, changed alone or with what it needs, moves cost or a score by more than noise."""
    by_label = {row[0].label: row for row in rows}
    with_effect = set()
    for knob in knobs:
        for row in rows:
            others = {name: value for name, value in row[0].knobs.items() if name != knob.name}
            baseline = by_label.get(describe_values(others), base)
            changes_one = knob.name in row[0].knobs and (not others or others == dict(baseline[0].knobs))
            if changes_one and any(_is_effect(each, least) for each, least in _effects(row, baseline, cost)):
                with_effect.add(knob.name)
    return [knob.name for knob in knobs if knob.name in with_effect]


def _effects(row: Sequence[Record], base: Sequence[Record], cost: str) -> Iterator[tuple[np.ndarray, float]]:
    """Logarithms of costs, then differences of each score over scenes, each with the least that counts."""
    yield np.concatenate([_log_ratios(a, b, cost) for a, b in zip(row, base, strict=True)]), LEAST_EFFECT
    for name in HIGHER_IS_BETTER:
        pairs = [
            (a.scores[name], b.scores[name])
            for a, b in zip(row, base, strict=True)
            if a.scores and b.scores and name in a.scores and name in b.scores and a.scores[name].things
        ]
        yield np.array([a.total / a.things - b.total / b.things for a, b in pairs]), 1e-9


def _is_effect(values: np.ndarray, least: float) -> bool:
    """Whether a mean is larger than noise: than its standard error explains."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return False
    error = float(finite.std(ddof=1) / math.sqrt(len(finite))) if len(finite) > 1 else 0.0
    return abs(float(finite.mean())) > max(least, NOISE_ERRORS * error)


TEMPLATE = Path(__file__).with_name("plot.html")
DATA = "/*DATA*/"
COST_NAMES = {
    "cpu_seconds": "CPU seconds a scene",
    "seconds": "seconds a scene",
    "mib": "MiB of memory",
    "bytes": "bytes",
}


def to_json(stages: Sequence[StageResult], scaling: Sequence[Mapping[str, Any]] = ()) -> dict[str, Any]:
    """All that a sweep gave as JSON values."""
    return {
        "stages": [
            {
                "stage": each.stage.name,
                "cost": each.stage.cost,
                "accuracy": each.stage.accuracy,
                "matter": list(each.matter),
                "rungs": [
                    {"scenes": rung.scenes, "settings": len(rung.settings), "kept": len(rung.survivors)}
                    for rung in each.rungs
                ],
            }
            for each in stages
        ],
        "settings": [{**result.row, "knobs": dict(result.knobs)} for each in stages for result in each.results],
        "scores": list(HIGHER_IS_BETTER),
        "less_is_better": [name for name, higher in HIGHER_IS_BETTER.items() if not higher],
        "scaling": list(scaling),
    }


def plot_page(results: Mapping[str, Any]) -> bytes:
    """The interactive plot of `to_json`'s values as one HTML file that needs no network."""
    # In a script element `</` would end it, whatever it stands in.
    data = json.dumps(plain(results), ensure_ascii=False).replace("</", "<\\/")
    return TEMPLATE.read_text(encoding="utf-8").replace(DATA, data).encode("utf-8", "backslashreplace")


def plot_picture(stages: Sequence[StageResult]) -> bytes:
    """The same as a PNG: a panel a stage, a color for each changed knob, its value at each point, the Pareto front
    ringed."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = min(2, len(stages))
    rows = -(-len(stages) // columns)
    figure = Figure(figsize=(7.5 * columns, 5.4 * rows), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, stage in zip(panels, stages, strict=False):
        _panel(axes, stage)
    for axes in panels[len(stages) :]:
        axes.set_visible(False)
    stream = io.BytesIO()
    canvas.print_png(stream)
    return stream.getvalue()


def _panel(axes: Any, result: StageResult) -> None:
    """Draws the settings of a stage whose accuracy is a number."""
    stage = result.stage
    settings = [each for each in result.results if not math.isnan(each.score(stage.accuracy))]
    colors: dict[str, str] = {}
    for each in settings:
        group, point = _group(each), (each.score(stage.cost), each.score(stage.accuracy))
        is_base, is_new = not each.knobs, group not in colors
        axes.scatter(
            *point,
            s=160 if is_base else 30,
            marker="*" if is_base else "o",
            color=colors.setdefault(group, f"C{len(colors)}"),
            label=group if is_new else None,
            zorder=3,
        )
        if each.row["on_front"]:
            axes.scatter(*point, s=180, facecolors="none", edgecolors="black", linewidths=1.1, zorder=4)
        if not is_base and each.row["phase"] != "joint":
            text = ", ".join(map(str, each.knobs.values()))
            axes.annotate(text, point, xytext=(6, 4), textcoords="offset points", fontsize=7)
    axes.set_xlabel(COST_NAMES[stage.cost])
    axes.set_ylabel(stage.accuracy + (" (more is better)" if HIGHER_IS_BETTER[stage.accuracy] else " (less is better)"))
    axes.set_title(f"{stage.name} (ringed: on the Pareto front)")
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter(lambda value, _: f"{value:g}" if f"{value:e}"[0] in "235" else "")
    axes.grid(alpha=0.3)
    axes.set_axisbelow(True)
    if settings:
        axes.legend(fontsize=7)


def _group(result: SettingResult) -> str:
    if not result.knobs:
        return "defaults"
    return next(iter(result.knobs)) if len(result.knobs) == 1 else "several"
