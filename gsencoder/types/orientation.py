"""EXIF orientations: how the stored pixels of a photograph are turned so that people see it upright.

Cameras and pixels of `Views` are those of the stored pixels, as COLMAP's poses are; `Views.orientations` says how they
are turned. Teachers see upright pictures, up is that of upright pictures, and pictures for people are upright.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float64

from gsencoder.types.features import FeatureMap
from gsencoder.types.scene import LAZY, Cameras, Scene, Views

TURNS = {
    1: (False, False, False), 2: (False, True, False), 3: (False, True, True), 4: (False, False, True),
    5: (True, False, False), 6: (True, True, False), 7: (True, True, True), 8: (True, False, True),
}  # fmt: skip
"""By EXIF orientation: whether rows and columns are exchanged, and then columns and rows reversed."""
INVERSE = {1: 1, 2: 2, 3: 3, 4: 4, 5: 5, 6: 8, 7: 7, 8: 6}
UNMIRRORED = {1: 1, 2: 1, 3: 3, 4: 3, 5: 6, 6: 6, 7: 8, 8: 8}
"""The rotation with the same up; of mirrored orientations a reflection (2) is left over."""
EXCHANGED = (5, 6, 7, 8)  # Orientations that exchange width and height


def turned(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Stored pixels [H, W, …] made upright; `INVERSE[orientation]` turns them back."""
    exchange, columns, rows = TURNS[orientation]
    upright = pixels.swapaxes(0, 1) if exchange else pixels
    return np.ascontiguousarray(upright[:: -1 if rows else 1, :: -1 if columns else 1])


class TurnedPictures(Sequence[Any]):
    """Pictures of views, each turned on access."""

    def __init__(self, pictures: Sequence[np.ndarray], orientations: Sequence[int]) -> None:
        self._pictures, self._orientations = pictures, orientations

    def __len__(self) -> int:
        return len(self._pictures)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return TurnedPictures(self._pictures[index], self._orientations[index])
        return turned(self._pictures[index], self._orientations[index])


def upright_views(views: Views, *, unmirror: bool = False) -> Views:
    """The same views with cameras that stand upright, and their pictures; a camera turns about its optical axis.

    Args:
        unmirror: whether pictures that the orientation mirrors are mirrored as well, as people see them. Their cameras
            cannot be, so that geometry fits only without it; `orientations` of the result then say what is left.
    """
    if views.orientations is None or (not unmirror and max(map(UNMIRRORED.__getitem__, views.orientations)) == 1):
        return views
    rotations = [UNMIRRORED[orientation] for orientation in views.orientations]
    mirrored = tuple(1 if UNMIRRORED[each] == each else 2 for each in views.orientations)
    orientations = list(views.orientations) if unmirror else rotations
    lazy: dict[str, Any] = {
        name: None if (pictures := getattr(views, name)) is None else TurnedPictures(pictures, orientations)
        for name in LAZY
    }
    return replace(
        views,
        cameras=_turned_cameras(views.cameras, rotations),
        orientations=None if unmirror or max(mirrored, default=1) == 1 else mirrored,
        **lazy,
    )


def upright_scene(scene: Scene) -> Scene:
    """The scene with upright views, for pictures that people or models see."""
    if scene.views is None or scene.views.orientations is None:
        return scene
    return replace(scene, views=upright_views(scene.views))


def _turned_cameras(cameras: Cameras, rotations: Sequence[int]) -> Cameras:
    poses, Ks = cameras.cam_from_world.copy(), cameras.Ks.copy()
    sizes = np.stack((cameras.widths, cameras.heights), axis=1)
    for view, rotation in enumerate(rotations):
        exchange, *reverse = TURNS[rotation]
        axes = [1, 0] if exchange else [0, 1]
        signs = np.where(reverse, -1, 1).astype(np.float32)
        poses[view, :2] = signs[:, None] * poses[view, axes]
        sizes[view] = sizes[view, axes]
        Ks[view, [0, 1], [0, 1]] = cameras.Ks[view, axes, axes]
        centers = cameras.Ks[view, axes, 2]
        Ks[view, :2, 2] = np.where(reverse, sizes[view] - centers, centers)
    widths, heights = sizes.T.copy()
    return Cameras(cam_from_world=poses, Ks=Ks, widths=widths, heights=heights)


def stored_map(feature_map: FeatureMap, orientation: int, width: int, height: int) -> FeatureMap:
    """The map of an upright picture as the map of its stored pixels.

    Args:
        width: of the stored picture, pixels.
        height: of the stored picture, pixels.
    """
    exchange, *reverse = TURNS[orientation]
    lengths = (height, width) if exchange else (width, height)
    affine: Float64[np.ndarray, "2 3"] = feature_map.grid_from_image
    scales, shifts = affine[[0, 1], [0, 1]], affine[:, 2].copy()
    for axis, cells in enumerate((feature_map.width, feature_map.height)):
        if reverse[axis]:
            shifts[axis] = cells - scales[axis] * lengths[axis] - shifts[axis]
    axes = [1, 0] if exchange else [0, 1]
    stored = np.column_stack((np.diag(scales[axes]), shifts[axes]))
    forms: dict[str, Any] = {
        name: turned(form, INVERSE[orientation])
        for name in ("features", "codes", "shares")
        if (form := getattr(feature_map, name)) is not None
    }
    return replace(feature_map, grid_from_image=stored, **forms)
