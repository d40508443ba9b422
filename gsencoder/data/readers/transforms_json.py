"""transforms.json of nerfstudio, instant-ngp and Blender (NeRF synthetic).

`transform_matrix` is world_from_camera with OpenGL axes (x right, y up, z backward); y and z are turned round on load.
Values of a frame come before those of the file. Distortion (k1, k2, k3, k4, p1, p2) is OpenCV's, of the perspective
or, for OPENCV_FISHEYE or `is_fisheye`, of the equidistant model. `ply_file_path` names points of the same world.
`scale`, `offset` and `aabb_scale` are not used: the world is that of the matrices, and `applied_transform` only says
which one a splat may be in (`gsencoder.data.splat_frame`). Intrinsics may be of the upright picture where the file is
stored sideways (EXIF); its width and height, which differ, tell.

Beside the keys of those programs these are read: `instance_file_path` (integers, 0 = none) for a frame, and
`metres_per_unit` and `up` for the file; for both, `depth_camera` (an object with fl_x, fl_y, cx and cy, for the depth
file's pixels) and `depth_from_color` (4×4, OpenCV axes, world units), where depth is not registered to color,
`depth_measure` ("z", the default, or "ray", the distance from the camera) and `no_depth` (a step that means none,
besides 0).
"""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, UInt8

from gsencoder.core.errors import InputError
from gsencoder.core.files import check_written, read_foreign_text
from gsencoder.data.readers.image_file import picture_info, picture_size
from gsencoder.data.readers.posed import (
    PosedImage,
    PosedImages,
    inside,
    number,
    rigid_pose,
    warn_left_out,
)
from gsencoder.data.readers.undistort import CameraModel, check_camera
from gsencoder.data.splat_formats.ply import read_points
from gsencoder.types.checks import OPENCV_FROM_OPENGL, invert_rigid
from gsencoder.types.orientation import EXCHANGED

PERSPECTIVE = ("", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "PERSPECTIVE")
NERFSTUDIO_DEPTH_SCALE = 1e-3
"""nerfstudio's own default for depth_unit_scale_factor: integer millimetres."""
GUESSED_SUFFIXES = (".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG", ".webp")

CAMERA_KEYS = {
    "w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "camera_angle_x",
    "camera_angle_y", "camera_model", "is_fisheye", "depth_unit_scale_factor", "integer_depth_scale", "depth_camera",
    "depth_from_color", "depth_measure", "no_depth",
}  # fmt: skip
FILE_KEYS = {"frames", "metres_per_unit", "up", "ply_file_path"}
FRAME_KEYS = {"file_path", "transform_matrix", "depth_file_path", "depth_path", "mask_path", "instance_file_path"}
"""Keys that are read here: of cameras, for the file or a frame, and of one of these alone."""

TRANSFORMS = ("transforms.json", "transforms_train.json")
"""The names that such files have."""


def read_json(path: Path, *, unique_keys: bool = False) -> Any:
    """The content of a JSON file.

    Args:
        path: of the file.
        unique_keys: refuse objects that have a key twice, of which JSON's readers take the last.

    Raises:
        InputError: unreadable, not UTF-8, not JSON, or a key is there twice.
    """

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        keys = [key for key, _ in pairs]
        repeated = next((key for key in keys if keys.count(key) > 1), None) if len(set(keys)) < len(keys) else None
        if repeated is not None:
            raise InputError(f"{path}: the key {repeated[:40]!r} is there twice; expected each once")
        return dict(pairs)

    check_written(path)
    try:
        text = read_foreign_text(path)
        return json.loads(text, object_pairs_hook=unique if unique_keys else None)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: not a readable JSON file ({' '.join(str(error).split())[:160]})") from error


