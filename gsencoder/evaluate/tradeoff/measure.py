"""Measuring settings of a stage on scenes: warm-up, repeats, and an order that spreads other load over all of them.

Power laws of cost, cost = constant · size^exponent, by least squares of logarithms.

Costs that do not grow with a size, and what is constant, pull an exponent down at small sizes: it holds for the sizes
that were measured.
"""

import json
import math
import time
import warnings
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from gsencoder.core.errors import InputError, SceneWarning, readable
from gsencoder.core.files import MODEL_BYTES, is_full_disk, plain, read_foreign, write_bytes
from gsencoder.core.process import Track, memory_growth, untracked
from gsencoder.core.settings import describe_values, with_knobs
from gsencoder.evaluate.tradeoff.stage import Judged, Score, Stage, StageScene

RECORDS_FILE, IDENTITY_FILE = "measured.jsonl", "sweep.json"


@dataclass(frozen=True, slots=True, kw_only=True)
class Timing:
    """One timed run.

    Attributes:
        seconds: wall-clock time.
        cpu_seconds: of all threads of the process.
        mib: growth of peak resident memory; NaN where the system does not report it.
    """

    seconds: float
    cpu_seconds: float
    mib: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Record:
    """What was measured of one setting on one scene.

    Attributes:
        stage: its name.
        scene: its name.
        knobs: the values that differ from the stage's base.
        timings: one a round.
        judged: None until its product has been judged.
    """

    stage: str
    scene: str
    knobs: Mapping[str, Any]
    timings: tuple[Timing, ...] = ()
    judged: Judged | None = None

    @property
    def label(self) -> str:
        return describe_values(self.knobs)

    @property
    def scores(self) -> Mapping[str, Score]:
        return {} if self.judged is None else self.judged.scores

    @property
    def bytes(self) -> int:
        return 0 if self.judged is None else self.judged.bytes

    def is_complete(self, rounds: int) -> bool:
        return self.judged is not None and len(self.timings) >= rounds


def record_key(stage: str, scene: str, knobs: Mapping[str, Any]) -> tuple[str, str, str]:
    """What tells records apart: the order of the knobs does not."""
    return stage, scene, json.dumps(plain(dict(knobs)), sort_keys=True)


