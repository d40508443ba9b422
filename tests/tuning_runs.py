"""Tunings of a tiny model, their logs, and their samples."""

from pathlib import Path
from typing import Any

from gsencoder.core.logs import LOG_FILE, read_log
from gsencoder.data.prompts import PromptStore
from gsencoder.train.tune import PairSamples, TuningPair, TuningSample, open_processor

Pairs = tuple[list[TuningPair], PromptStore]


def made(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def losses(folder: Path) -> list[float]:
    return [float(row["loss"]) for row in read_log(folder / LOG_FILE)]


def samples(pairs: Pairs, model: Path, **changes: Any) -> PairSamples:
    _, processor, _ = open_processor(model)
    return PairSamples(pairs[0], pairs[1], processor, **({"longest": None, "seed": 0} | changes))


def sample(data: PairSamples, number: int = 0) -> TuningSample:
    pair = data.pairs[number]
    return data.sample(pair, pair.answers[0])
