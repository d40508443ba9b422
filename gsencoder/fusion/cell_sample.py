"""A sample of the cells of a teacher's maps, of bounded size, the same for the same maps."""

import numpy as np
from jaxtyping import Float32

from gsencoder.core.errors import InputError
from gsencoder.types import FeatureMap

MAX_CELLS = 32_768
"""Approximate limit of the cells of a sample: a mean of so many is known to 1/180 of the scale."""


class CellSample:
    """Vectors of evenly spaced cells of maps."""

    def __init__(self, maps: int, limit: int = MAX_CELLS) -> None:
        """Args:
        maps: number of the maps that will be added.
        limit: approximate limit of the cells of all maps.
        """
        self._per_map = max(1, limit // max(1, maps))
        self._parts: list[np.ndarray] = []

    def add(self, feature_map: FeatureMap) -> None:
        """Adds cells of a map that have a vector."""
        rows = feature_map.rows()
        rows = rows[np.isfinite(rows).all(axis=1)]
        self._parts.append(rows[:: -(-len(rows) // self._per_map)] if len(rows) else rows)

    def vectors(self) -> Float32[np.ndarray, "n D"]:
        """The vectors of all cells of the sample.

        Raises:
            InputError: there are none.
        """
        if not sum(len(part) for part in self._parts):
            raise InputError("heads: no view has a cell with a vector; check the teacher's maps")
        return np.concatenate(self._parts).astype(np.float32, copy=False)