class Records:
    """Records by stage, scene and knobs; where there is a folder, each measurement is written to a file of it at once.

    A line of the file is one timing of a setting, or what its product is worth.
    """

    def __init__(self, folder: Path | None = None, identity: Mapping[str, Any] = {}) -> None:
        """Args:
        folder: holds what an earlier run of the same sweep measured, or nothing; None = nothing is written.
        identity: what runs must share to be one sweep, as JSON values.

        Raises:
            InputError: the folder holds records of another sweep, or damaged ones. One in which nothing was measured is
                of no sweep.
        """
        self._by_key: dict[tuple[str, str, str], Record] = {}
        self._path = None if folder is None else folder / RECORDS_FILE
        if folder is None:
            return
        self._identity = json.dumps(plain(dict(identity)), sort_keys=True).encode()
        path = folder / IDENTITY_FILE
        with readable(path):
            other = path.is_file() and read_foreign(path) != self._identity
        if other and (folder / RECORDS_FILE).is_file():
            raise InputError(
                f"{folder}: holds measurements of a sweep with other settings; give resume=false to begin anew, or "
                "another out="
            )
        self._read()

    def _read(self) -> None:
        assert self._path is not None
        if not self._path.is_file():
            return
        # A kill may have left an incomplete last line, which is measured again.
        with readable(self._path):
            complete = read_foreign(self._path, MODEL_BYTES).rpartition(b"\n")
        lines = complete[0].splitlines()
        for number, line in enumerate(lines, start=1):
            try:
                values = json.loads(line)
                key = values["stage"], values["scene"], values["knobs"]
                if "timing" in values:
                    numbers = {name: _number(value) for name, value in values["timing"].items()}
                    self._add_timing(*key, Timing(**numbers))
                else:
                    scores = {name: Score(*map(_number, score)) for name, score in values["scores"].items()}
                    self._add_judged(*key, Judged(scores=scores, bytes=int(values["bytes"])))
            except (ValueError, KeyError, TypeError, AttributeError) as error:
                raise InputError(
                    f"{self._path}: line {number} is damaged ({error}); give resume=false to begin anew"
                ) from error
        if complete[2]:
            write_bytes(self._path, b"".join(line + b"\n" for line in lines))

    def __len__(self) -> int:
        return len(self._by_key)

    def get(self, stage: str, scene: str, knobs: Mapping[str, Any]) -> Record:
        """What was measured of a setting on a scene; an empty record if nothing was."""
        empty = Record(stage=stage, scene=scene, knobs=dict(knobs))
        return self._by_key.get(record_key(stage, scene, knobs), empty)

    def add_timing(self, stage: str, scene: str, knobs: Mapping[str, Any], timing: Timing) -> None:
        """Adds a timed run.

        Raises:
            InputError: the disk is full.
        """
        self._add_timing(stage, scene, knobs, timing)
        self._append({"stage": stage, "scene": scene, "knobs": knobs, "timing": asdict(timing)})

    def add_judged(self, stage: str, scene: str, knobs: Mapping[str, Any], judged: Judged) -> None:
        """Adds what a product is worth.

        Raises:
            InputError: the disk is full.
        """
        self._add_judged(stage, scene, knobs, judged)
        scores = {name: list(score) for name, score in judged.scores.items()}
        self._append({"stage": stage, "scene": scene, "knobs": knobs, "scores": scores, "bytes": judged.bytes})

    def _add_timing(self, stage: str, scene: str, knobs: Mapping[str, Any], timing: Timing) -> None:
        before = self.get(stage, scene, knobs)
        self._by_key[record_key(stage, scene, knobs)] = replace(before, timings=(*before.timings, timing))

    def _add_judged(self, stage: str, scene: str, knobs: Mapping[str, Any], judged: Judged) -> None:
        before = self.get(stage, scene, knobs)
        self._by_key[record_key(stage, scene, knobs)] = replace(before, judged=judged)

    def _append(self, line: Mapping[str, Any]) -> None:
        if self._path is None:
            return
        if not self._path.is_file():
            write_bytes(self._path.with_name(IDENTITY_FILE), self._identity)
        try:
            # The file is closed after every line, so that a kill loses none.
            with self._path.open("ab") as stream:
                stream.write(json.dumps(plain(dict(line))).encode() + b"\n")
        except OSError as error:
            problem = "no space left on the device" if is_full_disk(error) else error.strerror or error
            raise InputError(f"{self._path}: cannot write: {problem}") from error


def _number(value: float | int | None) -> float:
    """A number as it was; those that were not finite were written as null."""
    return math.nan if value is None else float(value)


Knobs = Mapping[str, Any]
"""Values of knobs that differ from the stage's base; empty = the base."""


def interleaved(settings: int, rounds: int, seed: int) -> Iterator[tuple[int, int]]:
    """Round and setting of each timed run: every round takes all settings once, in an order of its own, so that load
    that comes and goes meets no setting more than another."""
    generator = np.random.default_rng(seed)
    for number in range(rounds):
        yield from ((number, int(setting)) for setting in generator.permutation(settings))


def measure(
    stage: Stage,
    paths: Sequence[Path],
    settings: Sequence[Knobs],
    records: Records,
    *,
    rounds: int = 3,
    seed: int = 0,
    track: Track = untracked,
) -> list[list[Record]]:
    """Measures settings on scenes; what is in the records already is not measured again.

    Each setting is first run once without being timed, and its product judged: that run loads what is loaded on first
    use. Then come the timed rounds (`interleaved`).

    Args:
        stage: see there.
        paths: folders of the scenes, whose names are told apart by their last parts.
        settings: to measure.
        records: where results go, scene by scene.
        rounds: timed runs of each setting.
        seed: of the order.
        track: progress.

    Returns:
        For each setting its record on each scene.

    Raises:
        InputError: a scene cannot be used, or settings are refused.
    """
    complete = [(with_knobs(stage.base, stage.knobs, knobs), knobs) for knobs in settings]
    for path in track(list(paths), f"{stage.name}: scenes"):
        unfinished = [each for each in complete if not records.get(stage.name, path.name, each[1]).is_complete(rounds)]
        if unfinished:
            with stage.open(path) as scene:
                _measure_scene(stage, scene, path.name, unfinished, records, rounds, seed, track)
    return [[records.get(stage.name, path.name, knobs) for path in paths] for _, knobs in complete]


