"""Cameras from a JSON file: poses that a user asks from, in world coordinates.

A file holds one camera or a list of cameras, each an object of

    cam_from_world     4×4 (or its upper 3 rows), OpenCV axes; or, in its place,
    transform_matrix   world_from_camera with OpenGL axes, as in nerfstudio's transforms.json
    fx, fy, cx, cy     in pixels, pixel centers at .5; or nerfstudio's fl_x and fl_y
    width, height      in pixels; or nerfstudio's w and h

Other keys are refused, since lens distortion and misspelled keys are among them.
"""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from gsencoder.core.errors import InputError, listed
from gsencoder.data.readers.posed import number, rigid_pose
from gsencoder.data.readers.transforms_json import read_json, read_matrix
from gsencoder.types import Cameras
from gsencoder.types.checks import OPENCV_FROM_OPENGL, invert_rigid, move_origin
from gsencoder.types.scene import intrinsic_matrix

MAX_CAMERAS = 10_000
MAX_PIXELS = 1 << 24
"""A blend of so many pixels takes gigabytes."""
POSES = ("cam_from_world", "transform_matrix")
INTRINSICS = (("fx", "fl_x"), ("fy", "fl_y"), ("cx",), ("cy",), ("width", "w"), ("height", "h"))
"""Each with the names that it may have."""


def read_cameras(path: Path, origin: Float64[np.ndarray, "3"]) -> Cameras:
    """Reads the cameras of a JSON file.

    Args:
        path: of the file.
        origin: of the scene, which is taken off the poses in float64.

    Returns:
        The cameras in the order of the file, relative to the origin.

    Raises:
        InputError: no such file, not JSON, no camera, a key that is missing or unknown, a pose that is not rigid,
            values that are not finite, sizes or focal lengths that are not positive; the message names the camera.
    """
    data = read_json(path, unique_keys=True)
    entries = data if isinstance(data, list) else [data]
    if not 1 <= len(entries) <= MAX_CAMERAS:
        raise InputError(f"{path}: expected a camera or a list of 1 to {MAX_CAMERAS:,} cameras, got {len(entries)}")
    poses, Ks, sizes = [], [], []
    for index, entry in enumerate(entries):
        where = f"{path}: camera {index}" if isinstance(data, list) else str(path)
        if not isinstance(entry, dict):
            raise InputError(f"{where}: expected an object with cam_from_world, fx, …, got {str(entry)[:40]!r}")
        pose, K, size = _camera(entry, where)
        poses.append(move_origin(pose, origin))
        Ks.append(K)
        sizes.append(size)
    widths, heights = np.array(sizes, np.int32).T.copy()
    return Cameras(
        cam_from_world=np.array(poses, np.float32), Ks=np.array(Ks, np.float32), widths=widths, heights=heights
    )


def _camera(
    entry: dict[str, Any], where: str
) -> tuple[Float64[np.ndarray, "4 4"], Float64[np.ndarray, "3 3"], tuple[int, int]]:
    """Pose, intrinsics and size (width, height)."""
    keys = (*POSES, *(name for names in INTRINSICS for name in names))
    unknown = [str(key)[:40] for key in entry if key not in keys]
    if unknown:
        raise InputError(f"{where}: unknown keys {listed(unknown)}; expected {', '.join(keys)}")
    pose_key = _key(entry, POSES, where)
    pose = rigid_pose(read_matrix(entry, pose_key, where), f"{where}: {pose_key}")
    if pose_key == "transform_matrix":
        pose = invert_rigid(pose @ OPENCV_FROM_OPENGL)
    fx, fy, cx, cy, width, height = (_number(entry, _key(entry, names, where), where) for names in INTRINSICS)
    for name, focal in (("fx", fx), ("fy", fy)):
        # Cameras are held in float32, in which 1e-50 is zero and 1e300 infinite.
        if not 1e-9 <= focal <= 1e9:
            raise InputError(f"{where}: {name} must be a positive number of pixels, 1e-9 to 1e9, got {focal:g}")
    for name, value in (("cx", cx), ("cy", cy)):
        if not abs(value) <= 1e9:
            raise InputError(f"{where}: {name} must lie within 1e9 pixels, got {value:g}")
    for name, side in (("width", width), ("height", height)):
        if side < 1 or side != int(side):
            raise InputError(f"{where}: {name} must be a whole number of pixels from 1, got {side:g}")
    if width * height > MAX_PIXELS:
        raise InputError(f"{where}: {width:g}×{height:g} pixels are too many; expected at most {MAX_PIXELS:,}")
    return pose, intrinsic_matrix(fx, fy, cx, cy), (int(width), int(height))


def _key(entry: dict[str, Any], names: tuple[str, ...], where: str) -> str:
    """The one of these names that an object has."""
    there = [name for name in names if entry.get(name) is not None]
    if len(there) != 1:
        expected = " or ".join(names)
        raise InputError(f"{where}: {expected} is missing" if not there else f"{where}: expected {expected}, got both")
    return there[0]


def _number(entry: dict[str, Any], key: str, where: str) -> float:
    value = number(entry, key, where)
    assert value is not None
    return value
