"""The error between two sets of features on the same Gaussians."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError
from gsencoder.types import GaussianFeatures

DEFAULT_SAMPLE = 20_000
CHUNK = 4096
JUDGED = 0.1
"""Share of the seen Gaussians on which a promised error is measured."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldError:
    """One field held against a more accurate one; each seen Gaussian counts the same, however much it was seen.

    Attributes:
        centered: 1 − mean cosine after each field's own mean is taken off, over Gaussians that both saw.
        raw: the same without taking the mean off.
        covered: share of the reference's seen Gaussians that the other saw too.
    """

    centered: float
    raw: float
    covered: float

    @property
    def total(self) -> float:
        """1 − mean centered cosine over all that the reference saw; a Gaussian that only it saw counts as 0."""
        return 1 - self.covered * (1 - self.centered)


def field_error(
    features: GaussianFeatures,
    reference: GaussianFeatures,
    *,
    sample: int = DEFAULT_SAMPLE,
    rows: Int64[np.ndarray, " n"] | None = None,
) -> FieldError:
    """Compares two fields in the full space.

    Args:
        features: what is judged.
        reference: what is taken for right.
        sample: at most so many Gaussians, evenly spaced over those that the reference saw; 0 = all.
        rows: the Gaussians that are compared, of those that the reference saw; None = a sample.

    Raises:
        InputError: fields of different splats or spaces, or a reference that saw nothing.
    """
    if len(features) != len(reference) or features.space != reference.space:
        raise InputError(
            f"field_error: expected {len(reference)} Gaussians in ({reference.space.describe()}), "
            f"got {len(features)} in ({features.space.describe()})"
        )
    if rows is None:
        rows = np.flatnonzero(reference.seen)
        rows = rows[even_indices(len(rows), sample)] if sample else rows
    if not len(rows):
        raise InputError("field_error: the reference saw no Gaussian")
    both = rows[features.seen[rows]]
    centered = raw = 0.0
    for start in range(0, len(both), CHUNK):
        part = both[start : start + CHUNK]
        a, b = features.decode(part).astype(np.float64), reference.decode(part).astype(np.float64)
        raw += float(row_cosines(a, b).sum())
        centered += float(row_cosines(a - features.mean, b - reference.mean).sum())
    if not len(both):
        return FieldError(centered=1.0, raw=1.0, covered=0.0)
    return FieldError(centered=1 - centered / len(both), raw=1 - raw / len(both), covered=len(both) / len(rows))


def judge(features: GaussianFeatures, exact: GaussianFeatures, *, seed: int = 0) -> FieldError:
    """The error on a tenth of the Gaussians that the exact features see, drawn now; each counts the same."""
    seen = np.flatnonzero(exact.seen)
    count = min(max(round(JUDGED * len(seen)), 1), len(seen))
    # Not the sequence of numbers that drew the sample on which a setting was chosen.
    rows = np.random.default_rng((seed, 1)).choice(seen, count, replace=False)
    return field_error(features, exact, rows=np.sort(rows))


def row_cosines(a: Float64[np.ndarray, "n D"], b: Float64[np.ndarray, "n D"]) -> Float64[np.ndarray, " n"]:
    """Cosine of each row with the other's; the eps inside the root makes a zero vector's cosine 0."""
    norms = np.sqrt((a * a).sum(axis=1) * (b * b).sum(axis=1) + 1e-60)
    return np.asarray((a * b).sum(axis=1) / norms)
