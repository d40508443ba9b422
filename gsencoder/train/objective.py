"""The loss of a step: weighted terms, each a sum over the micro-batches of all processes, divided once.

term = Σ total / Σ divisor,     loss = Σ lambda · term
"""

import math
from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float64
from torch import Tensor, nn

from gsencoder.core.errors import InputError
from gsencoder.train.distributed import STOPPED_ELSEWHERE, sum_over_processes

NO_WEIGHT = 1e-12
"""Divisor of a term that nothing in a step has a weight for."""


@runtime_checkable
class TrainingBatch(Protocol):
    """A batch of samples.

    Attributes:
        names: of the samples, for messages.
    """

    @property
    def names(self) -> Sequence[str]: ...

    def to(self, device: torch.device) -> "TrainingBatch": ...


@runtime_checkable
class Objective(Protocol):
    """The loss of a network as weighted terms. In a step each term is Σ total / Σ divisor, summed over all
    micro-batches of all processes.

    Attributes:
        network: the network to call, possibly compiled or wrapped for several processes.
        lambdas: the weights of the terms that are not 0, by name.
        advice: for the error where no term has a divisor above 0: what the user should check.
    """

    network: nn.Module

    @property
    def lambdas(self) -> dict[str, float]: ...

    @property
    def advice(self) -> str: ...

    def divisors(self, batch: Any) -> dict[str, float]:
        """The sum of the weights of a batch's rows, for each term."""
        ...

    def __call__(self, batch: Any) -> dict[str, Tensor]:
        """The totals of the terms whose weight is not 0."""
        ...


def sum_divisors(
    objective: Objective, items: Sequence[TrainingBatch | InputError], device: torch.device
) -> tuple[list[TrainingBatch], dict[str, float]]:
    """Separates the batches of a step from errors, and sums the divisors of its loss terms over all processes.

    Args:
        objective: gives the divisors of a batch.
        items: micro-batches of this process, or the errors of their samples.
        device: of this process.

    Returns:
        The batches, and for each term its divisor, at least `NO_WEIGHT`.

    Raises:
        InputError: a sample could not be made, here or on another process, or no term has a weight.
    """
    batches = [item for item in items if not isinstance(item, InputError)]
    lambdas = objective.lambdas
    batch_divisors = [objective.divisors(batch) for batch in batches]
    sums = [sum(divisors[name] for divisors in batch_divisors) for name in lambdas]
    failed = len(items) - len(batches)
    totals = sum_over_processes(torch.tensor([*sums, failed], dtype=torch.float64, device=device)).tolist()
    for item in items:
        if isinstance(item, InputError):
            raise item
    if totals[-1]:
        raise InputError(STOPPED_ELSEWHERE)
    if not any(totals[:-1]):
        names = "; ".join(name for batch in batches for name in batch.names)
        raise InputError(
            f"training: there is nothing to compare in {names}: no Gaussian has a target with a weight, and no "
            f"cell of the teacher passes the thresholds; check {objective.advice}, and these scenes"
        )
    return batches, {name: max(total, NO_WEIGHT) for name, total in zip(lambdas, totals, strict=False)}


def finite_terms(
    step: int,
    batches: Sequence[TrainingBatch],
    names: Sequence[str],
    micro_terms: Float64[Tensor, "micro terms"],
    norm: float,
    *,
    processes: int,
) -> dict[str, float]:
    """The loss terms of a step over all processes, by name.

    Args:
        step: number of the step, for messages.
        batches: micro-batches of this process.
        names: of the terms.
        micro_terms: what each micro-batch adds to each term.
        norm: norm of the gradient, which is summed over all processes.
        processes: their number.

    Raises:
        InputError: a loss of any process, or the gradient, is not finite.
    """
    bad_loss = bad_gradient = ""
    for batch, row in zip(batches, micro_terms.tolist(), strict=True):
        for name, value in zip(names, row, strict=True):
            if not math.isfinite(value):
                bad_loss = bad_loss or f"the {name} loss of {'; '.join(batch.names)}"
    if not bad_loss and not math.isfinite(norm):
        # Gradients are already summed over processes, so samples of any of them may be the cause.
        samples = "; ".join(name for batch in batches for name in batch.names)
        bad_gradient = f"the gradient of {samples}{' or of samples of other processes' if processes > 1 else ''}"
    flags = micro_terms.new_tensor([float(bool(bad_loss)), float(bool(bad_gradient))])
    *totals, bad_losses, bad_gradients = sum_over_processes(torch.cat((micro_terms.sum(dim=0), flags))).tolist()
    if bad_losses or bad_gradients:
        # A loss identifies the samples that cause it; the gradient is named only if all losses are finite.
        where = bad_loss or ("a loss of another process" if bad_losses else bad_gradient)
        raise InputError(
            f"training: {where} is not finite at step {step}; parameters were not changed. Use a lower "
            "learning_rate, or check these scenes (`gsencoder inspect`)"
        )
    return dict(zip(names, totals, strict=True))
