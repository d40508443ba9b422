"""Products of words with the features of Gaussians, for programs that ask many times; numpy only.

Q words, N Gaussians, D channels, S axes of the features (see `FeatureAxes`).
"""

import numpy as np
from jaxtyping import Float32, Float64

from gsencoder.infer.localize.relevancy import CHUNK_BYTES, Mode, feature_axes
from gsencoder.types import GaussianFeatures


class GaussianProducts:
    """Products of words with the features of Gaussians, less the mean; the lengths of the features are kept.

    Attributes:
        features: of the Gaussians.
        axes: their axes.
    """

    def __init__(self, features: GaussianFeatures, mode: Mode = "centered") -> None:
        self.features, self.axes = features, feature_axes(features, mode)
        self._unseen = np.flatnonzero(~features.seen)
        rows = features.features
        self._lengths = np.zeros(len(rows), np.float32)
        step = max(1, CHUNK_BYTES // (8 * len(self.axes.offset)))
        for start in range(0, len(rows), step):
            local = self._local(rows[start : start + step], slice(None), np.float64)
            self._lengths[start : start + step] = np.sqrt((local**2).sum(axis=1) + self.axes.floor)

    def products(self, directions: Float64[np.ndarray, "Q D"]) -> Float32[np.ndarray, "N Q"]:
        """(f − mean)·t of each Gaussian and word; 0 for Gaussians never seen."""
        return self._of_gaussians(self._products_of_rows(directions), fill=0.0)

    def cosines(self, directions: Float64[np.ndarray, "Q D"]) -> Float32[np.ndarray, "Q N"]:
        """Cosines of words of length 1 with the features of Gaussians; NaN for Gaussians never seen."""
        cosines = self._products_of_rows(directions) / self._lengths[:, None]
        return self._of_gaussians(np.clip(cosines, -1, 1), fill=np.nan).T

    def along(self, axes: slice) -> Float32[np.ndarray, "N axes"]:
        """f − mean of each Gaussian along some of the axes; 0 for Gaussians never seen."""
        return self._of_gaussians(self._local(self.features.features, axes, np.float32), fill=0.0)

    def _local(self, stored: np.ndarray, axes: slice, dtype: type) -> np.ndarray:
        offset: np.ndarray = self.axes.offset[axes].astype(dtype)
        matrix = self.axes.matrix
        if matrix is None:
            return stored[:, axes].astype(dtype) + offset
        return stored.astype(dtype, copy=False) @ matrix[:, axes].astype(dtype) + offset

    def _products_of_rows(self, directions: np.ndarray) -> np.ndarray:
        targets = self.axes.project(directions)
        # The words are brought to the coordinates that are stored, which are many more.
        words = targets if self.axes.matrix is None else targets @ self.axes.matrix.T
        return self.features.features @ words.T.astype(np.float32) + (targets @ self.axes.offset).astype(np.float32)

    def _of_gaussians(self, of_rows: np.ndarray, fill: float) -> np.ndarray:
        if self.features.index is None:
            values = of_rows
        else:
            # The row behind the last one, where −1 leads, is that of Gaussians without a row.
            values = np.concatenate([of_rows, np.zeros((1, of_rows.shape[1]), of_rows.dtype)])[self.features.index]
        values[self._unseen] = fill
        return values
