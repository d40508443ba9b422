"""Posed images as a transforms.json that `read_transforms` reads back: the same cameras, poses, depth and masks."""

import os
from pathlib import Path
from typing import Any

from gsencoder.core.errors import InputError
from gsencoder.data.readers.posed import PosedImage, PosedImages
from gsencoder.data.readers.undistort import CameraModel, focal_count
from gsencoder.types.checks import OPENCV_FROM_OPENGL, invert_rigid

DISTORTION = {
    "SIMPLE_PINHOLE": (),
    "PINHOLE": (),
    "SIMPLE_RADIAL": ("k1",),
    "RADIAL": ("k1", "k2"),
    "OPENCV": ("k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("k1", "k2", "p1", "p2", "k3"),
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
}
"""Names of the parameters that follow the principal point, of the camera models that transforms.json can express."""


def transforms_of(posed: PosedImages, folder: Path) -> dict[str, Any]:
    """The content of a transforms.json in `folder` for posed images; points are part of it where a .ply holds them.

    Raises:
        InputError: a camera model that the format does not have.
    """
    content: dict[str, Any] = {}
    if posed.metres_per_unit is not None:
        content["metres_per_unit"] = posed.metres_per_unit
    if posed.up is not None:
        content["up"] = posed.up.tolist()
    if posed.points_file is not None:
        content["ply_file_path"] = _relative(posed.points_file, folder)
    content["frames"] = [_frame(image, folder) for image in posed.images]
    return content


def _frame(image: PosedImage, folder: Path) -> dict[str, Any]:
    frame: dict[str, Any] = {"file_path": _relative(image.image, folder), **_camera(image.camera)}
    world_from_cam = invert_rigid(image.cam_from_world) @ OPENCV_FROM_OPENGL
    frame["transform_matrix"] = world_from_cam.tolist()
    if image.depth is not None:
        frame["depth_file_path"] = _relative(image.depth, folder)
        frame["depth_unit_scale_factor"] = image.depth_scale
        if image.depth_measure != "z":
            frame["depth_measure"] = image.depth_measure
        if image.no_depth is not None:
            frame["no_depth"] = image.no_depth
        if image.depth_camera is not None:
            frame["depth_camera"] = _camera(image.depth_camera)
        if image.depth_from_color is not None:
            frame["depth_from_color"] = image.depth_from_color.tolist()
    if image.mask is not None:
        frame["mask_path"] = _relative(image.mask, folder)
    if image.instance is not None:
        frame["instance_file_path"] = _relative(image.instance, folder)
    return frame


def _camera(camera: CameraModel) -> dict[str, Any]:
    if camera.model not in DISTORTION or (camera.model == "FULL_OPENCV" and any(camera.params[9:])):
        raise InputError(
            f"camera model {camera.model} cannot be written to a transforms.json; it has {', '.join(DISTORTION)}"
        )
    fx, fy, cx, cy = camera.pinhole_params()
    names, first = DISTORTION[camera.model], focal_count(camera) + 2
    return {
        "camera_model": "OPENCV_FISHEYE" if camera.model == "OPENCV_FISHEYE" else "OPENCV",
        "w": camera.width,
        "h": camera.height,
        "fl_x": fx,
        "fl_y": fy,
        "cx": cx,
        "cy": cy,
        **{name: value for name, value in zip(names, camera.params[first:], strict=False) if value},
    }


def _relative(path: Path, folder: Path) -> str:
    return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()
