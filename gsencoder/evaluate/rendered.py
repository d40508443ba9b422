"""How far rendered features are from a teacher's own (M3 table 1): cosine, squared distance, and what is not finite."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

EPS = 1e-12


@dataclass(frozen=True, slots=True, kw_only=True)
class RenderedErrors:
    """Means over the cells of all pictures.

    Attributes:
        cosine: of features as they are. M3 prints 1 − cosine.
        centered: after the mean of the space has been subtracted from both.
        l2: squared distance, averaged over channels.
        cells: that were compared.
        pictures: that were compared.
        not_finite: pictures that were left out because a feature in them was not finite.
    """

    cosine: float
    centered: float
    l2: float
    cells: int
    pictures: int
    not_finite: int


class RenderedTally:
    """Adds up the errors of pictures."""

    def __init__(self, mean: Float32[np.ndarray, " D"]) -> None:
        """Args:
        mean: of the space.
        """
        self._mean = mean
        self._sums, self._cells, self._pictures, self._not_finite = np.zeros(3), 0, 0, 0

    def add(self, predicted: Float32[np.ndarray, "n D"], target: Float32[np.ndarray, "n D"]) -> None:
        """Takes the cells of one picture; a picture with a feature that is not finite is counted and left out."""
        if not (np.isfinite(predicted).all() and np.isfinite(target).all()):
            self._not_finite += 1
            return
        difference = predicted.astype(np.float64) - target
        self._sums += (
            _cosines(predicted, target).sum(),
            _cosines(predicted - self._mean, target - self._mean).sum(),
            (difference**2).mean(axis=1).sum() if len(target) else 0.0,
        )
        self._cells, self._pictures = self._cells + len(target), self._pictures + 1

    def errors(self) -> RenderedErrors:
        """The means; NaN where no cell was compared."""
        means = self._sums / self._cells if self._cells else np.full(3, np.nan)
        cosine, centered, l2 = means.tolist()
        return RenderedErrors(
            cosine=cosine,
            centered=centered,
            l2=l2,
            cells=self._cells,
            pictures=self._pictures,
            not_finite=self._not_finite,
        )


def _cosines(a: Float32[np.ndarray, "n D"], b: Float32[np.ndarray, "n D"]) -> np.ndarray:
    first, second = a.astype(np.float64), b.astype(np.float64)
    products = (first * second).sum(axis=1)
    return np.asarray(products / np.sqrt(((first**2).sum(axis=1) + EPS) * ((second**2).sum(axis=1) + EPS)))
