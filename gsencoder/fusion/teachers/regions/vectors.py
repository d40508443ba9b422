"""Regions whose vectors come from the picture: means of a dense map over a region, or pooled vectors of its crop."""

import warnings
from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Int32

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.fusion.teachers import MissingInput, Teacher
from gsencoder.fusion.teachers.regions.captioned import IDENTITY, codes_of
from gsencoder.fusion.teachers.regions.masks import RegionMasks
from gsencoder.types import FeatureMap, FeatureSpace, Views


@runtime_checkable
class RegionVectors(Protocol):
    """Makes a vector of each region of a picture.

    Attributes:
        space: of the vectors.
    """

    @property
    def space(self) -> FeatureSpace: ...

    def vectors(
        self, views: Views, view: int, labels: Int32[np.ndarray, "H W"], regions: Sequence[int]
    ) -> Float32[np.ndarray, "n D"]:
        """A vector for each of the regions; NaN where there is none."""
        ...

    def settings(self) -> dict[str, Any]:
        """All that the vectors depend on beside views and labels, as JSON values."""
        ...


class PicturedRegions:
    """Each pixel has the vector that its region has in this view; every map has a table of its own."""

    table = None
    mean = None
    needs_images = True
    cheap = False

    def __init__(self, views: Views, masks: RegionMasks, vectors: RegionVectors, *, min_area: int) -> None:
        """Looks at the masks of all views once, where they are at hand.

        Args:
            views: of the scene.
            masks: of regions.
            vectors: of regions.
            min_area: smallest number of pixels of a region in a view.

        Raises:
            InputError: the scene has no pictures, or no view has a region that is large enough.

        Warns:
            SceneWarning: regions are too small.
        """
        if views.images is None:
            raise MissingInput("teacher regions: the scene has no pictures to make vectors of regions from")
        self._masks, self._vectors, self._min_area = masks, vectors, min_area
        self.space = vectors.space
        if masks.cheap:
            self._check_sizes(views)

    def _check_sizes(self, views: Views) -> None:
        sizes = np.concatenate([_regions_of(self._masks.labels(views, view))[1] for view in range(len(views))])
        small = int((sizes < self._min_area).sum())
        if not len(sizes):
            raise InputError(
                f"teacher regions: the masks of all {len(views)} views are empty: they have no label above 0"
            )
        if small == len(sizes):
            raise InputError(
                f"teacher regions: all {small:,} regions in {len(views)} views have less than {self._min_area} "
                "pixels (teacher.min_area)"
            )
        if small:
            warnings.warn(
                f"teacher regions: {small:,} of {len(sizes):,} regions in {len(views)} views have less than "
                f"{self._min_area} pixels and no feature (teacher.min_area)",
                SceneWarning,
                stacklevel=4,
            )

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        """Codes at the resolution of the picture, into the vectors of the view's regions.

        Raises:
            InputError: the mask or the picture cannot be read, or a vector is not finite.
        """
        labels = self._masks.labels(views, view)
        values, sizes = _regions_of(labels)
        regions = [int(value) for value in values[sizes >= self._min_area]]
        table = np.zeros((0, self.space.channels), np.float32)
        if regions:
            table = self._vectors.vectors(views, view, labels, regions)
        codes = codes_of(labels, {label: row for row, label in enumerate(regions)})
        return FeatureMap(codes=codes, table=table, grid_from_image=IDENTITY, space=self.space)

    def settings(self) -> dict[str, Any]:
        return {
            "name": "regions",
            "min_area": self._min_area,
            **self._masks.settings(),
            "vectors": self._vectors.settings(),
        }


def _regions_of(labels: Int32[np.ndarray, "H W"]) -> tuple[np.ndarray, np.ndarray]:
    """Labels above 0, and their numbers of pixels."""
    values, sizes = np.unique(labels, return_counts=True)
    return values[values > 0], sizes[values > 0]


class MapVectors:
    """The mean of a dense teacher's features over the pixels of a region, each with the cell that its center is in."""

    def __init__(self, teacher: Teacher) -> None:
        """Args:
        teacher: with dense maps.
        """
        self.teacher = teacher
        space = teacher.space
        self.space = FeatureSpace(
            name=f"regions-{space.name}",
            channels=space.channels,
            teacher="regions",
            weights=space.weights,
            layer=f"{space.layer}, means over regions",
            preprocessing=space.preprocessing,
            text_encoder=space.text_encoder,
        )

    def vectors(
        self, views: Views, view: int, labels: Int32[np.ndarray, "H W"], regions: Sequence[int]
    ) -> Float32[np.ndarray, "n D"]:
        """Means over regions.

        Raises:
            InputError: the teacher gives no finite vector in a region.
        """
        dense = self.teacher.feature_map(views, view)
        means = region_means(dense, labels, regions)
        bad = np.flatnonzero(~np.isfinite(means).all(axis=1))
        if bad.size:
            raise InputError(
                f"teacher regions: view {views.names[view]!r}: {bad.size} of {len(regions)} regions have no finite "
                f"vector, first label {regions[bad[0]]}; check the model, and how pictures are given to it"
            )
        return means

    def settings(self) -> dict[str, Any]:
        return {"vector": "map", "teacher": self.teacher.settings()}


def region_means(
    dense: FeatureMap, labels: Int32[np.ndarray, "H W"], regions: Sequence[int]
) -> Float32[np.ndarray, "n D"]:
    """The mean vector of a dense map over the pixels of each region: cells weighted by their pixels in it.

    A pixel beyond the border of the grid takes the nearest cell; cells without a vector count for nothing, and a region
    without any other is NaN.

    Args:
        dense: of the same view.
        labels: at the resolution of the picture.
        regions: labels whose means are wanted.
    """
    affine, (height, width) = dense.grid_from_image, labels.shape
    line = np.floor(affine[1, 1] * (np.arange(height) + 0.5) + affine[1, 2]).astype(np.int64).clip(0, dense.height - 1)
    column = np.floor(affine[0, 0] * (np.arange(width) + 0.5) + affine[0, 2]).astype(np.int64).clip(0, dense.width - 1)
    cell = line[:, None] * dense.width + column
    codes = codes_of(labels, {label: row for row, label in enumerate(regions)})
    inside = codes >= 0
    cells = dense.height * dense.width
    counts = np.bincount(codes[inside].astype(np.int64) * cells + cell[inside], minlength=len(regions) * cells)
    counts = counts.reshape(len(regions), cells).astype(np.float64)
    rows = dense.rows()
    finite = np.isfinite(rows).all(axis=1)
    counts = counts[:, finite]
    sizes = counts.sum(axis=1, keepdims=True)
    return ((counts @ rows[finite].astype(np.float64)) / np.where(sizes > 0, sizes, np.nan)).astype(np.float32)
