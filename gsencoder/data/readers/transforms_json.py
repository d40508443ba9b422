"""transforms.json of nerfstudio, instant-ngp and Blender (NeRF synthetic), and JSON files of cameras and objects.

`transform_matrix` is world_from_camera with OpenGL axes (x right, y up, z backward); y and z are turned round on load.
Values of a frame come before those of the file. Distortion (k1, k2, k3, k4, p1, p2) is OpenCV's, of the perspective
or, for OPENCV_FISHEYE or `is_fisheye`, of the equidistant model. `ply_file_path` names points of the same world.
`scale`, `offset` and `aabb_scale` are not used: the world is that of the matrices, and `applied_transform` only says
which one a splat may be in (`gsencoder.fusion.fit`). Intrinsics may be of the upright picture where the file is
stored sideways (EXIF); its width and height, which differ, tell.

Besides the keys of those programs these are read: `instance_file_path` (integers, 0 = none) for a frame, and
`metres_per_unit` and `up` for the file; for both, `depth_camera` (an object with fl_x, fl_y, cx and cy, for the depth
file's pixels) and `depth_from_color` (4×4, OpenCV axes, world units), where depth is not registered to color,
`depth_measure` ("z", the default, or "ray", the distance from the camera) and `no_depth` (a step that means none,
besides 0).

A camera file holds one camera or a list of cameras that a user asks from, each an object of

    cam_from_world     4×4 (or its upper 3 rows), OpenCV axes; or, in its place,
    transform_matrix   world_from_camera with OpenGL axes, as in nerfstudio's transforms.json
    fx, fy, cx, cy     in pixels, pixel centers at .5; or nerfstudio's fl_x and fl_y
    width, height      in pixels; or nerfstudio's w and h

Other keys are refused, since lens distortion and misspelled keys are among them.
"""

import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, UInt8

from gsencoder.core.errors import InputError, listed
from gsencoder.core.files import read_foreign_text, warn_if_modified
from gsencoder.data.readers.images import picture_info
from gsencoder.data.readers.posed import (
    CameraModel,
    PosedImage,
    PosedImages,
    ReadOptions,
    focal_count,
    inside,
    number,
    numbers,
    pose_in,
    warn_left_out,
)
from gsencoder.data.splats.ply import read_points
from gsencoder.types import Cameras, SceneObject
from gsencoder.types.orientation import EXCHANGED
from gsencoder.types.scene import OPENCV_FROM_OPENGL, intrinsic_matrix, invert_rigid, move_origin

PERSPECTIVE = ("", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "PERSPECTIVE")
NERFSTUDIO_DEPTH_SCALE = 1e-3  # nerfstudio's own default for depth_unit_scale_factor: integer millimetres
GUESSED_SUFFIXES = (".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG", ".webp")

CAMERA_KEYS = {
    "w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "camera_angle_x",
    "camera_angle_y", "camera_model", "is_fisheye", "depth_unit_scale_factor", "integer_depth_scale", "depth_camera",
    "depth_from_color", "depth_measure", "no_depth",
}  # fmt: skip
FILES_OF_FRAME = {
    "image": (("file_path",), "listed images", "their frames are left out"),
    "depth": (("depth_file_path", "depth_path"), "listed depth files", "those views have no depth"),
    "mask": (("mask_path",), "listed masks", "all pixels of those views are used"),
    "instance": (("instance_file_path",), "listed instance maps", "those views have no instances"),
}
"""By field of `PosedImage`: the keys of its file, and what is said where such files are missing."""
FILE_KEYS = {"frames", "metres_per_unit", "up", "ply_file_path"}
FRAME_KEYS = {"transform_matrix", *(key for keys, *_ in FILES_OF_FRAME.values() for key in keys)}
"""Keys that are read here: of cameras, for the file or a frame, and of one of these alone."""

TRANSFORMS = ("transforms.json", "transforms_train.json")  # The names that such files have
OBJECTS_FILE = "objects.json"  # Next to one, the labeled objects of the scene


def read_json(path: Path, *, unique_keys: bool = False) -> Any:
    """The content of a JSON file; with `unique_keys`, objects that have a key twice are refused."""

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        keys = [key for key, _ in pairs]
        if len(set(keys)) < len(keys):
            repeated = next(key for key in keys if keys.count(key) > 1)
            raise InputError(f"{path}: the key {repeated[:40]!r} is there twice; expected each once")
        return dict(pairs)

    warn_if_modified(path)
    try:
        return json.loads(read_foreign_text(path), object_pairs_hook=unique if unique_keys else None)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: not a readable JSON file ({' '.join(str(error).split())[:160]})") from error


