"""TUM RGB-D sequences: rgb.txt, depth.txt and groundtruth.txt list files and poses with times in seconds.

groundtruth.txt holds `time tx ty tz qx qy qz qw`, world_from_camera with OpenCV axes in metres, z up. Depth is
registered to colour, 5,000 steps a metre. A photograph gets the depth image of the nearest time, and a pose that is
interpolated between the two around it.

Intrinsics are written nowhere; those of the three Kinects that made the benchmark (Sturm et al. 2012) are known by the
name of the folder, freiburg1 to freiburg3. Others are given with data.intrinsics=.
"""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from gsencoder.core.errors import InputError
from gsencoder.data.readers.frames import SkippedFrames
from gsencoder.data.readers.image_file import picture_size
from gsencoder.data.readers.posed import PosedImage, PosedImages, inside, warn_left_out
from gsencoder.data.readers.tables import read_numbers, table_lines
from gsencoder.data.readers.undistort import CameraModel
from gsencoder.types.checks import invert_rigid

COLOR_FILE, DEPTH_FILE, POSE_FILE = "rgb.txt", "depth.txt", "groundtruth.txt"
MAX_APART = 0.02
"""Largest difference in seconds between the times of a photograph and its depth, as the benchmark's own script has it.
"""
MAX_GAP = 0.1
"""Poses further apart in seconds are not interpolated: tracking was lost between them."""
METRES_PER_STEP = 1 / 5000
KINECTS = {
    "1": (517.306408, 516.469215, 318.643040, 255.313989, 0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
    "2": (520.908620, 521.007327, 325.141442, 249.701764, 0.231222, -0.784899, -0.003257, -0.000105, 0.917205),
    "3": (535.4, 539.2, 320.1, 247.6, 0.0, 0.0, 0.0, 0.0, 0.0),
}
"""fx, fy, cx, cy, k1, k2, p1, p2, k3 of each, for pictures of 640×480."""


def is_tum(folder: Path) -> bool:
    """Whether a folder holds such a sequence."""
    return all((folder / name).is_file() for name in (COLOR_FILE, POSE_FILE))


def read_tum(
    root: Path,
    *,
    allow_outside: bool = False,
    depth_scale: float | None = None,
    intrinsics: tuple[float, float, float, float] | None = None,
) -> PosedImages:
    """Reads a sequence.

    Args:
        root: the folder with the three lists.
        allow_outside: let paths in them lead out of it.
        depth_scale: metres for each step of a depth file; None = 1/5000.
        intrinsics: fx, fy, cx, cy in pixels of the photographs; None = those of the benchmark's camera.

    Raises:
        InputError: no frame, times that do not match, intrinsics that nobody knows, or lists that cannot be read.
    """
    colors = _listed_files(root / COLOR_FILE)
    depths = _listed_files(root / DEPTH_FILE) if (root / DEPTH_FILE).is_file() else []
    times, poses = read_trajectory(root / POSE_FILE)
    color_times = np.array([time for time, _ in colors])
    depth_of = nearest_within(color_times, np.array([time for time, _ in depths]), MAX_APART)
    skipped = SkippedFrames(str(root), len(colors))
    images: list[PosedImage] = []
    without_depth: list[str] = []
    for (time, name), depth_index in zip(colors, depth_of, strict=True):
        where = f"{root / COLOR_FILE}: {name[:120]!r}"
        picture = inside(root, name, where, allow_outside=allow_outside)
        pose = interpolate_pose(time, times, poses)
        if pose is None:
            skipped.add(f"have no pose within {MAX_GAP} s", name)
            continue
        if not picture.is_file():
            skipped.add("have no picture", name)
            continue
        depth = None
        if depth_index >= 0:
            depth = inside(root, depths[depth_index][1], where, allow_outside=allow_outside)
        if depth is None or not depth.is_file():
            depth = None
            without_depth.append(name)
        images.append(
            PosedImage(
                name=name,
                camera=_camera(root, picture, intrinsics),
                cam_from_world=invert_rigid(pose),
                image=picture,
                depth=depth,
                depth_scale=depth_scale or METRES_PER_STEP,
            )
        )
    if not images:
        raise InputError(
            f"{root}: no view: of {len(colors)} photographs {skipped.describe()}; {COLOR_FILE} has times from "
            f"{color_times.min():.3f} to {color_times.max():.3f} s and {POSE_FILE} from {times[0]:.3f} to "
            f"{times[-1]:.3f}"
        )
    skipped.warn()
    if depths:
        warn_left_out(without_depth, len(images), str(root), "depth files", "those views have no depth")
    return PosedImages(source=str(root), images=tuple(images), metres_per_unit=1.0, up=np.array([0.0, 0.0, 1.0]))


def _listed_files(path: Path) -> list[tuple[float, str]]:
    """Times and names of a list, sorted by time."""
    files = []
    for number, words in enumerate(table_lines(path)):
        try:
            time = float(words[0])
        except ValueError:
            time = float("nan")
        if len(words) < 2 or not np.isfinite(time):
            raise InputError(f"{path}: row {number + 1} is not a time and a file: {' '.join(words)[:80]!r}")
        files.append((time, words[1]))
    if not files:
        raise InputError(f"{path}: lists no file")
    return sorted(files)


def read_trajectory(path: Path) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, "n 4 4"]]:
    """Times and world_from_camera of `time tx ty tz qx qy qz qw` lines, sorted; poses that are not finite are left out.

    Raises:
        InputError: unreadable, no finite pose, or a quaternion that is no rotation.
    """
    from scipy.spatial.transform import Rotation

    rows = read_numbers(path, (None, 8))
    rows = rows[np.isfinite(rows).all(axis=1)]
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    if not len(rows):
        raise InputError(f"{path}: no finite pose")
    norms = np.linalg.norm(rows[:, 4:], axis=1)
    if np.abs(norms - 1).max() > 0.01:
        worst = int(np.abs(norms - 1).argmax())
        raise InputError(
            f"{path}: the quaternion at time {rows[worst, 0]:.6f} has norm {norms[worst]:.4g}, expected 1 "
            "(time tx ty tz qx qy qz qw)"
        )
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(rows[:, 4:]).as_matrix()
    poses[:, :3, 3] = rows[:, 1:4]
    return rows[:, 0], poses


