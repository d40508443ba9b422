"""The output space of an encoder: features standardized about the mean of a feature space, and the inverse.

CLIP-like spaces are narrow cones: all vectors are nearly parallel, and names differ only in what remains after the mean
is subtracted. A network therefore predicts (feature − mean) / unit, in the coordinates of a basis if there is one, with
the unit chosen so that the mean square of a channel is about one. The inverse restores magnitudes, which the adapter
heads of a teacher need.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float32

from gsencoder.core.errors import InputError
from gsencoder.core.files.archive import Archive
from gsencoder.data.archive_records import read_space, space_parts
from gsencoder.types import FeatureBasis, FeatureSpace, GaussianFeatures


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OutputSpace:
    """The space of an encoder's outputs.

    Attributes:
        space: the feature space of restored and decoded features.
        mean: mean of the space, which is subtracted.
        scale: root mean square distance of features from the mean.
        basis: the basis in which outputs are coordinates; None if they are all D channels.
    """

    space: FeatureSpace
    mean: Float32[np.ndarray, " D"]
    scale: float
    basis: FeatureBasis | None = None

    def __post_init__(self) -> None:
        if self.mean.shape != (self.space.channels,):
            raise InputError(f"OutputSpace.mean: expected {self.space.channels} channels, got {self.mean.shape}")
        if not 0 < self.scale < math.inf:
            raise InputError(f"OutputSpace.scale: expected a positive number, got {self.scale}")
        if self.basis is not None and self.basis.space != self.space:
            raise InputError(f"OutputSpace.basis: expected {self.space.describe()}, got {self.basis.space.describe()}")

    @property
    def channels(self) -> int:
        """Columns of the outputs: rank R of the basis, or D."""
        return self.basis.rank if self.basis is not None else self.space.channels

    @property
    def unit(self) -> float:
        """The length of one standard unit in units of the space."""
        return self.scale / math.sqrt(self.channels)

    def standardize(self, features: Float32[np.ndarray, "n channels"]) -> Float32[np.ndarray, "n channels"]:
        """Converts coordinates in the basis, or vectors of the space, to standard units."""
        centered = features if self.basis is not None else features - self.mean
        return np.asarray(centered / np.float32(self.unit), dtype=np.float32)

    def restore(self, outputs: Float32[np.ndarray, "n channels"]) -> Float32[np.ndarray, "n channels"]:
        """Converts standard units back to coordinates or vectors; the inverse of `standardize`."""
        scaled = outputs * np.float32(self.unit)
        return np.asarray(scaled if self.basis is not None else scaled + self.mean, dtype=np.float32)

    def features(self, restored: Float32[np.ndarray, "N channels"]) -> GaussianFeatures:
        """Wraps restored outputs of all Gaussians as features, all with weight 1."""
        return GaussianFeatures(
            features=restored,
            weights=np.ones(len(restored), np.float32),
            mean=self.mean,
            space=self.space,
            basis=self.basis,
        )


def output_space_parts(outputs: OutputSpace) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The arrays and header values that represent an output space in a file."""
    arrays, header = space_parts(outputs.space, outputs.mean, outputs.basis)
    return arrays, {**header, "scale": outputs.scale}


def read_output_space(file: Archive) -> OutputSpace:
    """Reads an output space from a file.

    Raises:
        InputError: the file is damaged, or was not written by gsencoder.
    """
    space, mean, basis = read_space(file)
    return OutputSpace(space=space, mean=mean, scale=file.value("scale", float, int), basis=basis)