def read_transforms(
    path: Path, options: ReadOptions = ReadOptions(), *, pictures: Path | None = None, masks: Path | None = None
) -> PosedImages:
    """Reads a transforms.json; its folder is the scene folder, which paths in it may not leave unless options allow it.

    Args:
        pictures: the folder that `file_path` is relative to; None = that of the file.
        masks: the folder that `mask_path` is relative to; None, or one that does not exist = that of the file.

    Returns:
        Posed pictures in OpenCV axes. The unit is the metre and up is +z where the file says so, or where it has
        depth with a `depth_unit_scale_factor`; otherwise both are unknown.
    """
    data = read_json(path)
    if not isinstance(data, dict) or not isinstance(data.get("frames"), list) or not data["frames"]:
        raise InputError(f"{path}: expected an object with a list of frames (nerfstudio, instant-ngp or Blender)")
    frames, root, allow_outside = data["frames"], path.parent, options.allow_outside
    homes = {"mask": masks} if masks is not None and masks.is_dir() else {}
    images: list[PosedImage] = []
    missing: dict[str, list[str]] = {kind: [] for kind in FILES_OF_FRAME}
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
        # Blender leaves the suffix away.
        candidates = (
            inside(pictures or root, name + suffix, where, allow_outside=allow_outside)
            for suffix in ("", *GUESSED_SUFFIXES)
        )
        image = next((file for file in candidates if file.is_file()), None)
        if image is None:
            missing["image"].append(name)
            continue
        cam_from_world = invert_rigid(pose_in(frame, "transform_matrix", where) @ OPENCV_FROM_OPENGL)
        files: dict[str, Path | None] = dict.fromkeys(FILES_OF_FRAME)
        for kind, (keys, *_) in FILES_OF_FRAME.items():
            key = next((key for key in keys if frame.get(key) is not None), None)
            if key is None or kind == "image":
                continue
            if not isinstance(frame[key], str):
                raise InputError(f"{where}: {key} must be a path, got {str(frame[key])[:40]!r}")
            file = inside(homes.get(kind, root), frame[key], where, allow_outside=allow_outside)
            if file.is_file():
                files[kind] = file
            else:
                missing[kind].append(frame[key])
        metric_depth |= None not in (frame.get("depth_file_path"), (data | frame).get("depth_unit_scale_factor"))
        images.append(
            PosedImage(
                name=name,
                camera=_camera(data, frame, image, where),
                cam_from_world=cam_from_world,
                image=image,
                mask=files["mask"],
                instance=files["instance"],
                **_depth(data | frame, frame, files["depth"], where),
            )
        )
    if not images:
        raise InputError(f"{path}: none of the {len(frames)} listed images exists (first: {name[:200]!r})")
    for kind, names_missing in missing.items():
        if names_missing:
            warn_left_out(names_missing, len(frames), path.name, *FILES_OF_FRAME[kind][1:])
    points, colors, points_file = _points(data, path, allow_outside=allow_outside)
    metres, up = number(data, "metres_per_unit", str(path)), None
    if metres is not None and metres <= 0:
        raise InputError(f"{path}: metres_per_unit must be positive, got {metres:g}")
    if data.get("up") is not None:
        up = numbers(data, "up", str(path), (3,))
        length = math.hypot(*up.tolist())
        if not 1e-6 < length < 1e6:
            raise InputError(f"{path}: up must be three finite numbers that are not all zero, got {data['up']}")
        up = up / length
    elif metric_depth:
        up = np.array([0, 0, 1.0])
    return PosedImages(
        source=str(path),
        images=tuple(images),
        metres_per_unit=1.0 if metres is None and metric_depth else metres,
        up=up,
        points=points,
        colors=colors,
        points_file=points_file,
        objects=read_objects(root / OBJECTS_FILE) if os.path.lexists(root / OBJECTS_FILE) else (),
        unused=_unused_keys(path, data, frames),
    )


