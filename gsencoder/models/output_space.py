"""The output space of an encoder: features standardized about the mean of a feature space, and the inverse.

CLIP-like spaces are narrow cones: all vectors are nearly parallel, and names differ only in what remains after the mean
is subtracted. A network therefore predicts (feature − mean) / unit, in the coordinates of a basis if there is one, with
the unit chosen so that the mean square of a channel is about one. The inverse restores magnitudes, which the adapter
heads of a teacher need. Centering and scaling can be left out, as SplatDistill does: the network then predicts the
teacher's vectors themselves.
"""

import math
from dataclasses import dataclass, replace
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
        centered: whether outputs are relative to the mean; coordinates of a basis always are.
        scaled: whether outputs are in units of the scale, instead of those of the space.
    """

    space: FeatureSpace
    mean: Float32[np.ndarray, " D"]
    scale: float
    basis: FeatureBasis | None = None
    centered: bool = True
    scaled: bool = True

    def __post_init__(self) -> None:
        if self.mean.shape != (self.space.channels,):
            raise InputError(f"OutputSpace.mean: expected {self.space.channels} channels, got {self.mean.shape}")
        if not 0 < self.scale < math.inf:
            raise InputError(f"OutputSpace.scale: expected a positive number, got {self.scale}")
        if self.basis is not None and self.basis.space != self.space:
            raise InputError(f"OutputSpace.basis: expected {self.space.describe()}, got {self.basis.space.describe()}")
        if self.basis is not None and not self.centered:
            raise InputError("OutputSpace.centered: expected true with a basis, whose coordinates are about the mean")

    @property
    def channels(self) -> int:
        """Columns of the outputs: rank R of the basis, or D."""
        return self.basis.rank if self.basis is not None else self.space.channels

    @property
    def unit(self) -> float:
        """The length of one unit of the outputs in units of the space."""
        return self.scale / math.sqrt(self.channels) if self.scaled else 1.0

    @property
    def offset(self) -> Float32[np.ndarray, " channels"]:
        """The vector that outputs are relative to: the mean, or zero in a basis or without centering."""
        has_offset = self.basis is None and self.centered
        return self.mean if has_offset else np.zeros(self.channels, np.float32)

    def standardize(self, features: Float32[np.ndarray, "n channels"]) -> Float32[np.ndarray, "n channels"]:
        """Converts coordinates in the basis, or vectors of the space, to units of the outputs."""
        return np.asarray((features - self.offset) / np.float32(self.unit), dtype=np.float32)

    def restore(self, outputs: Float32[np.ndarray, "n channels"]) -> Float32[np.ndarray, "n channels"]:
        """Converts outputs back to coordinates or vectors; the inverse of `standardize`."""
        return np.asarray(outputs * np.float32(self.unit) + self.offset, dtype=np.float32)

    def standard_units(self, outputs: Float32[np.ndarray, "n channels"]) -> Float32[np.ndarray, "n channels"]:
        """Converts outputs to standard units about the mean, which they are in unless centering or scaling is off."""
        if self.centered and self.scaled:
            return outputs
        return replace(self, centered=True, scaled=True).standardize(self.restore(outputs))

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
    # Left out where true, so that files of such spaces are those of versions that knew no others.
    switches = {name: False for name in ("centered", "scaled") if not getattr(outputs, name)}
    return arrays, {**header, "scale": outputs.scale, **switches}


def read_output_space(file: Archive) -> OutputSpace:
    """Reads an output space from a file.

    Raises:
        InputError: the file is damaged, or was not written by gsencoder.
    """
    space, mean, basis = read_space(file)
    switches = {name: bool(file.value(name, bool)) for name in ("centered", "scaled") if name in file}
    return OutputSpace(space=space, mean=mean, scale=file.value("scale", float, int), basis=basis, **switches)
