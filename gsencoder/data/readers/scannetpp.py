"""ScanNet++ scenes: a dslr/ folder with nerfstudio/transforms.json and colmap/, and an iphone/ folder with colmap/.

The DSLR photographs of dslr/resized_images (fisheye, masks in resized_anon_masks) are read through its
transforms.json, else through its COLMAP model. iphone/ needs its frames extracted to rgb/ (frame_NNNNNN.jpg); depth/
is read if it is there, in millimetres at its own size. The world is that of the laser scan: metres, z up.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from gsencoder.core.errors import InputError
from gsencoder.data.readers.colmap import is_colmap_model, read_colmap
from gsencoder.data.readers.images import picture_size
from gsencoder.data.readers.posed import PosedImage, PosedImages, inside
from gsencoder.data.readers.transforms_json import read_transforms
from gsencoder.data.readers.undistort import CameraModel

NERFSTUDIO = ("nerfstudio/transforms.json", "nerfstudio/transforms_undistorted.json")
DSLR_PICTURES = ("resized_images", "undistorted_images")
DSLR_MASKS = ("resized_anon_masks", "undistorted_anon_masks")
MILLIMETRES = 1e-3


def device_folder(folder: Path) -> Path | None:
    """The folder of one capture device: the given one, or dslr/ or else iphone/ in it; None where there is neither."""
    for candidate in (folder, folder / "dslr", folder / "iphone"):
        if _is_dslr(candidate) or _is_iphone(candidate):
            return candidate
    return None


def is_scannetpp(folder: Path) -> bool:
    """Whether a folder is such a scene, or its dslr/ or iphone/ folder."""
    return device_folder(folder) is not None


def _is_dslr(folder: Path) -> bool:
    pictures = any((folder / name).is_dir() for name in DSLR_PICTURES)
    return pictures and (any((folder / name).is_file() for name in NERFSTUDIO) or is_colmap_model(folder / "colmap"))


def _is_iphone(folder: Path) -> bool:
    return (folder / "rgb").is_dir() and is_colmap_model(folder / "colmap")


def read_scannetpp(root: Path, *, allow_outside: bool = False, depth_scale: float | None = None) -> PosedImages:
    """Reads a scene.

    Args:
        root: of the scene, or its dslr/ or iphone/ folder.
        allow_outside: let links in it lead out of it.
        depth_scale: metres for each step of a depth file; None = 0.001.

    Raises:
        InputError: as `read_transforms` and `read_colmap`.
    """
    folder = device_folder(root)
    if folder is None:
        raise InputError(f"{root}: neither dslr/ nor iphone/ with poses of ScanNet++")
    if _is_dslr(folder):
        posed = _read_dslr(folder, allow_outside=allow_outside)
    else:
        posed = read_colmap(folder / "colmap", folder / "rgb", folder, allow_outside=allow_outside)
        scale = depth_scale or MILLIMETRES
        images = tuple(_with_depth(image, folder, scale, allow_outside=allow_outside) for image in posed.images)
        posed = replace(posed, images=images)
    return replace(posed, metres_per_unit=1.0, up=np.array([0.0, 0.0, 1.0]))


def _read_dslr(folder: Path, *, allow_outside: bool) -> PosedImages:
    for index, pictures in enumerate(DSLR_PICTURES):
        transforms = folder / NERFSTUDIO[index]
        if (folder / pictures).is_dir() and transforms.is_file():
            masks = folder / DSLR_MASKS[index]
            return read_transforms(
                transforms,
                allow_outside=allow_outside,
                pictures=folder / pictures,
                masks=masks if masks.is_dir() else None,
            )
    return read_colmap(folder / "colmap", folder / DSLR_PICTURES[0], folder, allow_outside=allow_outside)


def _with_depth(image: PosedImage, folder: Path, scale: float, *, allow_outside: bool) -> PosedImage:
    """The depth of a frame, at its own size: the camera is that of the photograph, scaled and without distortion."""
    depth = folder / "depth" / f"{image.image.stem}.png"
    if not depth.is_file():
        return image
    inside(folder, str(depth.relative_to(folder)), f"{folder}: {image.name}", allow_outside=allow_outside)
    width, height = picture_size(depth)
    x, y = width / image.camera.width, height / image.camera.height
    fx, fy, cx, cy = image.camera.pinhole_params()
    camera = CameraModel(model="PINHOLE", width=width, height=height, params=(fx * x, fy * y, cx * x, cy * y))
    return replace(image, depth=depth, depth_camera=camera, depth_scale=scale)