def _depth(values: dict[str, Any], frame: dict[str, Any], depth: Path | None, where: str) -> dict[str, Any]:
    """What `PosedImage` says about the depth of a frame; a sensor is None where it is the photograph's camera."""
    key = "integer_depth_scale" if frame.get("depth_file_path") is None else "depth_unit_scale_factor"
    has_scale = frame.get("depth_file_path") is not None or frame.get("depth_path")
    given = number(values, key, where) if has_scale else None
    scale = NERFSTUDIO_DEPTH_SCALE if given is None else given
    measure, no_depth = values.get("depth_measure", "z"), number(values, "no_depth", where)
    camera, camera_keys, from_color = None, values.get("depth_camera"), values.get("depth_from_color")
    if not 0 < scale < math.inf:
        raise InputError(f"{where}: the depth scale must be positive, got {scale}")
    if measure not in ("z", "ray"):
        raise InputError(f"{where}: depth_measure must be z or ray, got {str(measure)[:40]!r}")
    if no_depth is not None and (no_depth < 0 or no_depth != int(no_depth)):
        raise InputError(f"{where}: no_depth must be an integer of at least 0, got {no_depth:g}")
    if camera_keys is not None and depth is not None:
        if not isinstance(camera_keys, dict):
            raise InputError(f"{where}: depth_camera must be an object with fl_x, fl_y, cx and cy")
        camera = _camera({}, camera_keys, depth, f"{where}: depth_camera")
    if from_color is not None:
        from_color = pose_in(values, "depth_from_color", f"{where}: depth_from_color")
    return {
        "depth": depth,
        "depth_camera": camera,
        "depth_from_color": from_color,
        "depth_scale": scale,
        "depth_measure": measure,
        "no_depth": None if no_depth is None else int(no_depth),
    }


def _points(
    data: dict[str, Any], path: Path, *, allow_outside: bool
) -> tuple[Float64[np.ndarray, "P 3"], UInt8[np.ndarray, "_ 3"], Path | None]:
    """The points that `ply_file_path` names, in the world of the matrices, their colors if any, and the file."""
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
    fx, fy = (next(focal for focal in pair if focal is not None) for pair in ((fx, fy), (fy, fx)))
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
        raise InputError(f"{where}: k4, k5, k6 of a perspective camera are not supported; expected k1 to k3, p1, p2")
    elif k3:
        camera = CameraModel(model="FULL_OPENCV", width=w, height=h, params=(*base, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0))
    else:
        camera = CameraModel(model="OPENCV", width=w, height=h, params=(*base, k1, k2, p1, p2))
    return camera