def read_transforms(
    path: Path,
    *,
    allow_outside: bool = False,
    depth_scale: float | None = None,
    pictures: Path | None = None,
    masks: Path | None = None,
) -> PosedImages:
    """Reads a transforms.json.

    Args:
        path: the JSON file; its folder is the scene folder, which paths in it may not leave.
        allow_outside: let them.
        depth_scale: world units for each step of a depth file; None = what the file says, else millimetres.
        pictures: the folder that `file_path` is relative to; None = that of the file.
        masks: the folder that `mask_path` is relative to; None = that of the file.

    Returns:
        Posed pictures in OpenCV axes. The unit is the metre and up is +z where the file says so, or where it has
        depth with a `depth_unit_scale_factor`; otherwise both are unknown.

    Raises:
        InputError: no frame, a pose that is not rigid, intrinsics that are not finite, a repeated name, a path that
            leaves the folder, an unknown camera model; the message names the frame.
    """
    data = read_json(path)
    if not isinstance(data, dict) or not isinstance(data.get("frames"), list) or not data["frames"]:
        raise InputError(f"{path}: expected an object with a list of frames (nerfstudio, instant-ngp or Blender)")
    frames, root, source = data["frames"], path.parent, path.name
    images: list[PosedImage] = []
    missing: dict[str, list[str]] = {"image": [], "depth": [], "mask": [], "instance": []}
    names: set[str] = set()
    metric_depth = False
    for index, frame in enumerate(frames):
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str) or not frame["file_path"]:
            raise InputError(f"{path}: frame {index} has no file_path")
        name = frame["file_path"]
        where = f"{path}: frame {index} ({name[:120]!r})"
        if name in names:
            raise InputError(f"{where}: this file_path is repeated; every frame needs its own")
        names.add(name)
        image = _find_image(pictures or root, name, where, allow_outside=allow_outside)
        if image is None:
            missing["image"].append(name)
            continue
        beside: dict[str, Path | None] = {}
        for kind, keys in (
            ("depth", ("depth_file_path", "depth_path")),
            ("mask", ("mask_path",)),
            ("instance", ("instance_file_path",)),
        ):
            file_name = next((frame[key] for key in keys if frame.get(key) is not None), None)
            beside[kind] = None
            if file_name is None:
                continue
            if not isinstance(file_name, str):
                raise InputError(f"{where}: {keys[0]} must be a path, got {str(file_name)[:40]!r}")
            home = masks if kind == "mask" and masks is not None else root
            file = inside(home, file_name, where, allow_outside=allow_outside)
            if file.is_file():
                beside[kind] = file
            else:
                missing[kind].append(file_name)
        camera = _camera(data, frame, image, where)
        file_scale = number(data | frame, "depth_unit_scale_factor", where)
        if frame.get("depth_file_path") is None:
            file_scale = number(data | frame, "integer_depth_scale", where) if frame.get("depth_path") else None
        elif file_scale is not None:
            metric_depth = True
        scale = next(value for value in (depth_scale, file_scale, NERFSTUDIO_DEPTH_SCALE) if value is not None)
        if not 0 < scale < math.inf:
            raise InputError(f"{where}: the depth scale must be positive, got {scale}")
        pose = rigid_pose(read_matrix(frame, "transform_matrix", where), where)
        depth_camera, depth_from_color = _depth_sensor(data | frame, beside["depth"], where)
        measure, no_depth = (data | frame).get("depth_measure", "z"), number(data | frame, "no_depth", where)
        if measure not in ("z", "ray"):
            raise InputError(f"{where}: depth_measure must be z or ray, got {str(measure)[:40]!r}")
        if no_depth is not None and (no_depth < 0 or no_depth != int(no_depth)):
            raise InputError(f"{where}: no_depth must be an integer of at least 0, got {no_depth:g}")
        images.append(
            PosedImage(
                name=name,
                camera=camera,
                cam_from_world=invert_rigid(pose @ OPENCV_FROM_OPENGL),
                image=image,
                depth=beside["depth"],
                depth_camera=depth_camera,
                depth_from_color=depth_from_color,
                depth_scale=scale,
                depth_measure=measure,
                no_depth=None if no_depth is None else int(no_depth),
                mask=beside["mask"],
                instance=beside["instance"],
            )
        )
    total = len(frames)
    if not images:
        raise InputError(f"{path}: none of the {total} listed images exists (first: {missing['image'][0][:200]!r})")
    warn_left_out(missing["image"], total, source, "listed images", "their frames are left out")
    warn_left_out(missing["depth"], total, source, "listed depth files", "those views have no depth")
    warn_left_out(missing["mask"], total, source, "listed masks", "all pixels of those views are used")
    warn_left_out(missing["instance"], total, source, "listed instance maps", "those views have no instances")
    points, colors, points_file = _points(data, path, allow_outside=allow_outside)
    metres = number(data, "metres_per_unit", str(path))
    if metres is not None and metres <= 0:
        raise InputError(f"{path}: metres_per_unit must be positive, got {metres:g}")
    return PosedImages(
        source=str(path),
        images=tuple(images),
        metres_per_unit=metres if metres is not None else (1.0 if metric_depth else None),
        up=_up(data.get("up"), path)
        if data.get("up") is not None
        else (np.array([0, 0, 1.0]) if metric_depth else None),
        points=points,
        colors=colors,
        points_file=points_file,
        unused=_unused_keys(path, data, frames),
    )


