"""Relevancy of words at the pixels of a view: cosines with blended features.

The feature of a pixel is f[p] = Σ w[p, i] f[i] / Σ w[p, i], over the Gaussians that have one, and its relevancy for a
word t is the cosine cos(f[p] − mean, t). A cosine of blended features is no blend of cosines, but its parts are simple:
Σ w[p, i] (f[i] − mean)·t is one channel that B renders, and the length of Σ w[p, i] (f[i] − mean) is the same for all
words. So all channels are rendered once for a view, and one channel for each word.

Q words, N Gaussians, P pixels, D channels, S axes of the features (see `FeatureAxes`).
"""

import numpy as np
import torch
from jaxtyping import Float32, Float64

from gsencoder.core.errors import InputError
from gsencoder.infer.localize.gaussian_products import GaussianProducts
from gsencoder.infer.localize.relevancy import EPS, MIN_RELATIVE_NORM, Mode
from gsencoder.memory.attention import render_queries
from gsencoder.render import Blend
from gsencoder.types import QueryMemory

BLOCK_AXES = 32
"""Axes that are rendered at once where the lengths of features at pixels are computed."""


class BlendedFeatures:
    """Features of Gaussians as a view blends them.

    Attributes:
        alpha: how opaque the Gaussians that have a feature make each pixel.
    """

    alpha: Float32[np.ndarray, " P"]

    def __init__(self, products: GaussianProducts, b: Blend) -> None:
        self._products, self._b = products, b
        alpha = b.render(torch.from_numpy(products.features.seen.astype(np.float32)))
        squares = alpha.double() ** 2 * products.axes.floor
        for start in range(0, len(products.axes.offset), BLOCK_AXES):
            block = products.along(slice(start, start + BLOCK_AXES))
            rendered = b.render(torch.from_numpy(block))
            squares += torch.einsum("ps,ps->p", rendered, rendered)
        self.alpha = alpha.numpy()
        self._inverse_lengths = (1 / squares.clamp(min=EPS).sqrt()).float()

    def cosines(self, directions: Float64[np.ndarray, "Q D"]) -> Float32[np.ndarray, "Q P"]:
        """Cosines with words of length 1; rounding may lead a little beyond 1. They mean nothing where alpha is 0."""
        rendered = self._b.render(torch.from_numpy(self._products.products(directions)))
        return (rendered * self._inverse_lengths[:, None]).T.numpy()


class AttendedQueries:
    """Features that the queries of a view's pixels attend to in the bank of a memory.

    Attention is not linear, so that the features of all pixels are computed, and kept in their axes.

    Attributes:
        alpha: how opaque the Gaussians that have a query make each pixel.
    """

    alpha: Float32[np.ndarray, " P"]

    def __init__(self, memory: QueryMemory, b: Blend, mode: Mode = "centered") -> None:
        queries, self.alpha = render_queries(memory, b)
        mean = memory.mean.astype(np.float64)
        removed = mean if mode == "centered" else np.zeros_like(mean)
        # The weights of the components sum to 1, so that the mean can be taken off the components.
        local = memory.bank.components - removed
        # Features are means of the components: so many axes hold them.
        self._axes = np.linalg.qr(local.T)[0] if len(local) < local.shape[1] else np.eye(local.shape[1])
        features = memory.attend(queries, (local @ self._axes).astype(np.float32))
        squares = np.einsum("ps,ps->p", features, features, dtype=np.float64)
        floor = EPS + MIN_RELATIVE_NORM**2 * float(removed @ removed)
        features /= np.sqrt(squares + floor)[:, None].astype(np.float32)
        self._directions = features

    def cosines(self, directions: Float64[np.ndarray, "Q D"]) -> Float32[np.ndarray, "Q P"]:
        """See `BlendedFeatures.cosines`."""
        return (self._directions @ (directions @ self._axes).T.astype(np.float32)).T


PixelFeatures = BlendedFeatures | AttendedQueries
"""The features at the pixels of a view, as words are compared with them."""


def pixel_features(
    products: GaussianProducts, b: Blend, *, memory: QueryMemory | None = None, mode: Mode = "centered"
) -> PixelFeatures:
    """The features at the pixels of a view: of a memory if one is given, else of the Gaussians.

    Raises:
        InputError: B has other Gaussians.
    """
    if b.gaussians != len(products.features):
        raise InputError(f"features of {len(products.features):,} Gaussians, and a view of {b.gaussians:,}")
    return BlendedFeatures(products, b) if memory is None else AttendedQueries(memory, b, mode)
