"""How long steps take: each kind of work that is left is timed on a few views, and counted; while steps are done the
clock corrects it."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from math import inf
from typing import NamedTuple

import numpy as np
import torch

from gsencoder.core.errors import InputError
from gsencoder.reconstruct.budget import trial_views
from gsencoder.reconstruct.optimize import Optimizer
from gsencoder.reconstruct.optimize_config import OptimizeConfig
from gsencoder.reconstruct.prune import PruneConfig
from gsencoder.reconstruct.row_adam import RowAdam
from gsencoder.reconstruct.score import score


class ExpectedSeconds(NamedTuple):
    """Seconds that a part of a reconstruction will take.

    Attributes:
        steps: all steps.
        other: prunings and validations.
    """

    steps: float
    other: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Costs:
    """Seconds of each kind of work, measured between two steps.

    Attributes:
        step: number of steps that were done.
        steps: of a step, by the factor that makes photographs smaller and whether the next pruning was before it.
        prunings: of the next pruning, and of each after it.
        validation: of one.
        picture: of a render beside a held-out photograph.
    """

    step: int
    steps: Mapping[tuple[int, bool], float]
    prunings: tuple[float, float]
    validation: float
    picture: float

    def expected(
        self, config: OptimizeConfig, prune: PruneConfig, start: int, stop: int, validations: int
    ) -> ExpectedSeconds:
        """Seconds that the steps from `start` to `stop` take, with their prunings and so many validations."""
        stepping, other, pruned = 0.0, validations * self.validation, False
        for step in range(self.step, stop):
            if step >= start:
                stepping += self.steps.get((config.shrink_at(step), pruned), max(self.steps.values()))
            if prune.due(step + 1, config):
                other += self.prunings[pruned] if step >= start else 0
                pruned = True
        return ExpectedSeconds(stepping, other)


def measured_costs(optimizer: Optimizer, held_out: Sequence[int], limit: float = inf) -> Costs:
    """What the remaining work costs; nothing changes.

    Gaussians that contribute nothing now will not contribute later either, and the first pruning takes them out. So it
    is done once for trial, and the steps after it are timed with what it leaves.

    Args:
        optimizer: as it is now.
        held_out: views that are validated on.
        limit: seconds that go into each kind of work, which is done twice at least.
    """
    config, state, prunings, pruned = optimizer.config, optimizer, (0.0, 0.0), False
    steps: dict[tuple[int, bool], float] = {}
    for step in range(optimizer.step, config.steps):
        kind = (config.shrink_at(step), pruned)
        if kind not in steps:
            steps[kind] = _mean_seconds(trial_views(optimizer.training), partial(_step, state, kind[0]), limit)
        if not pruned and optimizer.pruning.due(step + 1, config):
            began, pruned = time.perf_counter(), True
            state = _pruned(optimizer)
            seconds = time.perf_counter() - began
            prunings = (seconds, seconds * len(state.parameters["means"]) / len(optimizer.parameters["means"]))
    picture = _mean_seconds(trial_views(held_out), lambda view: score(optimizer, [view]), limit) if held_out else 0.0
    validation = len(held_out) * picture
    return Costs(step=optimizer.step, steps=steps, prunings=prunings, validation=validation, picture=picture)


class Pace:
    """How many steps there is time for, by a clock that is looked at whenever a quarter of the time has gone that was
    left at the look before."""

    LOOKS, CHANGE = 0.25, 0.02

    def __init__(self, costs: Costs, until: float, elapsed: Callable[[], float]) -> None:
        """Args:
        costs: measured at the step where the run begins or goes on.
        until: seconds that may have gone after the last step.
        elapsed: seconds that have gone.
        """
        self.costs, self.until, self.elapsed = costs, until, elapsed
        self._looked = (costs.step, elapsed())

    def steps(self, optimizer: Optimizer, validates: Callable[[int, int], bool], most: int) -> int:
        """The number of all steps; that of the plan where the clock is not looked at, or where it is about right.

        What was done since the last look took so many times longer than expected, and so will the rest.

        Args:
            optimizer: between two steps.
            validates: whether is validated after a step of so many.
            most: number of steps.
        """
        now, (last, then) = self.elapsed(), self._looked
        config, step = optimizer.config, optimizer.step
        if now - then < self.LOOKS * (self.until - then) or step == last:
            return config.steps
        self._looked = (step, now)
        done, rest = (
            self.costs.expected(
                config, optimizer.pruning, *part, sum(validates(each + 1, config.steps) for each in range(*part))
            )
            for part in ((last, step), (step, config.steps))
        )
        slowness = (now - then) / max(sum(done), 1e-9)
        left = (self.until - now) / max(slowness, 1e-9) - rest.other
        steps = min(step + max(1, int(left * (config.steps - step) / rest.steps)), most)
        return steps if abs(steps - config.steps) >= max(1, self.CHANGE * (config.steps - step)) else config.steps


def _pruned(optimizer: Optimizer) -> Optimizer:
    try:
        return optimizer.restricted(optimizer.contributing())
    except InputError:
        # Nothing would be left now; the steps until then may change that.
        return optimizer


def _step(optimizer: Optimizer, shrink: int, view: int) -> None:
    """What a step does, on a copy of the rows that it changes."""
    _, rows, grads, _ = optimizer.gradients(view, shrink)
    if len(rows):
        seen = RowAdam({name: value[rows] for name, value in optimizer.parameters.items()})
        seen.step(torch.arange(len(rows), device=rows.device), grads, dict.fromkeys(grads, 0.0))


def _mean_seconds(views: Sequence[int], work: Callable[[int], object], limit: float) -> float:
    """Of looks at some views, as many as the limit allows and one at least; a first one compiles and warms caches, and
    is not counted."""
    seconds: list[float] = []
    for view in (views[0], *views):
        began = time.perf_counter()
        work(view)
        seconds.append(time.perf_counter() - began)
        if sum(seconds[1:]) > max(limit, 0.0):
            break
    return float(np.mean(seconds[1:]))
