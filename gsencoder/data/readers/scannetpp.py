"""ScanNet++ scenes: a dslr/ folder with nerfstudio/transforms.json and colmap/, and an iphone/ folder with a video.

The DSLR photographs of dslr/resized_images (fisheye, masks in resized_anon_masks) are read through its
transforms.json, else through its COLMAP model; iphone.py reads the other folder, which is used where dslr/ has no
photographs, or where it is given itself. The world is that of the laser scan: metres, z up. The COLMAP models and
the meshes are in it; nerfstudio/transforms.json is not, since its poses went through nerfstudio's convention, which
exchanges x and y and turns z around. They are taken back here.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from gsencoder.core.errors import InputError
from gsencoder.data.readers.colmap import is_colmap_model, read_colmap
from gsencoder.data.readers.iphone import in_world_of_scan, is_iphone, read_iphone
from gsencoder.data.readers.posed import PosedImages
from gsencoder.data.readers.transforms_json import read_transforms

NERFSTUDIO = ("nerfstudio/transforms.json", "nerfstudio/transforms_undistorted.json")
DSLR_PICTURES = ("resized_images", "undistorted_images")
DSLR_MASKS = ("resized_anon_masks", "undistorted_anon_masks")


def device_folder(folder: Path) -> Path | None:
    """The folder of one capture device: the given one, or dslr/ or else iphone/ in it; None where there is neither."""
    for candidate in (folder, folder / "dslr", folder / "iphone"):
        if _is_dslr(candidate) or is_iphone(candidate):
            return candidate
    return None


def is_scannetpp(folder: Path) -> bool:
    """Whether a folder is such a scene, or its dslr/ or iphone/ folder."""
    return device_folder(folder) is not None


def _is_dslr(folder: Path) -> bool:
    pictures = any((folder / name).is_dir() for name in DSLR_PICTURES)
    return pictures and (any((folder / name).is_file() for name in NERFSTUDIO) or is_colmap_model(folder / "colmap"))


def read_scannetpp(root: Path, *, allow_outside: bool = False, depth_scale: float | None = None) -> PosedImages:
    """Reads a scene.

    Args:
        root: of the scene, or its dslr/ or iphone/ folder.
        allow_outside: let links in it lead out of it.
        depth_scale: metres for each step of a depth file; None = 0.001.

    Raises:
        InputError: a video that is still to be extracted, and as `read_transforms` and `read_colmap`.

    Warns:
        SceneWarning: a depth stream that is still to be extracted.
    """
    folder = device_folder(root)
    if folder is None:
        raise InputError(f"{root}: neither dslr/ nor iphone/ with poses of ScanNet++")
    if _is_dslr(folder):
        posed = _read_dslr(folder, allow_outside=allow_outside)
    else:
        posed = read_iphone(folder, allow_outside=allow_outside, depth_scale=depth_scale)
    return replace(posed, metres_per_unit=1.0, up=np.array([0.0, 0.0, 1.0]))


def _read_dslr(folder: Path, *, allow_outside: bool) -> PosedImages:
    for index, pictures in enumerate(DSLR_PICTURES):
        transforms = folder / NERFSTUDIO[index]
        if (folder / pictures).is_dir() and transforms.is_file():
            masks = folder / DSLR_MASKS[index]
            posed = read_transforms(
                transforms,
                allow_outside=allow_outside,
                pictures=folder / pictures,
                masks=masks if masks.is_dir() else None,
            )
            return in_world_of_scan(posed)
    return read_colmap(
        folder / "colmap",
        folder / DSLR_PICTURES[0],
        folder,
        allow_outside=allow_outside,
        masks=folder / DSLR_MASKS[0],
    )