def _measure_scene(
    stage: Stage,
    scene: StageScene,
    name: str,
    settings: Sequence[tuple[Any, Knobs]],
    records: Records,
    rounds: int,
    seed: int,
    track: Track,
) -> None:
    for values, knobs in track(settings, f"{stage.name}: scores"):
        with warnings.catch_warnings():
            # Those of the base are shown, and nearly all others repeat them.
            if knobs:
                warnings.simplefilter("ignore", SceneWarning)
            product = scene.run(values)
            if records.get(stage.name, name, knobs).judged is None:
                records.add_judged(stage.name, name, knobs, scene.judge(product, values))
    # Each scene has an order of its own.
    order = list(interleaved(len(settings), rounds, zlib.crc32(f"{seed} {name}".encode())))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SceneWarning)
        for number, index in track(order, f"{stage.name}: runs"):
            values, knobs = settings[index]
            # An interrupted sweep has timed some already.
            if len(records.get(stage.name, name, knobs).timings) <= number:
                records.add_timing(stage.name, name, knobs, timed_run(scene, values))


def timed_run(scene: StageScene, settings: Any) -> Timing:
    """The time and memory of one run, whose product is dropped."""
    with memory_growth() as growth:
        start, cpu = time.perf_counter(), time.process_time()
        product = scene.run(settings)
        seconds, cpu_seconds = time.perf_counter() - start, time.process_time() - cpu
    del product
    return Timing(seconds=seconds, cpu_seconds=cpu_seconds, mib=growth.mib)


class Exponent(NamedTuple):
    """A power law fitted to costs.

    Attributes:
        value: the exponent.
        low, high: its 95 % confidence interval.
        constant: cost at size 1.
        points: how many costs it was fitted to.
    """

    value: float
    low: float
    high: float
    constant: float
    points: int


def fit_exponent(
    sizes: Float64[np.ndarray, " n"],
    costs: Float64[np.ndarray, " n"],
    groups: Int64[np.ndarray, " n"] | None = None,
    *,
    confidence: float = 0.95,
) -> Exponent:
    """Fits log cost = log constant + exponent · log size.

    Args:
        sizes: positive.
        costs: positive, one for each size.
        groups: a number for each pair; each group has a constant of its own, and all have the same exponent. None = one
            group.
        confidence: of the interval.

    Raises:
        InputError: fewer than three pairs more than there are constants, sizes that are all alike, or numbers that are
            not positive.
    """
    from scipy.stats import t

    x, y = sizes, costs
    if not ((x > 0) & (y > 0) & np.isfinite(x) & np.isfinite(y)).all():
        raise InputError("fit_exponent: expected positive sizes and costs")
    labels = np.zeros(len(x), np.int64) if groups is None else np.unique(groups, return_inverse=True)[1]
    free = len(x) - (int(labels.max(initial=0)) + 1) - 1
    log_x, log_y = np.log(x), np.log(y)
    centered_x, centered_y = _about_means(log_x, labels), _about_means(log_y, labels)
    moment = float((centered_x**2).sum())
    if free < 1 or not moment > 1e-12:
        raise InputError(f"fit_exponent: expected three different sizes or more, got {np.unique(sizes).tolist()}")
    value = float((centered_x * centered_y).sum() / moment)
    residuals = centered_y - value * centered_x
    half = float(t.ppf((1 + confidence) / 2, free)) * float(np.sqrt((residuals**2).sum() / free / moment))
    return Exponent(
        value=value,
        low=value - half,
        high=value + half,
        constant=float(np.exp(log_y.mean() - value * log_x.mean())),
        points=len(x),
    )


def _about_means(values: Float64[np.ndarray, " n"], labels: Int64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    sums = np.bincount(labels, values)
    return np.asarray(values - (sums / np.bincount(labels))[labels])
