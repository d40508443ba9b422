"""Recordings of RGB-D cameras: ScanNet's exports, 7-Scenes, TUM and Replica.

ScanNet-style exports: color/, depth/, pose/ and intrinsic/, one file a frame, matched by their stems.

pose/N.txt is world_from_camera with OpenCV axes, metres, z up; frames that lost tracking hold -inf and are left out.
Depth is in millimetres unless told otherwise. Where depth has its own size and intrinsics it is resampled onto the
color camera; both are taken to look from the same place, as ScanNet's own exports do.

Sequences of frame-NNNNNN.color.png (or .jpg), .depth.png and .pose.txt, as 7-Scenes and 3DMatch have them.

pose.txt is world_from_camera with OpenCV axes, metres; up is written nowhere. Depth is in millimetres, 0 and 65535 mean
none. camera-intrinsics.txt, if there, holds K of the depth camera.

In 7-Scenes (Shotton et al. 2013) colour and depth come from two lenses of a Kinect that are not registered, and poses
are those of the depth camera. Its depth camera has f = 585; sequences with other intrinsics are taken as registered,
with one camera for both.

TUM RGB-D sequences: rgb.txt, depth.txt and groundtruth.txt list files and poses with times in seconds.

groundtruth.txt holds `time tx ty tz qx qy qz qw`, world_from_camera with OpenCV axes in metres, z up. Depth is
registered to colour, 5,000 steps a metre. A photograph gets the depth image of the nearest time, and a pose that is
interpolated between the two around it.

Intrinsics are written nowhere; those of the three Kinects that made the benchmark (Sturm et al. 2012) are known by the
name of the folder, freiburg1 to freiburg3. Others are given with data.intrinsics=.

Replica as NICE-SLAM exports it: results/frameNNNNNN.jpg, results/depthNNNNNN.png and traj.txt.

Line n of traj.txt is world_from_camera of frame n, 16 numbers with OpenCV axes in metres, z up. cam_params.json in the
folder or beside it holds the intrinsics and the depth steps of a metre; without it they are those of that export.
"""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from gsencoder.core.errors import InputError
from gsencoder.data.readers.images import (
    PICTURE_SUFFIXES,
    SkippedFrames,
    files_by_stem,
    is_lost,
    picture_size,
    pinhole_of,
)
from gsencoder.data.readers.label_images import read_numbers, table_lines
from gsencoder.data.readers.posed import PosedImage, PosedImages, inside, number, rigid_pose, warn_left_out
from gsencoder.data.readers.transforms_json import read_json
from gsencoder.data.readers.undistort import CameraModel
from gsencoder.types.checks import invert_rigid

MILLIMETRES = 1e-3


def is_scannet_export(folder: Path) -> bool:
    """True where the two folders that every such export has are there."""
    return (folder / "color").is_dir() and (folder / "pose").is_dir()


