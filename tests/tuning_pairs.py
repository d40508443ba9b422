"""Questions with answers and pictures of noise, and a tiny model, that tests of tuning stand on."""

import io
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from tiny_vlm import SIDE, save_tiny_vlm

from gsencoder.data.prompts import PromptStore
from gsencoder.train.loop import TrainerConfig
from gsencoder.train.tune import PairSamples, TuneConfig, TuningPair, TuningSample, open_processor
from gsencoder.train.vlm import AdapterConfig

THINGS = ("mug", "chair", "box", "crate", "lamp")
ANSWERS = ("red", "green", "2", "yes")
SPREAD = 10.0
SHORT = TuneConfig(
    lora=AdapterConfig(rank=4, alpha=8.0, dropout=0.0),
    train=TrainerConfig(steps=8, batch=2, learning_rate=0.01, warmup=2, log_every=1, validate_every=0),
)


def png(seed: int, width: int = SIDE, height: int = 48) -> bytes:
    """A picture of noise."""
    held = io.BytesIO()
    pixels = np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(held, format="png")
    return held.getvalue()


def make_pairs(
    folder: Path, count: int = 20, *, pictures: int = 1, tokens: np.ndarray | None = None
) -> tuple[list[TuningPair], PromptStore]:
    """Questions about things and properties, each with an answer of its own."""
    folder.mkdir(parents=True, exist_ok=True)
    store, pairs = PromptStore(folder), []
    for number in range(count):
        text = f"Question: what is number {number // 5} of the {THINGS[number % 5]}?"
        shown = [png(number % 5 + 10 * each) for each in range(pictures)]
        features = None if tokens is None else (tokens + 0.1 * number).astype(np.float16)
        prompt = store.add(f"key {number}", text, shown, features, "" if tokens is None else "space")
        answer = ANSWERS[(number + number // 5) % len(ANSWERS)]
        pairs.append(TuningPair(name=f"question {number}", prompt=prompt, answers=(answer,)))
    return pairs, store


def make_model(folder: Path) -> Path:
    """The tiny model, whose output layer lets an answer become likely."""
    save_tiny_vlm(folder, SPREAD)
    return folder


Pairs = tuple[list[TuningPair], PromptStore]


def samples(pairs: Pairs, model: Path, **changes: Any) -> PairSamples:
    _, processor, _ = open_processor(model)
    return PairSamples(pairs[0], pairs[1], processor, **({"longest": None, "seed": 0} | changes))


def sample(data: PairSamples, number: int = 0) -> TuningSample:
    pair = data.pairs[number]
    return data.sample(pair, pair.answers[0])
