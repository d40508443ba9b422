"""Recordings of RGB-D cameras. All poses are world_from_camera with OpenCV axes, in metres.

ScanNet-style exports: color/, depth/, pose/ and intrinsic/, one file a frame, matched by their stems; z up; frames that
lost tracking hold -inf. Depth is in millimetres by default. Where it has its own size and intrinsics it is
resampled onto the color camera; both are taken to look from the same place, as ScanNet's own exports do.

7-Scenes and 3DMatch: frame-NNNNNN.color.png (or .jpg), .depth.png and .pose.txt; up is written nowhere. Depth is in
millimetres, 0 and 65535 mean none. camera-intrinsics.txt, if there, holds K of the depth camera. In 7-Scenes (Shotton
et al. 2013) color and depth come from two lenses of a Kinect (f = 585) that are not registered, and poses are those of
the depth camera; sequences with other intrinsics are taken as registered, with one camera for both.

TUM RGB-D: rgb.txt, depth.txt and groundtruth.txt (`time tx ty tz qx qy qz qw`) list files and poses with times in
seconds; z up. Depth is registered to color, 5,000 steps a metre. A photograph gets the depth of the nearest time and a
pose interpolated between the two around it. Intrinsics are written nowhere; those of the benchmark's three Kinects
(Sturm et al. 2012) are known by the folder's name, freiburg1 to freiburg3. Others are given with data.intrinsics=.

Replica as NICE-SLAM exports it: results/frameNNNNNN.jpg, results/depthNNNNNN.png and traj.txt, whose line n is the pose
of frame n, 16 numbers; z up. cam_params.json in the folder or next to it holds the intrinsics and the depth steps of a
metre; without it they are those of that export.

ScanNet++ scenes: a dslr/ folder with nerfstudio/transforms.json and colmap/, and an iphone/ folder with a video.

The DSLR photographs of dslr/resized_images (fisheye, masks in resized_anon_masks) are read through its
transforms.json, else through its COLMAP model; iphone/ is used where dslr/ has no photographs, or where it is given
itself. The world is that of the laser scan: metres, z up. The COLMAP models and the meshes are in it;
nerfstudio/transforms.json is not, since nerfstudio's convention exchanges x and y and turns z around. They are taken
back here.

iphone/ is published as streams: rgb.mkv (rgb.mp4 in older releases), rgb_mask.mkv and depth.bin. The data set's toolkit
(iphone/prepare_iphone_data.py) extracts them to rgb/frame_NNNNNN.jpg, rgb_masks/frame_NNNNNN.png and
depth/frame_NNNNNN.png, counted from 0; these are what is read here. Depth is in millimetres, in the photographs' field
of view at its own size (256 × 192). Poses are taken from colmap/ (every tenth frame, OPENCV cameras, points), else from
nerfstudio/transforms.json, else from pose_intrinsic_imu.json: `aligned_pose` there is world_from_camera with OpenCV
axes of ARKit's tracking, carried into the world of the scan, and `intrinsic` is K.
"""

import re
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.readers.colmap import is_colmap_model, read_colmap
from gsencoder.data.readers.images import PICTURE_SUFFIXES, files_by_stem, picture_size, pinhole_of
from gsencoder.data.readers.posed import (
    CameraModel,
    Frames,
    PosedImage,
    PosedImages,
    ReadOptions,
    inside,
    number,
    numbers,
    read_numbers,
    table_lines,
    warn_left_out,
)
from gsencoder.data.readers.transforms_json import read_json, read_transforms
from gsencoder.types.scene import invert_rigid

MILLIMETRES = 1e-3


def is_scannet_export(folder: Path) -> bool:
    return (folder / "color").is_dir() and (folder / "pose").is_dir()


