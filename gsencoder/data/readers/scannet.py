"""ScanNet-style exports: color/, depth/, pose/ and intrinsic/, one file a frame, matched by their stems.

pose/N.txt is world_from_camera with OpenCV axes, metres, z up; frames that lost tracking hold -inf and are left out.
Depth is in millimetres unless told otherwise. Where depth has its own size and intrinsics it is resampled onto the
color camera; both are taken to look from the same place, as ScanNet's own exports do.
"""

from pathlib import Path

import numpy as np

from gsencoder.core.errors import InputError
from gsencoder.data.readers.frames import PICTURE_SUFFIXES, SkippedFrames, files_by_stem, is_lost, pinhole_of
from gsencoder.data.readers.image_file import picture_size
from gsencoder.data.readers.posed import PosedImage, PosedImages, inside, rigid_pose, warn_left_out
from gsencoder.data.readers.tables import read_numbers
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

    Raises:
        InputError: no usable frame, no intrinsics, intrinsics that do not belong to the pictures, a bad pose.
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
        camera = _camera(color_file, path)
        depth = depths.get(stem)
        depth_camera = None
        if depth is not None and picture_size(depth) != (camera.width, camera.height):
            if depth_file == color_file:
                w, h = picture_size(depth)
                raise InputError(
                    f"{depth}: {w}×{h} pixels but {path} has {camera.width}×{camera.height}; "
                    "expected the same size, or intrinsic/intrinsic_depth.txt"
                )
            depth_camera = _camera(depth_file, depth)
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


def _camera(path: Path, picture: Path) -> CameraModel:
    k = read_numbers(path, (3, 3), (4, 4))
    camera = pinhole_of(k[0, 0], k[1, 1], k[0, 2], k[1, 2], picture, str(path))
    if k[0, 1] or k[1, 0] or abs(k[2, :3] - (0, 0, 1)).max() > 1e-6:
        raise InputError(f"{path}: expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], got {k[:3, :3].tolist()}")
    return camera