def _points(
    data: dict[str, Any], path: Path, *, allow_outside: bool
) -> tuple[Float64[np.ndarray, "P 3"], UInt8[np.ndarray, "_ 3"], Path | None]:
    """The points that `ply_file_path` names, their colors if they have any, and the file; in the world of the matrices,
    as nerfstudio writes them."""
    name, none = data.get("ply_file_path"), (np.zeros((0, 3)), np.zeros((0, 3), np.uint8), None)
    if name is None or name == "":
        return none
    if not isinstance(name, str):
        raise InputError(f"{path}: ply_file_path must be a path, got {str(name)[:40]!r}")
    file = inside(path.parent, name, f"{path}: ply_file_path", allow_outside=allow_outside)
    if not file.is_file():
        warn_left_out([name], 1, path.name, "files of points", "seeds come from elsewhere")
        return none
    points, colors = read_points(file)
    return points, none[1] if colors is None else colors, file


def _unused_keys(path: Path, data: dict[str, Any], frames: list[dict[str, Any]]) -> tuple[str, ...]:
    """Keys of a file and of its frames that nothing here reads."""
    of_file = [key for key in data if key not in FILE_KEYS | CAMERA_KEYS]
    of_frames = dict.fromkeys(key for frame in frames for key in frame if key not in FRAME_KEYS | CAMERA_KEYS)
    lists = ((of_file, f"key {{}} of {path.name}"), (of_frames, f"key {{}} of the frames of {path.name}"))
    return tuple(form.format(key[:40]) for keys, form in lists for key in keys)


def _find_image(root: Path, name: str, where: str, *, allow_outside: bool) -> Path | None:
    """The file of a frame; Blender leaves the suffix away."""
    for suffix in ("", *GUESSED_SUFFIXES):
        file = inside(root, name + suffix, where, allow_outside=allow_outside)
        if file.is_file():
            return file
    return None


def _depth_sensor(
    values: dict[str, Any], depth: Path | None, where: str
) -> tuple[CameraModel | None, Float64[np.ndarray, "4 4"] | None]:
    """The camera of the depth map and where it stands, from `depth_camera` and `depth_from_color`; None = as the
    photograph's."""
    camera = None
    camera_keys = values.get("depth_camera")
    if camera_keys is not None and depth is not None:
        if not isinstance(camera_keys, dict):
            raise InputError(f"{where}: depth_camera must be an object with fl_x, fl_y, cx and cy")
        camera = _camera({}, camera_keys, depth, f"{where}: depth_camera")
    if values.get("depth_from_color") is None:
        return camera, None
    return camera, rigid_pose(read_matrix(values, "depth_from_color", where), f"{where}: depth_from_color")


def read_matrix(values: dict[str, Any], key: str, where: str) -> Float64[np.ndarray, "4 4"]:
    """A matrix of 4 rows, or of the upper 3, of a JSON object; whether it is a pose is not asked.

    Raises:
        InputError: the key is missing, or its value is no such matrix of finite numbers; `where` starts the message.
    """
    value = values.get(key)
    rows = value if isinstance(value, list) else []
    good = len(rows) in (3, 4) and all(isinstance(row, list) and len(row) == 4 for row in rows)
    if not good:
        raise InputError(f"{where}: {key} must have 4 rows (or the upper 3) of 4 numbers")
    matrix = np.eye(4)
    for i, row in enumerate(rows):
        for j, entry in enumerate(row):
            element = number({key: entry}, key, where)
            if element is None:
                raise InputError(f"{where}: {key} has an empty entry in row {i}")
            matrix[i, j] = element
    return matrix


