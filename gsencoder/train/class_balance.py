"""How rare a target is: a floor has a hundred thousand Gaussians and a spoon forty, and both are one word.

Targets are counted by the nearest vector of a codebook (the names of a labels teacher, or clusters of a dense
teacher's features); a Gaussian whose kind has n of them over the dataset counts n^−power.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int64

CHUNK = 16_384
CLUSTERS = 128


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rarity:
    """A codebook and how often each of its vectors is the nearest.

    Attributes:
        codebook: in standard units.
        counts: Gaussians of the dataset that are nearest to each.
    """

    codebook: Float32[np.ndarray, "C channels"]
    counts: Float64[np.ndarray, " C"]

    def each(self, power: float) -> Float32[np.ndarray, " C"]:
        """n^−power for each vector of the codebook, scaled so that the mean over the dataset's targets is 1. What is
        nearest to a vector that no target has is a mixture of others, and counts as the commonest kind does."""
        counts = np.where(self.counts > 0, self.counts, max(float(self.counts.max()), 1.0))
        weights = counts**-power
        weights *= self.counts.sum() / max(float((weights * self.counts).sum()), 1e-30)
        return weights.astype(np.float32)

    def weights(self, targets: Float32[np.ndarray, "n channels"], power: float) -> Float32[np.ndarray, " n"]:
        """`each`, for targets by their nearest vector."""
        return self.each(power)[nearest_codes(self.codebook, targets)]


def nearest_codes(
    codebook: Float32[np.ndarray, "C channels"], targets: Float32[np.ndarray, "n channels"]
) -> Int64[np.ndarray, " n"]:
    """The row of the codebook that is nearest to each target."""
    half = 0.5 * np.square(codebook, dtype=np.float64).sum(axis=1).astype(np.float32)
    codes = [
        (targets[start : start + CHUNK] @ codebook.T - half).argmax(axis=1) for start in range(0, len(targets), CHUNK)
    ]
    return np.concatenate(codes) if codes else np.zeros(0, np.int64)


def count_targets(
    scenes: Iterable[Float32[np.ndarray, "_n channels"]], codebook: Float32[np.ndarray, "C channels"]
) -> Rarity:
    """Counts the targets of a dataset, scene by scene."""
    counts = np.zeros(len(codebook))
    for targets in scenes:
        counts += np.bincount(nearest_codes(codebook, targets), minlength=len(codebook))
    return Rarity(codebook=codebook, counts=counts)


def cluster_targets(sample: Float32[np.ndarray, "n channels"], *, seed: int = 0) -> Float32[np.ndarray, "C channels"]:
    """A codebook for targets that have no names: means of clusters of a sample of them."""
    from sklearn.cluster import MiniBatchKMeans

    some = sample[:: max(1, len(sample) // 4096)]
    count = min(CLUSTERS, len(np.unique(some, axis=0)))
    found = MiniBatchKMeans(n_clusters=count, random_state=seed, batch_size=4096, n_init=3).fit(sample)
    return np.asarray(found.cluster_centers_, dtype=np.float32)
