"""How long the remaining steps will take: each kind of work that is left is timed on a few views, and counted."""

import time
from collections.abc import Callable, Sequence
from functools import partial
from itertools import groupby
from typing import NamedTuple

import numpy as np
import torch

from gsencoder.core.errors import InputError
from gsencoder.reconstruct.budget import trial_views
from gsencoder.reconstruct.optimize import Optimizer
from gsencoder.reconstruct.row_adam import RowAdam
from gsencoder.reconstruct.score import score


class ExpectedSeconds(NamedTuple):
    """Seconds that the rest of a reconstruction will take.

    Attributes:
        steps: all steps.
        other: prunings and validations.
    """

    steps: float
    other: float


def expected_seconds(optimizer: Optimizer, held_out: Sequence[int], validations: int) -> ExpectedSeconds:
    """Seconds that the remaining steps, prunings and validations will take; nothing changes.

    Gaussians that contribute nothing now will not contribute later either, and the first pruning takes them out. So it
    is done once for trial, and the steps after it are timed with what it leaves.

    Args:
        optimizer: as it is now.
        held_out: views that are validated on.
        validations: how many are left.
    """
    config, start = optimizer.config, optimizer.step
    steps = range(start, config.steps)
    if not steps:
        return ExpectedSeconds(0.0, 0.0)
    prunings = [step + 1 for step in steps if optimizer.pruning.due(step + 1, config.steps)]
    first = prunings[0] if prunings else config.steps
    stepping = other = 0.0
    state = optimizer
    # Steps of one size between two prunings are alike.
    for (pruned, shrink), group in groupby(steps, key=lambda step: (step >= first, config.shrink_at(step))):
        if pruned and state is optimizer:
            began = time.perf_counter()
            state = _pruned(optimizer)
            left = len(state.parameters["means"]) / len(optimizer.parameters["means"])
            other += (1 + (len(prunings) - 1) * left) * (time.perf_counter() - began)
        stepping += len([*group]) * _mean_seconds(trial_views(optimizer.training), partial(_step, state, shrink))
    if held_out and validations:
        renders = validations * len(held_out)
        other += renders * _mean_seconds(trial_views(held_out), lambda view: score(state, [view]))
    return ExpectedSeconds(stepping, other)


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


def _mean_seconds(views: Sequence[int], work: Callable[[int], object]) -> float:
    """Of looks at some views; the first look compiles and warms caches, and is not counted."""
    seconds = []
    for view in (views[0], *views):
        began = time.perf_counter()
        work(view)
        seconds.append(time.perf_counter() - began)
    return float(np.mean(seconds[1:]))
