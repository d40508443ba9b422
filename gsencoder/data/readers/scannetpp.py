"""ScanNet++ scenes: a dslr/ folder with nerfstudio/transforms.json and colmap/, and an iphone/ folder with a video.

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

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.readers.colmap import is_colmap_model, read_colmap
from gsencoder.data.readers.images import files_by_stem, picture_size, pinhole_of
from gsencoder.data.readers.posed import Frames, PosedImage, PosedImages, ReadOptions, inside, numbers, warn_left_out
from gsencoder.data.readers.transforms_json import read_json, read_transforms
from gsencoder.data.readers.undistort import CameraModel

PICTURES, DEPTHS, MASKS = "rgb", "depth", "rgb_masks"
VIDEOS = ("rgb.mkv", "rgb.mp4")
DEPTH_STREAM = "depth.bin"
ARKIT_POSES, TRANSFORMS_FILE = "pose_intrinsic_imu.json", "nerfstudio/transforms.json"
MILLIMETRES = 1e-3
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
    return has_poses and ((folder / PICTURES).is_dir() or streams or folder.name == "iphone")


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
    pictures = folder / PICTURES
    if not pictures.is_dir():
        video = next((name for name in VIDEOS if (folder / name).is_file()), None)
        stream = video or f"{VIDEOS[0]}, which is not here either,"
        raise InputError(
            f"{folder}: the frames are still to be extracted from {stream} to {PICTURES}/ by the toolkit of ScanNet++ "
            f"(iphone/prepare_iphone_data.py) or by: mkdir {PICTURES}; ffmpeg -i {video or VIDEOS[0]} -start_number 0 "
            f"-q:v 1 {PICTURES}/frame_%06d.jpg"
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
    pictures = files_by_stem(folder / PICTURES, (".jpg", ".jpeg", ".png"))
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
