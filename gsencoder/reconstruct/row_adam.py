"""Adam over selected rows of its parameters: those in view, so that the cost of a step is that of the view."""

from collections.abc import Mapping
from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Int64
from torch import Tensor

from gsencoder.core.process import PIECES, kernel, parallel

BETAS = (0.9, 0.999)
EPS = 1e-15


@kernel
@no_type_check
def _step(first, last, rows, grads, values, averages, squares, rate, correction, beta1, rest1, beta2, rest2, eps):
    for k in range(first, last):
        row, grad = rows[k], grads[k]
        value, average, square = values[row], averages[row], squares[row]
        for c in range(len(value)):
            g = grad[c]
            average[c] = beta1 * average[c] + rest1 * g
            square[c] = beta2 * square[c] + rest2 * g * g
            value[c] -= rate * average[c] / (np.sqrt(square[c]) * correction + eps)


class RowAdam:
    """Adam (Kingma & Ba 2015) over rows; as torch's SparseAdam, moments of rows that have no gradient do not decay.

    Attributes:
        averages: first moments by parameter.
        squares: second moments by parameter.
        steps: steps that were taken.
    """

    KINDS = ("parameters", "averages", "squares")

    def __init__(self, parameters: Mapping[str, Tensor]) -> None:
        """Args:
        parameters: float32 tensors of N rows each, stepped in place.
        """
        self.parameters = dict(parameters)
        self.averages = {name: torch.zeros_like(value) for name, value in parameters.items()}
        self.squares = {name: torch.zeros_like(value) for name, value in parameters.items()}
        self.steps = 0

    @classmethod
    def restored(cls, tables: Mapping[str, Mapping[str, Tensor]], steps: int) -> "RowAdam":
        """One that stands where `tables` of another, and its steps, were taken."""
        restored = cls(tables["parameters"])
        restored.averages, restored.squares = dict(tables["averages"]), dict(tables["squares"])
        restored.steps = steps
        return restored

    def tables(self) -> dict[str, dict[str, Tensor]]:
        """Parameters and moments."""
        return dict(zip(self.KINDS, (self.parameters, self.averages, self.squares), strict=True))

    def step(self, rows: Int64[Tensor, " n"], grads: Mapping[str, Tensor], rates: Mapping[str, float]) -> None:
        """One step.

        Args:
            rows: which rows have gradients; distinct.
            grads: of those rows, by parameter.
            rates: learning rate by parameter.
        """
        self.steps += 1
        first, second = (1 - beta**self.steps for beta in BETAS)
        for name, grad in grads.items():
            tables = (self.parameters[name], self.averages[name], self.squares[name])
            rate, correction = rates[name] / first, second**-0.5
            update = self._on_cpu if grad.device.type == "cpu" else self._plain
            update(rows, grad, *tables, rate, correction)

    @staticmethod
    def _plain(
        rows: Tensor, grad: Tensor, value: Tensor, average: Tensor, square: Tensor, rate: float, correction: float
    ) -> None:
        average[rows] = average[rows].lerp(grad, 1 - BETAS[0])
        square[rows] = square[rows].lerp(grad * grad, 1 - BETAS[1])
        value[rows] -= rate * average[rows] / (square[rows].sqrt() * correction + EPS)

    @staticmethod
    def _on_cpu(
        rows: Tensor, grad: Tensor, value: Tensor, average: Tensor, square: Tensor, rate: float, correction: float
    ) -> None:
        tables = [array.reshape(len(array), -1).numpy() for array in (grad.contiguous(), value, average, square)]
        # As numbers of the arrays' own type all arithmetic stays in it; 1 − 0.999 must be rounded once, and at the end.
        first, second = BETAS
        exact = (rate, correction, first, 1 - first, second, 1 - second, EPS)
        numbers = [tables[0].dtype.type(number) for number in exact]
        cuts = np.linspace(0, len(rows), PIECES + 1).astype(np.int64)
        arrays = (rows.numpy(), *tables, *numbers)
        parallel(lambda piece: _step(cuts[piece], cuts[piece + 1], *arrays), range(PIECES))

    def keep(self, rows: Int64[Tensor, " n"]) -> None:
        """Drops all rows but these, of parameters and moments."""
        for table in self.tables().values():
            for name, value in table.items():
                table[name] = value[rows].contiguous()
