"""Sequences of frame-NNNNNN.color.png (or .jpg), .depth.png and .pose.txt, as 7-Scenes and 3DMatch have them.

pose.txt is world_from_camera with OpenCV axes, metres; up is written nowhere. Depth is in millimetres, 0 and 65535 mean
none. camera-intrinsics.txt, if there, holds K of the depth camera.

In 7-Scenes (Shotton et al. 2013) colour and depth come from two lenses of a Kinect that are not registered, and poses
are those of the depth camera. Its depth camera has f = 585; sequences with other intrinsics are taken as registered,
with one camera for both.
"""

import re
from pathlib import Path

import numpy as np

from gsencoder.core.errors import InputError
from gsencoder.data.readers.frames import SkippedFrames, is_lost, pinhole_of
from gsencoder.data.readers.image_file import picture_size
from gsencoder.data.readers.posed import PosedImage, PosedImages, inside, rigid_pose, warn_left_out
from gsencoder.data.readers.tables import read_numbers
from gsencoder.types.checks import invert_rigid

FRAME = re.compile(r"(frame-\d+)\.color\.(png|jpg|jpeg)", re.IGNORECASE)
INTRINSICS_FILE = "camera-intrinsics.txt"
NO_DEPTH = 65535
MILLIMETRES = 1e-3
KINECT_DEPTH_FOCAL = 585.0
KINECT_COLOR_FOCAL = 525.0
KINECT_SIZE = (640, 480)
KINECT_BASELINE = 0.025
"""Metres from the infrared to the color lens of a Kinect, along the camera's x axis."""


def is_seven_scenes(folder: Path) -> bool:
    """Whether a folder holds frames of this kind, with poses."""
    return any(folder.glob("frame-*.pose.txt")) and any(FRAME.fullmatch(path.name) for path in folder.glob("frame-*"))


def read_seven_scenes(root: Path, *, allow_outside: bool = False, depth_scale: float | None = None) -> PosedImages:
    """Reads a sequence.

    Args:
        root: the folder with the frames.
        allow_outside: let links in it lead out of it.
        depth_scale: metres for each step of a depth file; None = 0.001.

    Raises:
        InputError: no usable frame, or intrinsics or a pose that cannot be.
    """
    matches = sorted((match, path) for path in root.iterdir() if (match := _frame_of(path)))
    skipped = SkippedFrames(str(root), len(matches))
    intrinsics_file = root / INTRINSICS_FILE
    K = read_numbers(intrinsics_file, (3, 3), (4, 4))[:3, :3] if intrinsics_file.is_file() else None
    images: list[PosedImage] = []
    without_depth: list[str] = []
    for stem, color in matches:
        pose_file, depth = root / f"{stem}.pose.txt", root / f"{stem}.depth.png"
        for file in (color, pose_file, depth):
            inside(root, file.name, f"{root}: {stem}", allow_outside=allow_outside)
        if not pose_file.is_file():
            skipped.add("have no pose file", stem)
            continue
        matrix = read_numbers(pose_file, (4, 4))
        if is_lost(matrix):
            skipped.add("lost tracking", stem)
            continue
        if not depth.is_file():
            without_depth.append(stem)
        if K is None and picture_size(color) != KINECT_SIZE:
            raise InputError(
                f"{root}: no {INTRINSICS_FILE} with K of the depth camera, and the pictures are no Kinect's"
            )
        depth_K = np.array([[KINECT_DEPTH_FOCAL, 0, 320], [0, KINECT_DEPTH_FOCAL, 240], [0, 0, 1]]) if K is None else K
        camera = pinhole_of(depth_K[0, 0], depth_K[1, 1], depth_K[0, 2], depth_K[1, 2], color, str(intrinsics_file))
        pose = invert_rigid(rigid_pose(matrix, str(pose_file)))
        depth_camera, depth_from_color = None, None
        if depth_K[0, 0] == KINECT_DEPTH_FOCAL and picture_size(color) == KINECT_SIZE:
            depth_camera, depth_from_color = camera, np.eye(4)
            depth_from_color[0, 3] = KINECT_BASELINE
            camera = pinhole_of(KINECT_COLOR_FOCAL, KINECT_COLOR_FOCAL, 320.0, 240.0, color, str(root))
            pose = invert_rigid(depth_from_color) @ pose
        images.append(
            PosedImage(
                name=color.name,
                camera=camera,
                cam_from_world=pose,
                image=color,
                depth=depth if depth.is_file() else None,
                depth_camera=depth_camera,
                depth_from_color=depth_from_color,
                depth_scale=depth_scale or MILLIMETRES,
                no_depth=NO_DEPTH,
            )
        )
    if not images:
        raise InputError(f"{root}: no view: of {len(matches)} frames {skipped.describe()}")
    skipped.warn()
    warn_left_out(without_depth, len(matches), str(root), "depth files", "those views have no depth")
    return PosedImages(source=str(root), images=tuple(images), metres_per_unit=1.0)


def _frame_of(path: Path) -> str | None:
    match = FRAME.fullmatch(path.name)
    return match[1] if match else None
