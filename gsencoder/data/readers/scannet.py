"""ScanNet-style exports: color/, depth/, pose/ and intrinsic/, one file a frame, matched by their stems.

pose/N.txt is world_from_camera with OpenCV axes, metres, z up; frames that lost tracking hold -inf and are left out.
Depth is in millimetres unless told otherwise. Where depth has its own size and intrinsics it is resampled onto the
color camera; both are taken to look from the same place, as ScanNet's own exports do.
"""

import warnings
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.readers.images import picture_size
from gsencoder.data.readers.posed import PosedImage, PosedImages, inside, rigid_pose, warn_left_out
from gsencoder.data.readers.undistort import CameraModel, check_camera
from gsencoder.types.poses import invert_rigid

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
    color = _by_stem(root / "color", (".jpg", ".jpeg", ".png", ".webp"))
    if not color:
        raise InputError(f"{root / 'color'}: no pictures (.jpg, .png); expected one a frame")
    depths = _by_stem(root / "depth", (".png", ".npy"))
    instances = _by_stem(root / "instance", (".png",)) or _by_stem(root / "instance-filt", (".png",))
    color_file, depth_file = _intrinsic_files(root)
    images: list[PosedImage] = []
    unposed: list[str] = []
    lost = 0
    for stem, path in color.items():
        pose_file = root / "pose" / f"{stem}.txt"
        if not pose_file.is_file():
            unposed.append(f"pose/{stem}.txt")
            continue
        for file in (path, pose_file, depths.get(stem), instances.get(stem)):
            if file is not None:
                inside(root, str(file.relative_to(root)), f"{root}: frame {stem}", allow_outside=allow_outside)
        pose = _numbers(pose_file, (4, 4))
        if np.isneginf(pose).any():
            lost += 1
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
        raise InputError(
            f"{root}: no view: of {len(color)} pictures {len(unposed)} have no pose file, {lost} lost tracking"
        )
    warn_left_out(unposed, len(color), str(root), "pose files", "their pictures are left out")
    if lost:
        warnings.warn(
            f"{root}: {lost} of {len(color)} frames lost tracking (-inf) and are left out", SceneWarning, stacklevel=2
        )
    if depths:
        without = [image.name for image in images if image.depth is None]
        warn_left_out(without, len(images), str(root), "depth files", "those views have no depth")
    return PosedImages(source=str(root), images=tuple(images), metres_per_unit=1.0, up=np.array([0.0, 0.0, 1.0]))


def _by_stem(folder: Path, suffixes: tuple[str, ...]) -> dict[str, Path]:
    """Files by stem, numbers in their own order."""
    if not folder.is_dir():
        return {}
    files = [path for path in folder.iterdir() if path.suffix.lower() in suffixes and not path.name.startswith(".")]
    files.sort(key=lambda path: (not path.stem.isdecimal(), int(path.stem) if path.stem.isdecimal() else 0, path.name))
    stems: dict[str, Path] = {}
    for path in files:
        if path.stem in stems:
            raise InputError(f"{folder}: frame {path.stem} is there twice ({stems[path.stem].name}, {path.name})")
        stems[path.stem] = path
    return stems


def _numbers(path: Path, *shapes: tuple[int, int]) -> Float64[np.ndarray, "rows columns"]:
    try:
        values = np.array([line.split() for line in path.read_text().splitlines() if line.strip()], np.float64)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not a readable table of numbers ({' '.join(str(error).split())[:120]})") from error
    if values.shape not in shapes:
        raise InputError(
            f"{path}: expected {' or '.join(f'{a}×{b}' for a, b in shapes)} numbers, got {list(values.shape)}"
        )
    return values


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
    k = _numbers(path, (3, 3), (4, 4))
    width, height = picture_size(picture)
    fx, fy, cx, cy = (float(value) for value in (k[0, 0], k[1, 1], k[0, 2], k[1, 2]))
    camera = CameraModel(model="PINHOLE", width=width, height=height, params=(fx, fy, cx, cy))
    check_camera(camera, str(path))
    if k[0, 1] or k[1, 0] or abs(k[2, :3] - (0, 0, 1)).max() > 1e-6:
        raise InputError(f"{path}: expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], got {k[:3, :3].tolist()}")
    # The pictures are often exported at another size than the intrinsics; the principal point then lies off center.
    if not (0.25 * width < cx < 0.75 * width and 0.25 * height < cy < 0.75 * height):
        raise InputError(
            f"{path}: principal point {cx:g}, {cy:g} does not belong to pictures of {width}×{height} ({picture.name}); "
            "scale the intrinsics to the size of the pictures"
        )
    return camera