def read_scannet(root: Path, *, allow_outside: bool = False, depth_scale: float | None = None) -> PosedImages:
    """Reads an export.

    Args:
        root: the folder that holds color/ and pose/, and depth/ and intrinsic/.
        allow_outside: let links in it lead out of it.
        depth_scale: metres for each step of a depth file; None = 0.001.
    """
    color = files_by_stem(root / "color", PICTURE_SUFFIXES)
    if not color:
        raise InputError(f"{root / 'color'}: no pictures (.jpg, .png); expected one a frame")
    depths = files_by_stem(root / "depth", (".png", ".npy"))
    instances = files_by_stem(root / "instance", (".png",)) or files_by_stem(root / "instance-filt", (".png",))
    color_file, depth_file = _intrinsic_files(root)
    images: list[PosedImage] = []
    skipped = SkippedFrames(str(root), len(color))
    for stem, path in color.items():
        pose_file = root / "pose" / f"{stem}.txt"
        if not pose_file.is_file():
            skipped.add("have no pose file", stem)
            continue
        for file in (path, pose_file, depths.get(stem), instances.get(stem)):
            if file is not None:
                inside(root, str(file.relative_to(root)), f"{root}: frame {stem}", allow_outside=allow_outside)
        pose = read_numbers(pose_file, (4, 4))
        if is_lost(pose):
            skipped.add("lost tracking", stem)
            continue
        camera = _scannet_camera(color_file, path)
        depth = depths.get(stem)
        depth_camera = None
        if depth is not None and picture_size(depth) != (camera.width, camera.height):
            if depth_file == color_file:
                w, h = picture_size(depth)
                raise InputError(
                    f"{depth}: {w}×{h} pixels but {path} has {camera.width}×{camera.height}; "
                    "expected the same size, or intrinsic/intrinsic_depth.txt"
                )
            depth_camera = _scannet_camera(depth_file, depth)
        images.append(
            PosedImage(
                name=f"color/{path.name}",
                camera=camera,
                cam_from_world=invert_rigid(rigid_pose(pose, str(pose_file))),
                image=path,
                depth=depth,
                depth_camera=depth_camera,
                depth_scale=depth_scale or MILLIMETRES,
                instance=instances.get(stem),
            )
        )
    if not images:
        raise InputError(f"{root}: no view: of {len(color)} pictures {skipped.describe()}")
    skipped.warn()
    if depths:
        without = [image.name for image in images if image.depth is None]
        warn_left_out(without, len(images), str(root), "depth files", "those views have no depth")
    return PosedImages(source=str(root), images=tuple(images), metres_per_unit=1.0, up=np.array([0.0, 0.0, 1.0]))


def _intrinsic_files(root: Path) -> tuple[Path, Path]:
    """The files of the color and the depth camera; one file serves both where there is no other."""
    folder = root / "intrinsic"
    common = [folder / "intrinsic.txt", folder / "intrinsics.txt", root / "intrinsics.txt", root / "intrinsic.txt"]
    color = next((path for path in (folder / "intrinsic_color.txt", *common) if path.is_file()), None)
    depth = next((path for path in (folder / "intrinsic_depth.txt", *common) if path.is_file()), None)
    color, depth = color or depth, depth or color
    if color is None or depth is None:
        raise InputError(f"{root}: no intrinsics; expected {folder / 'intrinsic_color.txt'} with a 3×3 or 4×4 matrix")
    return color, depth


def _scannet_camera(path: Path, picture: Path) -> CameraModel:
    k = read_numbers(path, (3, 3), (4, 4))
    camera = pinhole_of(k[0, 0], k[1, 1], k[0, 2], k[1, 2], picture, str(path))
    if k[0, 1] or k[1, 0] or abs(k[2, :3] - (0, 0, 1)).max() > 1e-6:
        raise InputError(f"{path}: expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], got {k[:3, :3].tolist()}")
    return camera


FRAME = re.compile(r"(frame-\d+)\.color\.(png|jpg|jpeg)", re.IGNORECASE)
INTRINSICS_FILE = "camera-intrinsics.txt"
NO_DEPTH = 65535

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
        allow_outside: let links in it lead out of it.
        depth_scale: metres for each step of a depth file; None = 0.001.
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
        allow_outside: let paths in them lead out of it.
        depth_scale: metres for each step of a depth file; None = 1/5000.
        intrinsics: fx, fy, cx, cy in pixels of the photographs; None = those of the benchmark's camera.
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
                camera=_tum_camera(root, picture, intrinsics),
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
    for row, words in enumerate(table_lines(path)):
        try:
            time = float(words[0])
        except ValueError:
            time = float("nan")
        if len(words) < 2 or not np.isfinite(time):
            raise InputError(f"{path}: row {row + 1} is not a time and a file: {' '.join(words)[:80]!r}")
        files.append((time, words[1]))
    if not files:
        raise InputError(f"{path}: lists no file")
    return sorted(files)


def read_trajectory(path: Path) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, "n 4 4"]]:
    """Times and world_from_camera of `time tx ty tz qx qy qz qw` lines, sorted, without poses that are not finite."""
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


