"""Measuring settings of a stage on scenes: warm-up, repeats, and an order that spreads other load over all of them."""

import time
import warnings
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsencoder.core.errors import SceneWarning
from gsencoder.core.process import Track, memory_growth, untracked
from gsencoder.core.settings import with_knobs
from gsencoder.evaluate.tradeoff.records import Record, Records, Timing
from gsencoder.evaluate.tradeoff.stage import Stage, StageScene

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