def nearest_within(
    times: Float64[np.ndarray, " n"], others: Float64[np.ndarray, " m"], largest: float
) -> Int64[np.ndarray, " n"]:
    """For each time the index of the nearest of `others`, which are sorted; −1 where it is further away than
    `largest`."""
    if not len(others):
        return np.full(len(times), -1, np.int64)
    right = np.searchsorted(others, times).clip(1, len(others) - 1) if len(others) > 1 else np.zeros(len(times), int)
    left = np.maximum(right - 1, 0)
    nearest = np.where(np.abs(times - others[left]) <= np.abs(others[right] - times), left, right)
    return np.where(np.abs(times - others[nearest]) <= largest, nearest, -1)


def interpolate_pose(
    time: float, times: Float64[np.ndarray, " n"], poses: Float64[np.ndarray, "n 4 4"]
) -> Float64[np.ndarray, "4 4"] | None:
    """The pose at a time, positions linearly and rotations by slerp between the two around it.

    None where these are more than `MAX_GAP` apart, and beyond the ends by more than `MAX_APART`.
    """
    from scipy.spatial.transform import Rotation, Slerp

    right = int(np.searchsorted(times, time))
    if right < len(times) and times[right] == time:
        return poses[right]
    if right in (0, len(times)):
        end = poses[min(right, len(times) - 1)]
        return end if abs(times[min(right, len(times) - 1)] - time) <= MAX_APART else None
    before, after = times[right - 1], times[right]
    if after - before > MAX_GAP:
        return None
    share = (time - before) / (after - before)
    pose = np.eye(4)
    turn = Slerp([0.0, 1.0], Rotation.from_matrix(poses[right - 1 : right + 1, :3, :3]))
    pose[:3, :3] = turn(share).as_matrix()
    pose[:3, 3] = (1 - share) * poses[right - 1, :3, 3] + share * poses[right, :3, 3]
    return pose


def _camera(root: Path, picture: Path, intrinsics: Sequence[float] | None) -> CameraModel:
    width, height = picture_size(picture)
    if intrinsics is not None:
        return CameraModel(model="PINHOLE", width=width, height=height, params=tuple(intrinsics))
    sequence = re.search(r"freiburg([123])", str(root.resolve()), re.IGNORECASE)
    if sequence is None or (width, height) != (640, 480):
        raise InputError(
            f"{root}: the sequence does not say its intrinsics; give data.intrinsics=[fx,fy,cx,cy] in pixels"
        )
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = KINECTS[sequence[1]]
    return CameraModel(
        model="FULL_OPENCV", width=640, height=480, params=(fx, fy, cx, cy, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)
    )