def read_scannet(root: Path, options: ReadOptions = ReadOptions()) -> PosedImages:
    color = files_by_stem(root / "color", PICTURE_SUFFIXES)
    if not color:
        raise InputError(f"{root / 'color'}: no pictures (.jpg, .png); expected one a frame")
    depths = files_by_stem(root / "depth", (".png", ".npy"))
    instances = files_by_stem(root / "instance", (".png",)) or files_by_stem(root / "instance-filt", (".png",))
    color_file, depth_file = _intrinsic_files(root)
    frames = Frames(root, len(color), options)
    for stem, path in color.items():
        pose_file, depth = root / "pose" / f"{stem}.txt", depths.get(stem)
        if not pose_file.is_file():
            frames.skip("have no pose file", stem)
            continue
        frames.check_inside(f"frame {stem}", path, pose_file, depth, instances.get(stem))
        pose = frames.pose(read_numbers(pose_file, (4, 4)), stem, str(pose_file))
        if pose is None:
            continue
        camera, depth_camera = _scannet_camera(color_file, path), None
        if depth is not None and picture_size(depth) != (camera.width, camera.height):
            if depth_file == color_file:
                w, h = picture_size(depth)
                raise InputError(
                    f"{depth}: {w}×{h} pixels, {path} {camera.width}×{camera.height}; expected intrinsic_depth.txt"
                )
            depth_camera = _scannet_camera(depth_file, depth)
        frames.images.append(
            PosedImage(
                name=f"color/{path.name}",
                camera=camera,
                cam_from_world=pose,
                image=path,
                depth=depth,
                depth_camera=depth_camera,
                depth_scale=MILLIMETRES,
                instance=instances.get(stem),
            )
        )
    return frames.finish(depth=bool(depths))


def _intrinsic_files(root: Path) -> tuple[Path, Path]:
    """The files of the color and the depth camera; one file serves both where there is no other."""
    folder = root / "intrinsic"
    common = [home / name for home in (folder, root) for name in ("intrinsic.txt", "intrinsics.txt")]
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
KINECT_BASELINE = 0.025  # Metres from the infrared to the color lens of a Kinect, along the camera's x axis


def is_seven_scenes(folder: Path) -> bool:
    return any(folder.glob("frame-*.pose.txt")) and any(FRAME.fullmatch(path.name) for path in folder.glob("frame-*"))


def read_seven_scenes(root: Path, options: ReadOptions = ReadOptions()) -> PosedImages:
    matches = sorted((match[1], path) for path in root.iterdir() if (match := FRAME.fullmatch(path.name)))
    intrinsics_file = root / INTRINSICS_FILE
    K = read_numbers(intrinsics_file, (3, 3), (4, 4)) if intrinsics_file.is_file() else None
    frames = Frames(root, len(matches), options)
    for stem, color in matches:
        pose_file, depth = root / f"{stem}.pose.txt", root / f"{stem}.depth.png"
        if not pose_file.is_file():
            frames.skip("have no pose file", stem)
            continue
        frames.check_inside(stem, color, pose_file, depth)
        pose = frames.pose(read_numbers(pose_file, (4, 4)), stem, str(pose_file))
        if pose is None:
            continue
        if K is None and picture_size(color) != KINECT_SIZE:
            raise InputError(f"{root}: no {INTRINSICS_FILE} with K of the depth camera, and no pictures of a Kinect")
        focal = KINECT_DEPTH_FOCAL
        fx, fy, cx, cy = (focal, focal, 320.0, 240.0) if K is None else (K[0, 0], K[1, 1], K[0, 2], K[1, 2])
        camera = pinhole_of(fx, fy, cx, cy, color, str(intrinsics_file))
        depth_camera, depth_from_color = None, None
        if fx == KINECT_DEPTH_FOCAL and picture_size(color) == KINECT_SIZE:
            depth_camera, depth_from_color = camera, np.eye(4)
            depth_from_color[0, 3] = KINECT_BASELINE
            camera = pinhole_of(KINECT_COLOR_FOCAL, KINECT_COLOR_FOCAL, 320.0, 240.0, color, str(root))
            pose = invert_rigid(depth_from_color) @ pose
        frames.images.append(
            PosedImage(
                name=color.name,
                camera=camera,
                cam_from_world=pose,
                image=color,
                depth=depth if depth.is_file() else None,
                depth_camera=depth_camera,
                depth_from_color=depth_from_color,
                depth_scale=MILLIMETRES,
                no_depth=NO_DEPTH,
            )
        )
    return frames.finish(depth=True, up=False)


