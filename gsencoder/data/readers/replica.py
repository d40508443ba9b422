"""Replica as NICE-SLAM exports it: results/frameNNNNNN.jpg, results/depthNNNNNN.png and traj.txt.

Line n of traj.txt is world_from_camera of frame n, 16 numbers with OpenCV axes in metres, z up. cam_params.json in the
folder or beside it holds the intrinsics and the depth steps of a metre; without it they are those of that export.
"""

from pathlib import Path

import numpy as np

from gsencoder.core.errors import InputError
from gsencoder.data.readers.frames import PICTURE_SUFFIXES, SkippedFrames, files_by_stem, is_lost, pinhole_of
from gsencoder.data.readers.posed import PosedImage, PosedImages, inside, number, rigid_pose, warn_left_out
from gsencoder.data.readers.tables import read_numbers
from gsencoder.data.readers.transforms_json import read_json
from gsencoder.types.checks import invert_rigid

TRAJECTORY, PARAMETERS, PICTURES = "traj.txt", "cam_params.json", "results"
DEFAULT_PARAMETERS = {"fx": 600.0, "fy": 600.0, "cx": 599.5, "cy": 339.5, "scale": 6553.5}


def is_replica(folder: Path) -> bool:
    """Whether a folder holds such an export."""
    return (folder / TRAJECTORY).is_file() and (folder / PICTURES).is_dir()


def read_replica(root: Path, *, allow_outside: bool = False, depth_scale: float | None = None) -> PosedImages:
    """Reads an export.

    Args:
        root: the folder with traj.txt and results/.
        allow_outside: let links in it lead out of it.
        depth_scale: metres for each step of a depth file; None = that of cam_params.json.

    Raises:
        InputError: no frame, fewer poses than frames, or intrinsics that do not belong to the pictures.
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
