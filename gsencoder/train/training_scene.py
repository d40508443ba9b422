"""A scene of a training with several teachers: its prepared file for each teacher that it has."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, Float64

from gsencoder.core.errors import InputError
from gsencoder.train.prepared_scene import PreparedScene
from gsencoder.types import Cameras, Gaussians


class TrainingScene:
    """The prepared files of one scene. Gaussians and cameras are read from the first of them, and are the same in all.

    Attributes:
        parts: the prepared scene of each teacher, in the order of the teachers; None for those that the scene lacks.
        name: of the scene.
    """

    def __init__(self, parts: Sequence[PreparedScene | None]) -> None:
        """Args:
        parts: see the class.

        Raises:
            InputError: the scene has no teacher.
        """
        present = [part for part in parts if part is not None]
        if not present:
            raise InputError("training: a scene has no teacher")
        self.parts, self._first = tuple(parts), present[0]
        self.name = self._first.name

    def check_consistent(self) -> None:
        """Checks that all parts were prepared for the same Gaussians and views.

        Raises:
            InputError: they were not.
        """
        first = self._first
        for part in self.parts:
            same = part is None or (
                part.view_names == first.view_names
                and len(part) == len(first)
                and np.array_equal(part.means, first.means)
            )
            if part is not None and not same:
                raise InputError(
                    f"{part.path}: has other Gaussians or views than {first.path}; remove both to prepare the scene "
                    "again"
                )

    def close(self) -> None:
        """Closes the files; the next access opens them again."""
        for part in self.parts:
            if part is not None:
                part.close()

    def __len__(self) -> int:
        return len(self._first)

    @property
    def cameras(self) -> Cameras:
        return self._first.cameras

    @property
    def view_names(self) -> tuple[str, ...]:
        return self._first.view_names

    @property
    def metres_per_unit(self) -> float | None:
        return self._first.metres_per_unit

    @property
    def up(self) -> Float64[np.ndarray, "3"] | None:
        return self._first.up

    @property
    def means(self) -> Float32[np.ndarray, "N 3"]:
        return self._first.means

    def gaussians(self, rows: np.ndarray) -> Gaussians:
        """Reads Gaussians by row; see `PreparedScene.gaussians`."""
        return self._first.gaussians(rows)
