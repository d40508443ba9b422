"""Features of a teacher and of an encoder together: each Gaussian has those of whichever is surer.

The 2D-3D ensemble of OpenScene (Peng et al. 2023, https://arxiv.org/abs/2211.15654, sec. 3.4): of both features the
largest cosine with any of some names is taken, and the feature with the larger one is kept.
"""

import numpy as np
from jaxtyping import Bool, Float32

from gsencoder.core.errors import InputError
from gsencoder.fusion.basis import table_basis
from gsencoder.infer.relevancy import CHUNK_BYTES, feature_axes, word_directions
from gsencoder.types import FeatureSpace, GaussianFeatures

BIAS = 0.3
"""By how much an encoder's largest cosines are smaller than a segmenter's: 0.42 to 0.74 over the regions of a real
kitchen, for 0.64 to 0.83. Alone they name 0.51 and 0.44 of it, together 0.60, and 0.50 without the bias."""


def surer_features(
    teacher: GaussianFeatures,
    encoder: GaussianFeatures,
    names: Float32[np.ndarray, "C D"],
    text_mean: Float32[np.ndarray, " D"],
    *,
    bias: float = BIAS,
) -> tuple[GaussianFeatures, Bool[np.ndarray, " N"]]:
    """The directions of the surer features, and which Gaussians have the encoder's.

    Args:
        teacher, encoder: features of the same Gaussians, which words of one text encoder can ask.
        names: vectors of the words by which they are compared.
        bias: added to the encoder's cosines.
    """
    if teacher.space.text_encoder != encoder.space.text_encoder or not teacher.space.text_encoder:
        raise InputError(
            f"encoder: its words are those of {encoder.space.text_encoder!r}, and the teacher's those of "
            f"{teacher.space.text_encoder or 'no text encoder'!r}; expected the same (text=)"
        )
    space = FeatureSpace(
        name=f"{teacher.space.name}+{encoder.space.name}",
        channels=teacher.space.channels,
        teacher=f"{teacher.space.teacher}+{encoder.space.teacher}",
        text_encoder=teacher.space.text_encoder,
    )
    directions = word_directions(names, text_mean)
    basis = table_basis((directions + text_mean).astype(np.float32), text_mean, space, energy=0.999)
    count = len(teacher)
    values = np.zeros((count, basis.rank), np.float32)
    by_encoder, weights = np.zeros(count, bool), np.maximum(teacher.weights, encoder.weights)
    step = max(1, CHUNK_BYTES // (8 * len(names)))
    both = [(each, feature_axes(each)) for each in (teacher, encoder)]
    for start in range(0, count, step):
        rows = np.arange(start, min(start + step, count))
        sureness, coordinates = [], []
        for features, axes in both:
            local = axes.directions_of(features.stored(rows))
            cosines = (local @ axes.project(directions).T).max(axis=1)
            sureness.append(np.where(features.weights[rows] > 0, cosines, -np.inf))
            coordinates.append(local @ axes.project(basis.components.astype(np.float64)).T)
        chosen = sureness[1] + bias > sureness[0]
        by_encoder[rows] = chosen
        values[rows] = np.where(chosen[:, None], coordinates[1], coordinates[0])
    values[weights == 0] = 0
    return GaussianFeatures(features=values, weights=weights, mean=basis.mean, space=space, basis=basis), by_encoder
