"""Features against the names of classes: the class of each Gaussian, and ranked classes of sets of Gaussians."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float32, Int64

from gsencoder.infer.relevancy import relevancy
from gsencoder.text.table import TextEncoder, check_space
from gsencoder.types import GaussianFeatures

NAMES_AT_ONCE = 16
"""Classes whose cosines with all Gaussians are in memory together."""


def nearest_class(features: GaussianFeatures, names: Sequence[str], text: TextEncoder) -> Int64[np.ndarray, " N"]:
    """The class whose name has the largest centered cosine with each Gaussian's feature, of equal ones the first.

    Args:
        features: of the Gaussians.
        names: of the classes.
        text: turns them into vectors of the features' space.

    Returns:
        Number of the class in `names`; -1 for Gaussians without a feature.

    Raises:
        InputError: words of another space, or a name that `text` does not know.
    """
    check_space(features.space, text.space)
    vectors = text.encode(list(names))
    best = np.full(len(features), -np.inf, np.float32)
    classes = np.full(len(features), -1, np.int64)
    for start in range(0, len(names), NAMES_AT_ONCE):
        scores = relevancy(features, vectors[start : start + NAMES_AT_ONCE], text.mean)
        # Comparisons with NaN are false: Gaussians never seen have no class.
        for number, row in enumerate(scores, start=start):
            better = row > best
            best[better], classes[better] = row[better], number
    return classes


def class_cosines(
    features: GaussianFeatures, parts: Sequence[Int64[np.ndarray, " _"]], names: Sequence[str], text: TextEncoder
) -> Float32[np.ndarray, "M C"]:
    """Centered cosines of the mean feature of some sets of Gaussians with the names of classes.

    The mean of a set is over its Gaussians that were seen, each counting the same.

    Args:
        features: of the Gaussians.
        parts: rows of each set.
        names: of the classes.
        text: turns them into vectors of the features' space.

    Returns:
        Cosines; NaN for sets in which no Gaussian was seen.

    Raises:
        InputError: words of another space, or a name that `text` does not know.
    """
    check_space(features.space, text.space)
    seen = features.seen
    means = np.zeros((len(parts), features.features.shape[1]), np.float32)
    counts = np.zeros(len(parts), np.float32)
    for number, part in enumerate(parts):
        rows = part[seen[part]]
        counts[number] = len(rows)
        if len(rows):
            means[number] = features.stored(rows).mean(axis=0, dtype=np.float64)
    # A mean of coordinates is the coordinates of the mean.
    of_sets = replace(features, features=means, weights=counts, index=None)
    return relevancy(of_sets, text.encode(list(names)), text.mean).T
