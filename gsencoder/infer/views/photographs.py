"""Photographs for the frames of a scene that was stored without them, and windows cut from them."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Int64, UInt8
from PIL import Image

from gsencoder.core.errors import InputError, listed
from gsencoder.types import Cameras, Scene, Views
from gsencoder.types.orientation import upright_scene, upright_views

ANGLE_TOLERANCE, POSITION_TOLERANCE = 0.01, 1e-3
"""How far two readings of one camera may be from each other: radians or parts of a focal length, and parts of the
distance between cameras."""
MAX_NAMED = 3
POSE_TOLERANCE_PIXELS = 0.5
"""A window that ends so near to the photograph's edges is all of it, pixels: sizes of smaller frames are rounded."""


class FramePhotographs(Sequence[UInt8[np.ndarray, "H W 3"]]):
    """Pictures of a scene in the order and the sizes of other cameras, read on access."""

    def __init__(self, views: Views, rows: Int64[np.ndarray, " n"], cameras: Cameras) -> None:
        self.views, self.rows, self._cameras = views, rows, cameras

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return FramePhotographs(self.views, self.rows[index], self._cameras.select(index))
        size = int(self._cameras.widths[index]), int(self._cameras.heights[index])
        return resized_picture(self.photograph_at(index), size)

    def photograph_at(self, index: int) -> UInt8[np.ndarray, "_ _ 3"]:
        """A picture in the size that it was taken in."""
        assert self.views.images is not None
        return self.views.images[int(self.rows[index])]

    @property
    def cameras(self) -> Cameras:
        """The cameras in the sizes that the pictures were taken in."""
        photograph_at = self.views.cameras.select(self.rows)
        return self._cameras.resized_to(photograph_at.widths, photograph_at.heights)


def photograph_cameras(views: Views) -> Cameras:
    """The cameras of views in the sizes that their photographs were taken in."""
    return views.images.cameras if isinstance(views.images, FramePhotographs) else views.cameras


def with_upright_frames(scene: Scene) -> Scene:
    """The scene with upright frames, and photographs in the sizes that they were taken in."""
    upright, images = upright_scene(scene), scene.views.images if scene.views is not None else None
    if upright.views is None or upright is scene or not isinstance(images, FramePhotographs):
        return upright
    images = FramePhotographs(upright_views(images.views), images.rows, upright.views.cameras)
    return replace(upright, views=replace(upright.views, images=images))


def resized_picture(picture: UInt8[np.ndarray, "H W 3"], size: tuple[int, int]) -> UInt8[np.ndarray, "h w 3"]:
    """A picture of another width and height."""
    image = Image.fromarray(picture)
    return picture if image.size == size else np.asarray(image.resize(size, Image.Resampling.LANCZOS))


def photograph_of(views: Views, frame: int, cameras: Cameras, view: int) -> UInt8[np.ndarray, "H W 3"]:
    """What a camera in a frame's place shows of its photograph: all or a window, by its K, in the camera's size."""
    assert views.images is not None
    picture = views.images.photograph_at(frame) if isinstance(views.images, FramePhotographs) else views.images[frame]
    size = int(cameras.widths[view]), int(cameras.heights[view])
    window = photograph_window(views, frame, cameras, view, (picture.shape[1], picture.shape[0]))
    if window is None:
        return resized_picture(picture, size)
    return np.asarray(Image.fromarray(picture).resize(size, Image.Resampling.LANCZOS, box=window))


def photograph_window(
    views: Views, frame: int, cameras: Cameras, view: int, size: tuple[int, int]
) -> tuple[float, float, float, float] | None:
    """Which part of a frame's photograph, of a width and height, a camera in its place shows: left, upper, right and
    lower edge in pixels of the photograph; None for all of it."""
    frame_K, view_K = views.cameras.Ks[frame].astype(np.float64), cameras.Ks[view].astype(np.float64)
    shown = np.array([cameras.widths[view], cameras.heights[view]])
    # Pixels of the frame's camera: where the window begins, and how large it is; then pixels as they were taken.
    zoom = np.diag(frame_K)[:2] / np.diag(view_K)[:2]
    begins = frame_K[:2, 2] - zoom * view_K[:2, 2]
    photograph_at = np.array(size) / (views.cameras.widths[frame], views.cameras.heights[frame])
    low, high = (np.clip(photograph_at * edge, 0, size) for edge in (begins, begins + zoom * shown))
    if max(np.abs(low).max(), np.abs(high - size).max()) < POSE_TOLERANCE_PIXELS:
        return None
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def with_photographs(scene: Scene, photographed: Scene) -> Scene:
    """A scene whose frames have the photographs of the same names that another reading of it has, in whatever size."""
    if scene.views is None or not len(scene.views):
        raise InputError(f"photos: the features of {scene.name} have no cameras that photographs could belong to")
    if photographed.views is None or photographed.views.images is None:
        raise InputError(f"photos: scene {photographed.name} has no photographs")
    row_of = {name: row for row, name in enumerate(photographed.views.names)}
    missing = [name for name in scene.views.names if name not in row_of]
    if missing:
        raise InputError(
            f"photos: scene {photographed.name} has no photograph of {len(missing)} of {len(scene.views)} frames: "
            f"{listed(missing, MAX_NAMED)}"
        )
    rows = np.array([row_of[name] for name in scene.views.names], np.int64)
    scene_cameras, photo_cameras = scene.views.cameras, photographed.views.cameras.select(rows)
    apart = [
        scene.views.names[view]
        for view in np.flatnonzero(_differ(scene_cameras, photo_cameras, photographed.origin - scene.origin))
    ]
    if apart:
        raise InputError(
            f"photos: the cameras of scene {photographed.name} are not those of the features: {len(apart)} of "
            f"{len(scene.views)} differ, {listed(apart, MAX_NAMED)}; give the scene that the features were made from"
        )
    images = FramePhotographs(photographed.views, rows, scene_cameras)
    orientations = photographed.views.select(rows).orientations
    return replace(scene, views=replace(scene.views, images=images, orientations=orientations))


def _differ(scene_cameras: Cameras, photo_cameras: Cameras, offset: np.ndarray) -> np.ndarray:
    """Which cameras of two lists are not the same, whatever the sizes of their pictures."""
    sizes = [np.stack((each.widths, each.heights), axis=1) for each in (scene_cameras, photo_cameras)]
    fields = [
        each.Ks[:, :2].astype(np.float64) / size[:, :, None]
        for each, size in zip((scene_cameras, photo_cameras), sizes, strict=True)
    ]
    rotation_error = np.abs(scene_cameras.cam_from_world[:, :3, :3] - photo_cameras.cam_from_world[:, :3, :3]).max(
        axis=(1, 2)
    )
    centers = scene_cameras.centers
    distance = np.linalg.norm(photo_cameras.centers + offset - centers, axis=1)
    # Single precision keeps positions to a ten-millionth of their distance from the origin.
    spread = np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()
    position_tolerance = POSITION_TOLERANCE * spread + 1e-5 * np.abs(centers).max()
    intrinsics_error = np.abs(fields[0] - fields[1]).max(axis=(1, 2))
    return np.asarray(
        (rotation_error > ANGLE_TOLERANCE) | (distance > position_tolerance) | (intrinsics_error > ANGLE_TOLERANCE)
    )