COLOR_FILE, DEPTH_FILE, POSE_FILE = "rgb.txt", "depth.txt", "groundtruth.txt"
MAX_APART = 0.02  # Largest difference in seconds of a photograph and its depth, as in the benchmark's own script
MAX_GAP = 0.1  # Poses further apart in seconds are not interpolated: tracking was lost between them
METRES_PER_STEP = 1 / 5000
KINECTS = {
    "1": (517.306408, 516.469215, 318.643040, 255.313989, 0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
    "2": (520.908620, 521.007327, 325.141442, 249.701764, 0.231222, -0.784899, -0.003257, -0.000105, 0.917205),
    "3": (535.4, 539.2, 320.1, 247.6, 0.0, 0.0, 0.0, 0.0, 0.0),
}
"""fx, fy, cx, cy, k1, k2, p1, p2, k3 of each, for pictures of 640×480."""


def is_tum(folder: Path) -> bool:
    return all((folder / name).is_file() for name in (COLOR_FILE, POSE_FILE))


def read_tum(root: Path, options: ReadOptions = ReadOptions()) -> PosedImages:
    colors = _listed_files(root / COLOR_FILE)
    depths = _listed_files(root / DEPTH_FILE) if (root / DEPTH_FILE).is_file() else []
    times, poses = read_trajectory(root / POSE_FILE)
    color_times = np.array([time for time, _ in colors])
    depth_of = nearest_within(color_times, np.array([time for time, _ in depths]), MAX_APART)
    frames = Frames(root, len(colors), options)
    for (time, name), depth_index in zip(colors, depth_of, strict=True):
        where = f"{root / COLOR_FILE}: {name[:120]!r}"
        picture = inside(root, name, where, allow_outside=options.allow_outside)
        pose, depth = interpolate_pose(time, times, poses), None
        if pose is None or not picture.is_file():
            frames.skip(f"have no pose within {MAX_GAP} s" if pose is None else "have no picture", name)
            continue
        if depth_index >= 0:
            depth = inside(root, depths[depth_index][1], where, allow_outside=options.allow_outside)
        frames.images.append(
            PosedImage(
                name=name,
                camera=_tum_camera(root, picture, options),
                cam_from_world=invert_rigid(pose),
                image=picture,
                depth=depth if depth is not None and depth.is_file() else None,
                depth_scale=METRES_PER_STEP,
            )
        )
    if not frames.images and (color_times[0] > times[-1] or color_times[-1] < times[0]):
        raise InputError(
            f"{root}: no view: {COLOR_FILE} has times from {color_times[0]:.3f} to {color_times[-1]:.3f} s and "
            f"{POSE_FILE} from {times[0]:.3f} to {times[-1]:.3f}"
        )
    return frames.finish(depth=bool(depths))


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
        raise InputError(f"{path}: the quaternion at time {rows[worst, 0]:.6f} has norm {norms[worst]:.4g}, expected 1")
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(rows[:, 4:]).as_matrix()
    poses[:, :3, 3] = rows[:, 1:4]
    return rows[:, 0], poses


def nearest_within(
    times: Float64[np.ndarray, " n"], others: Float64[np.ndarray, " m"], largest: float
) -> Int64[np.ndarray, " n"]:
    """For each time the index of the nearest of `others`, which are sorted; −1 where none is within `largest`."""
    if not len(others):
        return np.full(len(times), -1, np.int64)
    nearest = np.searchsorted((others[:-1] + others[1:]) / 2, times)
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


def _tum_camera(root: Path, picture: Path, options: ReadOptions) -> CameraModel:
    width, height = picture_size(picture)
    if options.intrinsics is not None:
        return CameraModel(model="PINHOLE", width=width, height=height, params=tuple(options.intrinsics))
    sequence = re.search(r"freiburg([123])", str(root.resolve()), re.IGNORECASE)
    if sequence is None or (width, height) != (640, 480):
        raise InputError(f"{root}: the intrinsics are written nowhere; give data.intrinsics=[fx,fy,cx,cy] in pixels")
    return CameraModel(model="FULL_OPENCV", width=640, height=480, params=(*KINECTS[sequence[1]], 0.0, 0.0, 0.0))


TRAJECTORY, PARAMETERS, PICTURES = "traj.txt", "cam_params.json", "results"
DEFAULT_PARAMETERS = {"fx": 600.0, "fy": 600.0, "cx": 599.5, "cy": 339.5, "scale": 6553.5}


def is_replica(folder: Path) -> bool:
    return (folder / TRAJECTORY).is_file() and (folder / PICTURES).is_dir()


def read_replica(root: Path, options: ReadOptions = ReadOptions()) -> PosedImages:
    pictures = files_by_stem(root / PICTURES, PICTURE_SUFFIXES)
    colors = {stem[5:]: path for stem, path in pictures.items() if stem.startswith("frame")}
    if not colors:
        raise InputError(f"{root / PICTURES}: no pictures frameNNNNNN.jpg")
    file = root / TRAJECTORY
    poses = read_numbers(file, (None, 16)).reshape(-1, 4, 4)
    if len(poses) != len(colors):
        raise InputError(f"{file}: {len(poses)} poses for {len(colors)} pictures in {PICTURES}; expected a line each")
    parameters = _parameters(root)
    frames = Frames(root, len(colors), options)
    for row, (key, color) in enumerate(colors.items()):
        depth = pictures.get(f"depth{key}")
        frames.check_inside(f"frame {key}", color, depth)
        pose = frames.pose(poses[row], color.name, f"{file}: line {row + 1}")
        if pose is None:
            continue
        fx, fy, cx, cy = (parameters[name] for name in ("fx", "fy", "cx", "cy"))
        frames.images.append(
            PosedImage(
                name=f"{PICTURES}/{color.name}",
                camera=pinhole_of(fx, fy, cx, cy, color, str(root / PARAMETERS)),
                cam_from_world=pose,
                image=color,
                depth=depth,
                depth_scale=1 / parameters["scale"],
            )
        )
    return frames.finish(depth=True)


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


FRAMES, DEPTHS, MASKS = "rgb", "depth", "rgb_masks"
VIDEOS = ("rgb.mkv", "rgb.mp4")
DEPTH_STREAM = "depth.bin"
ARKIT_POSES, TRANSFORMS_FILE = "pose_intrinsic_imu.json", "nerfstudio/transforms.json"

NERFSTUDIO_FROM_SCAN = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])
"""(x, y, z) of the scan is (y, x, -z) in transforms.json; the matrix is its own inverse."""


