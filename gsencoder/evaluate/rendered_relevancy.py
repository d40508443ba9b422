"""Maps of how well rendered features answer words."""

import numpy as np
import torch
from jaxtyping import Float32

from gsencoder.core.errors import InputError
from gsencoder.infer.localize.relevancy import feature_axes, word_directions
from gsencoder.render import Blend
from gsencoder.types import GaussianFeatures

CHUNK_ROWS = 16_384
"""Gaussians whose coordinates are computed at a time."""


class RenderedRelevancy:
    """Centered cosines of rendered features with words.

    A pixel's feature, less the mean m of the space, is Σᵢ B[p, i] (fᵢ − m) over the Gaussians that some teacher saw.
    Its cosine with a word, less the mean of the text side, is that of `gsencoder.infer.localize.relevancy.relevancy`,
    taken after rendering. It is 0 where rays meet nothing.
    """

    def __init__(
        self,
        features: GaussianFeatures,
        text: Float32[np.ndarray, "Q D"],
        text_mean: Float32[np.ndarray, " D"],
    ) -> None:
        """Args:
        features: of the splat, in a basis or not, with an index or without.
        text: vectors of the words.
        text_mean: mean of the text side.
        """
        self._axes = feature_axes(features)
        self._targets = self._axes.project(word_directions(text, text_mean))
        values = np.zeros((len(features), len(self._axes.offset)), np.float32)
        rows = np.flatnonzero(features.seen)
        for start in range(0, len(rows), CHUNK_ROWS):
            chunk = rows[start : start + CHUNK_ROWS]
            values[chunk] = self._axes.coordinates_of(features.stored(chunk))
        self._values = torch.from_numpy(values)

    def maps(self, blended: Blend) -> Float32[np.ndarray, "Q H W"]:
        """The cosines of each word over the grid of a view.

        Raises:
            InputError: a blend of another splat.
        """
        if blended.gaussians != len(self._values):
            raise InputError(
                f"relevancy: features of {len(self._values):,} Gaussians, a blend of {blended.gaussians:,}"
            )
        rendered = blended.render(self._values).numpy().astype(np.float64)
        cosines = np.clip(self._axes.unit(rendered) @ self._targets.T, -1, 1)
        return np.asarray(cosines.T.reshape(-1, *blended.shape).astype(np.float32))
