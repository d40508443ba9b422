"""What an encoder's numbers mean: standard units about the mean of a feature space, and the way back.

CLIP-like spaces are narrow cones: vectors are nearly alike, and what tells names apart is what is left when the mean is
taken off. A network therefore learns (feature − mean) / unit, in the coordinates of a basis where there is one, with
the unit chosen so that each channel has a mean square of about one. Nothing is lost: magnitudes come back, as a
teacher's own heads need them.
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
    """The space that an encoder's outputs live in.

    Attributes:
        space: what decoded features are.
        mean: the space's mean, which is taken off.
        scale: root mean square distance of features from the mean.
        basis: outputs are coordinates in it; None where they are all D channels.
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
        """Columns of the outputs: R or D."""
        return self.basis.rank if self.basis is not None else self.space.channels

    @property
    def unit(self) -> float:
        """One standard unit, in the space's own."""
        return self.scale / math.sqrt(self.channels)

    def standardize(self, features: Float32[np.ndarray, "n channels"]) -> Float32[np.ndarray, "n channels"]:
        """Coordinates in the basis, or vectors of the space, as an encoder should give them."""
        centered = features if self.basis is not None else features - self.mean
        return np.asarray(centered / np.float32(self.unit), dtype=np.float32)

    def restore(self, outputs: Float32[np.ndarray, "n channels"]) -> Float32[np.ndarray, "n channels"]:
        """The inverse of `standardize`."""
        scaled = outputs * np.float32(self.unit)
        return np.asarray(scaled if self.basis is not None else scaled + self.mean, dtype=np.float32)

    def features(self, restored: Float32[np.ndarray, "N channels"]) -> GaussianFeatures:
        """Restored outputs of every Gaussian as features, all with weight 1."""
        return GaussianFeatures(
            features=restored,
            weights=np.ones(len(restored), np.float32),
            mean=self.mean,
            space=self.space,
            basis=self.basis,
        )


def write_outputs(outputs: OutputSpace) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The arrays and the header values that hold an output space in a file."""
    arrays, header = space_parts(outputs.space, outputs.mean, outputs.basis)
    return arrays, {**header, "scale": outputs.scale}


def read_outputs(file: Archive) -> OutputSpace:
    """The output space that a file holds.

    Raises:
        InputError: damaged, or from another program.
    """
    space, mean, basis = read_space(file)
    return OutputSpace(space=space, mean=mean, scale=file.value("scale", float, int), basis=basis)