NERFSTUDIO = ("nerfstudio/transforms.json", "nerfstudio/transforms_undistorted.json")
DSLR_PICTURES = ("resized_images", "undistorted_images")
DSLR_MASKS = ("resized_anon_masks", "undistorted_anon_masks")


def _is_iphone(folder: Path) -> bool:
    """Whether a folder is an iphone/ folder, extracted or not."""
    has_poses = is_colmap_model(folder / "colmap") or any(
        (folder / name).is_file() for name in (TRANSFORMS_FILE, ARKIT_POSES)
    )
    streams = any((folder / name).is_file() for name in (*VIDEOS, DEPTH_STREAM))
    return has_poses and ((folder / FRAMES).is_dir() or streams or folder.name == "iphone")


def _is_dslr(folder: Path) -> bool:
    pictures = any((folder / name).is_dir() for name in DSLR_PICTURES)
    return pictures and (any((folder / name).is_file() for name in NERFSTUDIO) or is_colmap_model(folder / "colmap"))


def device_folder(folder: Path) -> Path | None:
    """The folder of one capture device: the given one, or dslr/ or else iphone/ in it; None where there is neither."""
    candidates = (folder, folder / "dslr", folder / "iphone")
    return next((each for each in candidates if _is_dslr(each) or _is_iphone(each)), None)


def is_scannetpp(folder: Path) -> bool:
    """Whether a folder is such a scene, or its dslr/ or iphone/ folder."""
    return device_folder(folder) is not None


def read_scannetpp(root: Path, options: ReadOptions = ReadOptions()) -> PosedImages:
    """Reads a scene, or its dslr/ or iphone/ folder; warns of a depth stream that is still to be extracted."""
    folder = device_folder(root)
    if folder is None:
        raise InputError(f"{root}: neither dslr/ nor iphone/ with poses of ScanNet++")
    posed = _read_dslr(folder, options) if _is_dslr(folder) else _read_iphone(folder, options)
    return replace(posed, metres_per_unit=1.0, up=np.array([0.0, 0.0, 1.0]))


def _read_dslr(folder: Path, options: ReadOptions) -> PosedImages:
    for transforms, pictures, masks in zip(NERFSTUDIO, DSLR_PICTURES, DSLR_MASKS, strict=True):
        if (folder / pictures).is_dir() and (folder / transforms).is_file():
            return _in_world_of_scan(
                read_transforms(folder / transforms, options, pictures=folder / pictures, masks=folder / masks)
            )
    return read_colmap(folder / "colmap", folder / DSLR_PICTURES[0], folder, options, masks=folder / DSLR_MASKS[0])


