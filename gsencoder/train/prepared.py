"""A scene made ready for training, on disk: its Gaussians with their targets, and for every view the matrix B of the
teacher's cells beside the teacher's vectors there. Read lazily: a sample touches the views that it was given.

A folder holds what `fuse` writes (`localize` can be asked there) and `views.safetensors`.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Int32, Int64

from gsencoder.data.archive import open_archive
from gsencoder.errors import InputError
from gsencoder.fusion.store import load_features
from gsencoder.models.output_space import OutputSpace
from gsencoder.types import Cameras, GaussianFeatures, Gaussians, Scene

VIEWS_FILE = "views.safetensors"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ViewRows:
    """B of one view in rows of cells, and what the teacher saw there.

    Attributes:
        crow, col, weight: compressed rows, as in `render.Blend`.
        targets: the teacher's vectors, standard units.
        valid: cells in which the teacher has one.
    """

    crow: Int64[np.ndarray, " P_plus_1"]
    col: Int32[np.ndarray, " nnz"]
    weight: Float32[np.ndarray, " nnz"]
    targets: Float32[np.ndarray, "P channels"]
    valid: Bool[np.ndarray, " P"]


class PreparedScene:
    """One folder; the Gaussians are read when they are first asked for, and forgotten by `forget`."""

    def __init__(self, folder: Path, outputs: OutputSpace) -> None:
        self.folder, self.outputs = folder, outputs
        self.name = folder.name

    @cached_property
    def scene(self) -> Scene:
        """Gaussians, cameras and features; fused in the dataset's basis.

        Raises:
            InputError: damaged, or prepared for another space.
        """
        scene = load_features(self.folder)
        features = next(iter(scene.features.values()))
        same = features.space == self.outputs.space and (features.basis is None) == (self.outputs.basis is None)
        if not same or features.features.shape[1] != self.outputs.channels:
            raise InputError(f"{self.folder}: was prepared for another dataset; prepare it again")
        if scene.views is None:
            raise InputError(f"{self.folder}: holds no views; prepare it again")
        return scene

    @property
    def gaussians(self) -> Gaussians:
        assert self.scene.gaussians is not None
        return self.scene.gaussians

    @property
    def cameras(self) -> Cameras:
        assert self.scene.views is not None
        return self.scene.views.cameras

    @property
    def features(self) -> GaussianFeatures:
        return next(iter(self.scene.features.values()))

    def targets(self, rows: np.ndarray) -> Float32[np.ndarray, "n channels"]:
        """What the encoder should give for these Gaussians, standard units; meaningless where never seen."""
        return self.outputs.standardize(self.features.features[rows])

    def view(self, view: int) -> ViewRows:
        """One view's part of the file.

        Raises:
            InputError: missing or damaged.
        """
        with open_archive(self.folder / VIEWS_FILE) as file:
            rows = file.part("rows", "int64", view, view + 2)
            first, last = int(rows[0]), int(rows[-1])
            crow = file.part("crow", "int64", first, last + 1)
            start, end = int(crow[0]), int(crow[-1])
            return ViewRows(
                crow=crow - start,
                col=file.part("col", "int32", start, end),
                weight=file.part("weight", "float16", start, end).astype(np.float32),
                targets=file.part("targets", "float16", first, last).astype(np.float32),
                valid=file.part("valid", "uint8", first, last).astype(bool),
            )

    def forget(self) -> None:
        """Frees the arrays; they are read again when asked for."""
        self.__dict__.pop("scene", None)
