"""Measuring settings of a stage on scenes: warm-up, repeats, and an order that spreads other load over all of them."""

import json
import time
import warnings
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from gsencoder.core.errors import InputError, SceneWarning, readable
from gsencoder.core.files import MODEL_BYTES, is_full_disk, read_foreign, write_bytes
from gsencoder.core.process import Track, memory_growth, untracked
from gsencoder.core.settings import describe_values, with_knobs
from gsencoder.evaluate.tradeoff.stages import Score, Scores, Stage

RECORDS_FILE = "measured.jsonl"
Knobs = Mapping[str, Any]
"""Values of knobs that differ from the stage's base; empty = the base."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Timing:
    """One timed run: wall-clock time, CPU time of all threads, and growth of peak memory, NaN where the system does not
    report it."""

    seconds: float
    cpu_seconds: float
    mib: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Record:
    """What was measured of one setting on one scene: one timing a round, and the worth of its product, None until it
    has been judged."""

    stage: str
    scene: str
    knobs: Knobs
    timings: tuple[Timing, ...] = ()
    scores: Scores | None = None
    bytes: int = 0

    @property
    def label(self) -> str:
        return describe_values(self.knobs)

    def costs(self, kind: str) -> Float64[np.ndarray, " n"]:
        """A cost in each round; bytes are the same in all."""
        return np.array([self.bytes] if kind == "bytes" else [getattr(each, kind) for each in self.timings], np.float64)


class Records:
    """Records by stage, scene and knobs; where there is a folder, each measurement is written to a file of it at once.

    The first line of the file is what runs must share to be one sweep. Each other one is one timing of a setting, or
    what its product is worth.
    """

    def __init__(self, folder: Path | None = None, identity: Mapping[str, Any] = {}) -> None:
        """Args:
        folder: holds what an earlier run of the same sweep measured, or nothing; None = nothing is written.
        """
        self._by_key: dict[tuple[str, str, str], Record] = {}
        self._path = None if folder is None else folder / RECORDS_FILE
        self._identity = json.dumps(identity, sort_keys=True).encode()
        if self._path is None or not self._path.is_file():
            return
        with readable(self._path):
            content = read_foreign(self._path, MODEL_BYTES)
        # A kill may have left an incomplete last line, which is measured again.
        complete, newline, rest = content.rpartition(b"\n")
        first, *lines = complete.splitlines() or [b""]
        if first != self._identity:
            raise InputError(
                f"{folder}: holds measurements of a sweep with other settings; give resume=false to start again, or "
                "another out="
            )
        for number, line in enumerate(lines, start=2):
            try:
                self._take(json.loads(line))
            except (ValueError, KeyError, TypeError, AttributeError) as error:
                raise InputError(
                    f"{self._path}: line {number} is damaged ({error}); give resume=false to start again"
                ) from error
        if rest:
            write_bytes(self._path, complete + newline)

    def __len__(self) -> int:
        return len(self._by_key)

    def get(self, stage: str, scene: str, knobs: Knobs) -> Record:
        """What was measured of a setting on a scene; an empty record if nothing was. The order of knobs does not
        count."""
        key = stage, scene, json.dumps(knobs, sort_keys=True)
        return self._by_key.get(key, Record(stage=stage, scene=scene, knobs=dict(knobs)))

    def add(self, stage: str, scene: str, knobs: Knobs, value: Timing | tuple[Scores, int]) -> None:
        """Adds a timed run, or what a product is worth."""
        line: dict[str, Any] = {"stage": stage, "scene": scene, "knobs": knobs}
        if isinstance(value, Timing):
            line["timing"] = asdict(value)
        else:
            line |= {"scores": value[0], "bytes": value[1]}
        self._take(line)
        if self._path is None:
            return
        if not self._path.is_file():
            write_bytes(self._path, self._identity + b"\n")
        try:
            # The file is closed after every line, so that a kill loses none.
            with self._path.open("ab") as stream:
                stream.write(json.dumps(line, default=float).encode() + b"\n")
        except OSError as error:
            problem = "no space left on the device" if is_full_disk(error) else error.strerror or error
            raise InputError(f"{self._path}: cannot write: {problem}") from error

    def _take(self, line: Mapping[str, Any]) -> None:
        stage, scene, knobs = line["stage"], line["scene"], line["knobs"]
        record = self.get(stage, scene, knobs)
        if "timing" in line:
            record = replace(record, timings=(*record.timings, Timing(**line["timing"])))
        else:
            scores = {name: Score(*score) for name, score in line["scores"].items()}
            record = replace(record, scores=scores, bytes=int(line["bytes"]))
        self._by_key[stage, scene, json.dumps(knobs, sort_keys=True)] = record


def interleaved(settings: int, rounds: int, seed: int) -> Iterator[tuple[int, int]]:
    """Round and setting of each timed run: every round takes all settings once, in an order of its own, so that load
    that comes and goes meets no setting more than another."""
    generator = np.random.default_rng(seed)
    for number in range(rounds):
        yield from ((number, int(setting)) for setting in generator.permutation(settings))


def timed_run(run: Callable[[], Any]) -> Timing:
    """The time and memory of one run, whose product is dropped."""
    with memory_growth() as growth:
        start, cpu = time.perf_counter(), time.process_time()
        product = run()
        seconds, cpu_seconds = time.perf_counter() - start, time.process_time() - cpu
    del product
    return Timing(seconds=seconds, cpu_seconds=cpu_seconds, mib=growth.mib)


def measure(
    stage: Stage,
    paths: Sequence[Path],
    settings: Sequence[Knobs],
    records: Records,
    *,
    rounds: int = 3,
    track: Track = untracked,
) -> list[list[Record]]:
    """Measures settings on scenes, whose names are the last parts of their paths; what is in the records already is not
    measured again.

    Each setting is first run once without being timed, and its product judged: that run loads what is loaded on first
    use. Then come the timed rounds (`interleaved`).

    Returns:
        For each setting its record on each scene.
    """
    for path in track(list(paths), f"{stage.name}: scenes"):
        found = [records.get(stage.name, path.name, knobs) for knobs in settings]
        unfinished = [
            (with_knobs(stage.base, stage.knobs, each.knobs), each.knobs)
            for each in found
            if each.scores is None or len(each.timings) < rounds
        ]
        if not unfinished:
            continue
        with stage.open(path) as (run, judge), warnings.catch_warnings():
            for values, knobs in track(unfinished, f"{stage.name}: scores"):
                if knobs:
                    # Warnings of the base are printed, and nearly all others repeat them.
                    warnings.simplefilter("ignore", SceneWarning)
                product = run(values)
                if records.get(stage.name, path.name, knobs).scores is None:
                    records.add(stage.name, path.name, knobs, judge(product, values))
            warnings.simplefilter("ignore", SceneWarning)
            # Each scene has an order of its own.
            order = list(interleaved(len(unfinished), rounds, zlib.crc32(f"0 {path.name}".encode())))
            for number, index in track(order, f"{stage.name}: runs"):
                values, knobs = unfinished[index]
                # An interrupted sweep has timed some already.
                if len(records.get(stage.name, path.name, knobs).timings) <= number:
                    records.add(stage.name, path.name, knobs, timed_run(partial(run, values)))
    return [[records.get(stage.name, path.name, knobs) for path in paths] for knobs in settings]