def _read_iphone(folder: Path, options: ReadOptions) -> PosedImages:
    pictures = folder / FRAMES
    if not pictures.is_dir():
        video = next((name for name in VIDEOS if (folder / name).is_file()), None)
        stream = video or f"{VIDEOS[0]}, which is not here either,"
        raise InputError(
            f"{folder}: the frames are still to be extracted from {stream} to {FRAMES}/ by the toolkit of ScanNet++ "
            f"(iphone/prepare_iphone_data.py) or by: mkdir {FRAMES}; ffmpeg -i {video or VIDEOS[0]} -start_number 0 "
            f"-q:v 1 {FRAMES}/frame_%06d.jpg"
        )
    if is_colmap_model(folder / "colmap"):
        # Names in the model of some releases begin with the name of a folder.
        posed = read_colmap(folder / "colmap", pictures, folder, options, base_names=True)
    elif (folder / TRANSFORMS_FILE).is_file():
        file, masks = folder / TRANSFORMS_FILE, folder / MASKS
        posed = _in_world_of_scan(read_transforms(file, options, pictures=pictures, masks=masks))
    else:
        posed = _read_arkit(folder, options)
    images = tuple(_with_files(image, folder, options) for image in posed.images)
    if (folder / DEPTHS).is_dir():
        without_depth = [image.name for image in images if image.depth is None]
        warn_left_out(without_depth, len(images), str(folder), "depth files", "those views have no depth")
    elif (folder / DEPTH_STREAM).is_file():
        warnings.warn(
            f"{folder}: {DEPTH_STREAM} is still to be extracted to {DEPTHS}/ by the toolkit of ScanNet++ "
            "(iphone/prepare_iphone_data.py); the views have no depth",
            SceneWarning,
            stacklevel=2,
        )
    return replace(posed, images=images)


def _in_world_of_scan(posed: PosedImages) -> PosedImages:
    """Views of a nerfstudio/transforms.json of ScanNet++, in the world of its scan."""
    images = tuple(replace(image, cam_from_world=image.cam_from_world @ NERFSTUDIO_FROM_SCAN) for image in posed.images)
    # Row vectors times R are Rᵀ times column vectors: the inverse of the exchange.
    return replace(posed, images=images, points=posed.points @ NERFSTUDIO_FROM_SCAN[:3, :3])


def _read_arkit(folder: Path, options: ReadOptions) -> PosedImages:
    """Frames with the poses of ARKit."""
    path = folder / ARKIT_POSES
    entries = read_json(path)
    if not isinstance(entries, dict) or not all(isinstance(entry, dict) for entry in entries.values()):
        raise InputError(f"{path}: expected an object of frames with aligned_pose and intrinsic")
    pictures = files_by_stem(folder / FRAMES, (".jpg", ".jpeg", ".png"))
    frames = Frames(folder, len(pictures), options)
    for stem, picture in pictures.items():
        where, entry = f"{path}: {stem[:120]}", entries.get(stem)
        frames.check_inside(stem, picture)
        if entry is None or entry.get("aligned_pose") is None:
            frames.skip(f"are not in {ARKIT_POSES}" if entry is None else "have no aligned_pose", picture.name)
            continue
        pose = frames.pose(numbers(entry, "aligned_pose", where, (4, 4)), picture.name, where)
        if pose is None:
            continue
        K = numbers(entry, "intrinsic", where, (3, 3))
        camera = pinhole_of(K[0, 0], K[1, 1], K[0, 2], K[1, 2], picture, where)
        frames.images.append(PosedImage(name=picture.name, camera=camera, cam_from_world=pose, image=picture))
    return frames.finish(depth=False, source=str(path))


def _with_files(image: PosedImage, folder: Path, options: ReadOptions) -> PosedImage:
    """A frame with its mask and depth, whose camera is the photograph's, scaled, without distortion."""
    mask, depth = (folder / name / f"{image.image.stem}.png" for name in (MASKS, DEPTHS))
    for file in (mask, depth):
        if file.is_file():
            relative, where = str(file.relative_to(folder)), f"{folder}: {image.name}"
            inside(folder, relative, where, allow_outside=options.allow_outside)
    if mask.is_file():
        image = replace(image, mask=mask)
    if not depth.is_file():
        return image
    width, height = picture_size(depth)
    x, y = width / image.camera.width, height / image.camera.height
    fx, fy, cx, cy = image.camera.pinhole_params()
    camera = CameraModel(model="PINHOLE", width=width, height=height, params=(fx * x, fy * y, cx * x, cy * y))
    return replace(image, depth=depth, depth_camera=camera, depth_scale=MILLIMETRES)