def _tum_camera(root: Path, picture: Path, intrinsics: Sequence[float] | None) -> CameraModel:
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


TRAJECTORY, PARAMETERS, PICTURES = "traj.txt", "cam_params.json", "results"
DEFAULT_PARAMETERS = {"fx": 600.0, "fy": 600.0, "cx": 599.5, "cy": 339.5, "scale": 6553.5}


def is_replica(folder: Path) -> bool:
    """Whether a folder holds such an export."""
    return (folder / TRAJECTORY).is_file() and (folder / PICTURES).is_dir()


def read_replica(root: Path, *, allow_outside: bool = False, depth_scale: float | None = None) -> PosedImages:
    """Reads an export.

    Args:
        allow_outside: let links in it lead out of it.
        depth_scale: metres for each step of a depth file; None = that of cam_params.json.
    """
    pictures = files_by_stem(root / PICTURES, PICTURE_SUFFIXES)
    colors = {stem[5:]: path for stem, path in pictures.items() if stem.startswith("frame")}
    depths = {stem[5:]: path for stem, path in pictures.items() if stem.startswith("depth")}
    if not colors:
        raise InputError(f"{root / PICTURES}: no pictures frameNNNNNN.jpg")
    poses = read_numbers(root / TRAJECTORY, (None, 16)).reshape(-1, 4, 4)
    if len(poses) != len(colors):
        raise InputError(
            f"{root / TRAJECTORY}: {len(poses)} poses for {len(colors)} pictures in {PICTURES}; expected one line a "
            "picture"
        )
    parameters = _parameters(root)
    skipped = SkippedFrames(str(root), len(colors))
    images: list[PosedImage] = []
    without_depth: list[str] = []
    for row, (key, color) in enumerate(colors.items()):
        for file in (color, depths.get(key)):
            if file is not None:
                inside(root, str(file.relative_to(root)), f"{root}: frame {key}", allow_outside=allow_outside)
        if is_lost(poses[row]):
            skipped.add("lost tracking", color.name)
            continue
        if key not in depths:
            without_depth.append(color.name)
        fx, fy, cx, cy = (parameters[name] for name in ("fx", "fy", "cx", "cy"))
        camera = pinhole_of(fx, fy, cx, cy, color, str(root / PARAMETERS))
        images.append(
            PosedImage(
                name=f"{PICTURES}/{color.name}",
                camera=camera,
                cam_from_world=invert_rigid(rigid_pose(poses[row], f"{root / TRAJECTORY}: line {row + 1}")),
                image=color,
                depth=depths.get(key),
                depth_scale=depth_scale or 1 / parameters["scale"],
            )
        )
    if not images:
        raise InputError(f"{root}: no view: of {len(colors)} pictures {skipped.describe()}")
    skipped.warn()
    warn_left_out(without_depth, len(colors), str(root), "depth files", "those views have no depth")
    return PosedImages(source=str(root), images=tuple(images), metres_per_unit=1.0, up=np.array([0.0, 0.0, 1.0]))


def _parameters(root: Path) -> dict[str, float]:
    """fx, fy, cx, cy and the depth steps of a metre."""
    path = next((folder / PARAMETERS for folder in (root, root.parent) if (folder / PARAMETERS).is_file()), None)
    if path is None:
        return DEFAULT_PARAMETERS
    data = read_json(path)
    camera = data.get("camera") if isinstance(data, dict) else None
    if not isinstance(camera, dict):
        raise InputError(f"{path}: expected an object with camera: fx, fy, cx, cy, scale")
    values = {name: number(camera, name, str(path)) for name in DEFAULT_PARAMETERS}
    missing = [name for name, value in values.items() if value is None]
    if missing or (values["scale"] or 0) <= 0:
        raise InputError(f"{path}: camera: expected numbers for {', '.join(missing) or 'scale above 0'}")
    return {name: float(value) for name, value in values.items() if value is not None}