def _up(value: object, path: Path) -> Float64[np.ndarray, "3"]:
    if not isinstance(value, list) or len(value) != 3:
        raise InputError(f"{path}: up must be three numbers")
    parts = [number({"up": entry}, "up", str(path)) for entry in value]
    up = np.array([np.nan if part is None else part for part in parts])
    length = math.hypot(*up.tolist())
    if not 1e-6 < length < 1e6:
        raise InputError(f"{path}: up must be three finite numbers that are not all zero, got {value}")
    return up / length


def _camera(data: dict[str, Any], frame: dict[str, Any], image: Path, where: str) -> CameraModel:
    """The intrinsics of a frame: its own values first, then the file's."""
    both = data | {key: value for key, value in frame.items() if value is not None}
    w, h = _size_of_camera(both, image, where)
    fx = _focal(data, frame, "fl_x", "camera_angle_x", w, where)
    fy = _focal(data, frame, "fl_y", "camera_angle_y", h, where)
    if fx is None and fy is None:
        raise InputError(f"{where}: no focal length; expected fl_x, or camera_angle_x in radians")
    cx, cy = number(both, "cx", where), number(both, "cy", where)
    k1, k2, k3, k4, p1, p2 = (number(both, key, where) or 0.0 for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    fx, fy = fx if fx is not None else fy, fy if fy is not None else fx
    assert fx is not None
    assert fy is not None
    base = (fx, fy, w / 2 if cx is None else cx, h / 2 if cy is None else cy)
    further = number(both, "k5", where) or number(both, "k6", where)
    model = both.get("camera_model", "")
    if not isinstance(model, str):
        raise InputError(f"{where}: camera_model must be a name, got {str(model)[:40]!r}")
    if model == "OPENCV_FISHEYE" or (model in PERSPECTIVE and both.get("is_fisheye") is True):
        if p1 or p2 or further:
            raise InputError(f"{where}: p1 and p2, k5 and k6 do not belong to OPENCV_FISHEYE")
        camera = CameraModel(model="OPENCV_FISHEYE", width=w, height=h, params=(*base, k1, k2, k3, k4))
    elif model not in PERSPECTIVE:
        raise InputError(f"{where}: camera model {model[:40]!r} is not supported; expected OPENCV or OPENCV_FISHEYE")
    elif k4 or further:
        raise InputError(
            f"{where}: k4, k5, k6 of a perspective camera have no agreed meaning; expected k1 to k3, p1, p2"
        )
    elif k3:
        camera = CameraModel(model="FULL_OPENCV", width=w, height=h, params=(*base, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0))
    else:
        camera = CameraModel(model="OPENCV", width=w, height=h, params=(*base, k1, k2, p1, p2))
    check_camera(camera, where)
    return camera


def _size_of_camera(values: dict[str, Any], image: Path, where: str) -> tuple[int, int]:
    """The size of the picture that intrinsics are of: as its pixels are stored, or of the upright picture, where only
    that has the stated width and height, or else, of the two, where the principal point is as far right as down."""
    stored = picture_size(image)
    w, h, cx, cy = (number(values, key, where) for key in ("w", "h", "cx", "cy"))
    is_sideways = image.suffix.lower() != ".npy" and picture_info(image)[2] in EXCHANGED
    sizes = [
        size for size in (stored, stored[::-1])[: 1 + is_sideways] if w in (None, size[0]) and h in (None, size[1])
    ]
    if not sizes:
        key, pixels, actual = ("w", w, stored[0]) if w not in (None, stored[0]) else ("h", h, stored[1])
        raise InputError(
            f"{where}: {key} is {pixels:g} but the image {image} has {actual} pixels; give the images at the size "
            "of the intrinsics (image_scale makes them smaller on load)"
        )

    return min(sizes, key=lambda size: abs((cx or 0) / size[0] - (cy or 0) / size[1]))


def _focal(data: dict[str, Any], frame: dict[str, Any], length: str, angle: str, side: int, where: str) -> float | None:
    """A focal length in pixels from a length or, where there is none, a full field of view in radians."""
    for values in (frame, data):
        focal = number(values, length, where)
        if focal is not None:
            return focal
        field = number(values, angle, where)
        if field is not None:
            if not 0 < field < math.pi:
                raise InputError(f"{where}: {angle} must lie between 0 and pi radians, got {field:g}")
            return side / (2 * math.tan(field / 2))
    return None
