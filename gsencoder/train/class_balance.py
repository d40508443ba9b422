"""Class balance of targets: loss weights by class frequency, since a floor has 10⁵ Gaussians and a spoon has forty.

The class of a target is the nearest vector of a codebook: the vectors of a coded teacher's table, or cluster centers of
a dense teacher's features. A Gaussian of a class with n Gaussians in the dataset is weighted by n^−power.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int64

CHUNK_ROWS = 16_384
"""Rows of targets that are compared with the codebook in one matrix product."""
MAX_CLUSTERS = 128
"""Largest number of target classes of a dense teacher."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ClassBalance:
    """A codebook of target classes and their frequencies.

    Attributes:
        codebook: one vector per class, in standard units.
        counts: number of Gaussians of each class in the dataset.
    """

    codebook: Float32[np.ndarray, "C channels"]
    counts: Float64[np.ndarray, " C"]

    def class_weights(self, power: float) -> Float32[np.ndarray, " C"]:
        """The weight n^−power of each class, scaled so that its mean over the targets of the dataset is 1.

        Classes without Gaussians get the weight of the most frequent class: only mixtures of other classes, as in cells
        across an edge, are nearest to them.
        """
        counts = np.where(self.counts > 0, self.counts, max(float(self.counts.max()), 1.0))
        weights = counts**-power
        weights *= self.counts.sum() / max(float((weights * self.counts).sum()), 1e-30)
        return weights.astype(np.float32)

    def target_weights(self, targets: Float32[np.ndarray, "n channels"], power: float) -> Float32[np.ndarray, " n"]:
        """The weight of each target's class; with the power 0 all are 1, and classes are not looked up."""
        if power == 0:
            return np.ones(len(targets), np.float32)
        return self.class_weights(power)[nearest_codes(self.codebook, targets)]


def nearest_codes(
    codebook: Float32[np.ndarray, "C channels"], targets: Float32[np.ndarray, "n channels"]
) -> Int64[np.ndarray, " n"]:
    """The class of each target: the row of the nearest vector of the codebook."""
    half = 0.5 * np.square(codebook, dtype=np.float64).sum(axis=1).astype(np.float32)
    codes = [
        (targets[start : start + CHUNK_ROWS] @ codebook.T - half).argmax(axis=1)
        for start in range(0, len(targets), CHUNK_ROWS)
    ]
    return np.concatenate(codes) if codes else np.zeros(0, np.int64)


def count_targets(
    scenes: Iterable[Float32[np.ndarray, "_n channels"]], codebook: Float32[np.ndarray, "C channels"]
) -> ClassBalance:
    """Counts the classes of a dataset's targets, scene by scene."""
    counts = np.zeros(len(codebook))
    for targets in scenes:
        counts += np.bincount(nearest_codes(codebook, targets), minlength=len(codebook))
    return ClassBalance(codebook=codebook, counts=counts)


def cluster_targets(sample: Float32[np.ndarray, "n channels"], *, seed: int = 0) -> Float32[np.ndarray, "C channels"]:
    """A codebook for targets of a dense teacher: cluster centers of a sample of them."""
    from sklearn.cluster import MiniBatchKMeans

    subsample = sample[:: max(1, len(sample) // 4096)]
    count = min(MAX_CLUSTERS, len(np.unique(subsample, axis=0)))
    kmeans = MiniBatchKMeans(n_clusters=count, random_state=seed, batch_size=4096, n_init=3).fit(sample)
    return np.asarray(kmeans.cluster_centers_, dtype=np.float32)
