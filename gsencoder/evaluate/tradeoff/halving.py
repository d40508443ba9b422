"""Successive halving (Jamieson and Talwalkar 2016) over settings: many on few scenes, the better part on more."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np

from gsencoder.core.errors import InputError
from gsencoder.evaluate.tradeoff.measure import Knobs
from gsencoder.evaluate.tradeoff.pareto import best_first

Evaluate = Callable[[Sequence[Knobs], int], Sequence[Sequence[float]]]
"""Costs of settings on the first so many scenes, one row each; less is better in every column."""
LEAST = 4
"""Settings that go on from any rung: a front of cost and accuracy has two ends, and something between them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HalvingConfig:
    """How the knobs that matter are changed together."""

    settings: int = field(
        default=0, metadata={"help": "combinations of the knobs that matter that are tried together; 0 = none"}
    )
    keep: float = field(default=1 / 3, metadata={"help": "share of the settings that the next, longer rung takes over"})
    first: int = field(default=1, metadata={"help": "scenes of the first rung; each rung has 1 / keep times as many"})

    def __post_init__(self) -> None:
        for name, least in (("settings", 0), ("first", 1)):
            if getattr(self, name) < least:
                raise InputError(f"{name}: expected {least} or more, got {getattr(self, name)}")
        if not 0 < self.keep < 1:
            raise InputError(f"keep: expected a share between 0 and 1, got {self.keep}")


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
        survivors = order if last else order[: max(LEAST, math.ceil(config.keep * len(order) - 1e-9))]
        rungs.append(Rung(scenes=count, settings=tuple(current), survivors=tuple(survivors)))
        if last:
            break
        current, count = survivors, min(scenes, max(count + 1, round(count / config.keep)))
    return rungs
