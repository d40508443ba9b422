"""Scenes: Gaussians, posed views and labeled objects of one place."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, UInt8

from gsencoder.types.cameras import Cameras
from gsencoder.types.checks import UNIT_TOLERANCE, check_array, check_unit, fail
from gsencoder.types.features import GaussianFeatures
from gsencoder.types.gaussians import Gaussians

LAZY = ("images", "depths", "masks", "empty", "instances")
"""Fields of Views that are sequences with one entry a camera."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Views:
    """Cameras with what was seen through them. The sequences load on access: `views.images[3]` reads one file.

    Attributes:
        cameras: V cameras.
        names: V names, unique, as the scene's files give them.
        images: uint8 [H, W, 3] each, RGB; None where there are no pictures.
        depths: float32 [H, W] each, z in world units, 0 = none; None where no sensor depth exists.
        masks: bool [H, W] each, True = use this pixel.
        empty: bool [H, W] each, True = the photograph shows that nothing is there, as transparency does; such pixels
            are masked, too.
        instances: int32 [H, W] each, 0 = none.
        orientations: EXIF orientations, 1 to 8: how the stored pixels, which cameras and pictures are of, are turned to
            be upright (`gsencoder.types.orientation`); None = all are.
    """

    cameras: Cameras
    names: tuple[str, ...]
    images: Sequence[UInt8[np.ndarray, "_ _ 3"]] | None = None
    depths: Sequence[Float32[np.ndarray, "_ _"]] | None = None
    masks: Sequence[Bool[np.ndarray, "_ _"]] | None = None
    empty: Sequence[Bool[np.ndarray, "_ _"]] | None = None
    instances: Sequence[Int32[np.ndarray, "_ _"]] | None = None
    orientations: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        if len(self.names) != len(self.cameras):
            fail("Views", "names", f"{len(self.cameras)} names, one a camera", str(len(self.names)))
        if len(set(self.names)) != len(self.names):
            fail("Views", "names", "unique names", f"{len(self.names) - len(set(self.names))} repeated")
        for name in (*LAZY, "orientations"):
            value = getattr(self, name)
            if value is not None and len(value) != len(self.cameras):
                fail("Views", name, f"{len(self.cameras)} entries, one a camera", str(len(value)))

    def __len__(self) -> int:
        return len(self.cameras)

    def select(self, views: Sequence[int] | np.ndarray) -> "Views":
        """The views of these rows, in that order; files are still read on access."""
        rows = [int(view) for view in views]
        lazy = {name: None if (items := getattr(self, name)) is None else Selected(items, rows) for name in LAZY}
        return Views(
            cameras=self.cameras.select(rows),
            names=tuple(self.names[row] for row in rows),
            orientations=None if self.orientations is None else tuple(self.orientations[row] for row in rows),
            **lazy,
        )


class Selected(Sequence[Any]):
    """Selected entries of a sequence, each read on access.

    Attributes:
        items: the whole sequence.
        rows: which of them, in this order.
    """

    def __init__(self, items: Sequence[Any], rows: list[int]) -> None:
        self.items, self.rows = items, rows

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return Selected(self.items, self.rows[index])
        return self.items[self.rows[index]]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SceneObject:
    """A labeled object, for evaluation. The box is in world coordinates, origin included.

    Attributes:
        id: its value in the instance maps.
        name: a word of the name table, or None.
        aabb_min: lower corner, world units.
        aabb_max: upper corner.
        placed: one of the small objects, as opposed to furniture; of scanned scenes whatever is no part of the building
            (`gsencoder.data.truth.scene_labels.is_placed`).
        views: in how many views it shows; None where nobody counted (`with_counted_views` of the same module does).
        max_pixels: its largest visible area in a view; None as above.
    """

    id: int
    name: str | None
    aabb_min: Float64[np.ndarray, "3"]
    aabb_max: Float64[np.ndarray, "3"]
    placed: bool = True
    views: int | None = 0
    max_pixels: int | None = 0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scene:
    """A place: Gaussians, or views, or both.

    Attributes:
        name: for people and for output folders.
        gaussians: the splat, relative to `origin`; None until there is one.
        views: posed cameras and what they saw, relative to `origin`; None for a bare splat.
        features: per-Gaussian features by space name.
        origin: float64 offset that was taken off every position; boxes add it back.
        metres_per_unit: None where the unit of length is unknown.
        up: unit vector in the world, or None where unknown.
        objects: labeled objects, where the scene has them.
        sfm_points: structure-from-motion points relative to `origin`, with uint8 colors beside them.
        folder: that the scene was read from; None for one that was made.
    """

    name: str
    gaussians: Gaussians | None = None
    views: Views | None = None
    features: dict[str, GaussianFeatures] = field(default_factory=dict)
    origin: Float64[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    metres_per_unit: float | None = None
    up: Float64[np.ndarray, "3"] | None = None
    objects: tuple[SceneObject, ...] = ()
    sfm_points: Float32[np.ndarray, "P 3"] | None = None
    sfm_colors: UInt8[np.ndarray, "P 3"] | None = None
    folder: Path | None = None

    def __post_init__(self) -> None:
        if self.name in ("", ".", "..") or "/" in self.name or "\0" in self.name:
            fail("Scene", "name", "a name that a folder can have", repr(self.name[:60]))
        check_array("Scene", "origin", self.origin, "float64", (3,))
        if not np.isfinite(self.origin).all():
            fail("Scene", "origin", "finite values", str(self.origin.tolist()))
        if self.metres_per_unit is not None:
            check_unit(self.metres_per_unit, "Scene.metres_per_unit")
        if self.up is not None:
            check_array("Scene", "up", self.up, "float64", (3,))
            if not abs(float(np.linalg.norm(self.up)) - 1) <= UNIT_TOLERANCE:
                fail("Scene", "up", "a unit vector or None", str(self.up.tolist()))
        for name, features in self.features.items():
            if self.gaussians is None or len(features) != len(self.gaussians):
                got = "no Gaussians" if self.gaussians is None else f"{len(self.gaussians)} Gaussians"
                fail("Scene", f"features[{name!r}]", f"{len(features)} Gaussians to lie on", got)
