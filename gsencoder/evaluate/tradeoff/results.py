"""Records of several scenes as one result a setting: medians with their spread, scores with their standard errors."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float64

from gsencoder.core.errors import InputError
from gsencoder.core.settings import describe_values
from gsencoder.evaluate.tradeoff.pareto import on_front
from gsencoder.evaluate.tradeoff.records import Record
from gsencoder.evaluate.tradeoff.stage import HIGHER_IS_BETTER, Cost, Score

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


def pick_within(results: Sequence[SettingResult], seconds: float | None, error: float | None) -> SettingResult:
    """Picks the cheapest setting within a limit of error, or with one of seconds alone the most exact within it.

    Args:
        results: of one stage that gives an error.
        seconds: largest wall-clock seconds; None = any.
        error: largest error against the exact reference; None = any.

    Raises:
        InputError: no setting is within the limits; the fastest and the most exact are named.
    """
    affordable = [
        result
        for result in results
        if (seconds is None or result.seconds <= seconds) and (error is None or result.score("error") <= error)
    ]
    if not affordable:
        fastest = min(results, key=lambda result: result.seconds)
        most_exact = min(results, key=lambda result: result.score("error"))
        raise InputError(
            f"budget: no setting is within it; the fastest ({fastest.label}) takes {fastest.seconds:.3g} s at an error "
            f"of {fastest.score('error'):.3g}, the most exact ({most_exact.label}) {most_exact.seconds:.3g} s at "
            f"{most_exact.score('error'):.3g}"
        )
    if error is None:
        return min(affordable, key=lambda result: (result.score("error"), result.seconds))
    return min(affordable, key=lambda result: (result.cpu_seconds, result.score("error")))