def _size_of_camera(values: dict[str, Any], image: Path, where: str) -> tuple[int, int]:
    """The size of the picture that intrinsics are of: as its pixels are stored, or of the upright picture, where only
    that has that width and height, or else, of the two, where the principal point is as far right as down."""
    w, h, cx, cy = (number(values, key, where) for key in ("w", "h", "cx", "cy"))
    stored, _, orientation = picture_info(image)
    is_sideways = orientation in EXCHANGED
    sizes = [
        size for size in (stored, stored[::-1])[: 1 + is_sideways] if w in (None, size[0]) and h in (None, size[1])
    ]
    if not sizes:
        key, pixels, actual = ("w", w, stored[0]) if w not in (None, stored[0]) else ("h", h, stored[1])
        raise InputError(
            f"{where}: {key} is {pixels:g} but the image {image} has {actual} pixels; give it at this size"
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
    """The content of a transforms.json in `folder` for posed images; points are part of it where a .ply holds them."""
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
    frame: dict[str, Any] = {"file_path": _relative(image.image, folder), **_camera_entry(image.camera)}
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
            frame["depth_camera"] = _camera_entry(image.depth_camera)
        if image.depth_from_color is not None:
            frame["depth_from_color"] = image.depth_from_color.tolist()
    if image.mask is not None:
        frame["mask_path"] = _relative(image.mask, folder)
    if image.instance is not None:
        frame["instance_file_path"] = _relative(image.instance, folder)
    return frame


def _camera_entry(camera: CameraModel) -> dict[str, Any]:
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


MAX_NAME = 1000  # Largest number of characters of a name, as in a text table


def read_objects(path: Path) -> tuple[SceneObject, ...]:
    """Reads a list of {id, name or null, aabb_min, aabb_max, placed, views, max_pixels}; boxes in world coordinates.

    Ids start at 1, since 0 stands for no object in an instance map.
    """
    rows = read_json(path)
    if not isinstance(rows, list):
        raise InputError(f"{path}: expected a list of objects")
    objects: dict[int, SceneObject] = {}
    for index, row in enumerate(rows):
        where = f"{path}: object {index}"
        if not isinstance(row, dict):
            raise InputError(f"{where}: expected an object with id, name, aabb_min and aabb_max")
        key: Any = row.get("id")
        name, placed = row.get("name"), row.get("placed", True)
        counts = {field: row.get(field, 0) for field in ("views", "max_pixels")}
        is_named = name is None or (isinstance(name, str) and len(name) <= MAX_NAME)
        if not is_named or not isinstance(placed, bool):
            raise InputError(f"{where}: name must be null or at most {MAX_NAME:,} characters, placed true or false")
        for field, value, least in (("id", key, 1), *((field, value, 0) for field, value in counts.items())):
            if type(value) is not int or not least <= value < 2**31:
                raise InputError(f"{where}: {field} must be a whole number from {least}, got {str(value)[:40]!r}")
        lower, upper = (numbers(row, corner, where, (3,)) for corner in ("aabb_min", "aabb_max"))
        if not (np.abs((lower, upper)) < MAX_CORNER).all() or (lower > upper).any():
            raise InputError(
                f"{where}: expected aabb_min below aabb_max, both within {MAX_CORNER:g}, "
                f"got {lower.tolist()} and {upper.tolist()}"
            )
        if key in objects:
            raise InputError(f"{path}: id {key} belongs to several objects")
        objects[key] = SceneObject(id=key, name=name, aabb_min=lower, aabb_max=upper, placed=placed, **counts)
    return tuple(objects.values())


MAX_CORNER = 1e15
MAX_CAMERAS = 10_000
MAX_PIXELS = 1 << 24  # A blend of this many pixels takes gigabytes
INTRINSICS = ("fx", "fy", "cx", "cy", "width", "height")
NERFSTUDIO_NAMES = {"fl_x": "fx", "fl_y": "fy", "w": "width", "h": "height"}


def read_cameras(path: Path, origin: Float64[np.ndarray, "3"]) -> Cameras:
    """Reads the cameras of a JSON file; `origin` of the scene is taken off the poses in float64."""
    data = read_json(path, unique_keys=True)
    entries = data if isinstance(data, list) else [data]
    if not 1 <= len(entries) <= MAX_CAMERAS:
        raise InputError(f"{path}: expected a camera or a list of 1 to {MAX_CAMERAS:,} cameras, got {len(entries)}")
    poses, Ks, sizes = [], [], []
    for index, entry in enumerate(entries):
        where = f"{path}: camera {index}" if isinstance(data, list) else str(path)
        keys: dict[str, Any] = entry if isinstance(entry, dict) else {}
        values: dict[str, Any] = {NERFSTUDIO_NAMES.get(key, key): value for key, value in keys.items()}
        pose_key = "transform_matrix" if "transform_matrix" in values else "cam_from_world"
        if len(values) < len(keys) or set(values) != {pose_key, *INTRINSICS}:
            raise InputError(
                f"{where}: expected an object with cam_from_world or transform_matrix, and {', '.join(INTRINSICS)}, "
                f"got {listed([str(key)[:40] for key in keys]) or str(entry)[:40]}"
            )
        pose = pose_in(values, pose_key, where)
        if pose_key == "transform_matrix":
            pose = invert_rigid(pose @ OPENCV_FROM_OPENGL)
        row = {"camera": [values[key] for key in INTRINSICS]}
        fx, fy, cx, cy, width, height = numbers(row, "camera", where, (len(INTRINSICS),)).tolist()
        # Cameras are held in float32, in which 1e-50 is zero and 1e300 infinite.
        if not (1e-9 <= fx <= 1e9 and 1e-9 <= fy <= 1e9 and abs(cx) <= 1e9 and abs(cy) <= 1e9):
            raise InputError(
                f"{where}: expected focal lengths from 1e-9 and a principal point, within 1e9 pixels, "
                f"got fx {fx:g}, fy {fy:g}, cx {cx:g}, cy {cy:g}"
            )
        if not (width >= 1 and height >= 1 and width % 1 == height % 1 == 0 and width * height <= MAX_PIXELS):
            raise InputError(
                f"{where}: expected width and height as whole numbers, {MAX_PIXELS:,} pixels at most, "
                f"got {width:g}×{height:g}"
            )
        poses.append(move_origin(pose, origin))
        Ks.append(intrinsic_matrix(fx, fy, cx, cy))
        sizes.append((int(width), int(height)))
    widths, heights = np.array(sizes, np.int32).T.copy()
    return Cameras(
        cam_from_world=np.array(poses, np.float32), Ks=np.array(Ks, np.float32), widths=widths, heights=heights
    )
