"""Writes small posed scenes in every layout that the readers know. The cameras look down on the origin."""

import copy
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from splats import gaussians_at

from gsencoder.data.readers.posed import CameraModel, PosedImage
from gsencoder.types import Gaussians

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def world_from_cams(count: int, offset: tuple[float, float, float] = (0, 0, 0)) -> np.ndarray:
    """float64 [count, 4, 4], OpenCV axes: cameras on a circle at height 2 that look at the origin of the plane."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    for i in range(count):
        angle = 2 * math.pi * i / count
        center = np.array([math.cos(angle), math.sin(angle), 2.0])
        forward = -center / np.linalg.norm(center)
        right = np.cross(forward, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        poses[i, :3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
        poses[i, :3, 3] = center + offset
    return poses


def photograph(seed: int, width: int = 32, height: int = 24) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def save(path: Path, values: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(values).save(path)
    return path


def write_transforms(
    folder: Path,
    count: int = 3,
    *,
    offset: tuple[float, float, float] = (0, 0, 0),
    depth: bool = False,
    instances: bool = False,
    **top: Any,
) -> dict[str, Any]:
    """A nerfstudio scene with 32×24 pictures; returns the JSON object, which `rewrite` can save again."""
    frames = []
    for i, pose in enumerate(world_from_cams(count, offset)):
        save(folder / f"images/{i:03d}.png", photograph(i))
        frame: dict[str, Any] = {"file_path": f"images/{i:03d}.png", "transform_matrix": (pose @ OPENGL).tolist()}
        if depth:
            save(folder / f"depth/{i:03d}.png", np.full((24, 32), 1000 + i, np.uint16))
            frame["depth_file_path"] = f"depth/{i:03d}.png"
        if instances:
            save(folder / f"instance/{i:03d}.png", np.full((24, 32), 300 + i, np.uint16))
            frame["instance_file_path"] = f"instance/{i:03d}.png"
        frames.append(frame)
    data = {"w": 32, "h": 24, "fl_x": 30.0, "fl_y": 31.0, "cx": 15.5, "cy": 12.5, "frames": frames} | top
    rewrite(folder, data)
    return data


def rewrite(folder: Path, data: dict[str, Any], name: str = "transforms.json") -> Path:
    (folder / name).write_text(json.dumps(data))
    return folder / name


def write_colmap(
    folder: Path,
    count: int = 3,
    *,
    model: str = "PINHOLE",
    params: tuple[float, ...] = (30, 31, 16, 12),
    text: bool = False,
    old: bool = False,
    offset: tuple[float, float, float] = (0, 0, 0),
) -> Path:
    """A COLMAP scene with five points that every 32×24 picture sees; `old` leaves rigs and frames away."""
    from gsencoder.data.readers.posed import load_pycolmap

    pycolmap = load_pycolmap()
    made = pycolmap.Reconstruction()
    camera = pycolmap.Camera(camera_id=1, model=model, width=32, height=24, params=list(params))
    made.add_camera_with_trivial_rig(camera)
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (5, 3)) + offset
    for i, pose in enumerate(world_from_cams(count, offset), start=1):
        save(folder / f"images/{i:03d}.png", photograph(i))
        inverse = np.linalg.inv(pose)
        rigid = pycolmap.Rigid3d(pycolmap.Rotation3d(inverse[:3, :3]), inverse[:3, 3])
        image = pycolmap.Image(image_id=i, camera_id=1, name=f"{i:03d}.png")
        seen = camera.img_from_cam(points @ inverse[:3, :3].T + inverse[:3, 3])
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in seen])
        made.add_image_with_trivial_frame(image, rigid)
    for j, point in enumerate(points):
        track = pycolmap.Track()
        for i in range(1, count + 1):
            track.add_element(i, j)
        made.add_point3D(point, track, np.array([10 * j, 20, 30], np.uint8))
    sparse = folder / "sparse/0"
    sparse.mkdir(parents=True, exist_ok=True)
    (made.write_text if text else made.write_binary)(str(sparse))
    if old:
        for file in ("rigs", "frames"):
            (sparse / f"{file}.{'txt' if text else 'bin'}").unlink()
    return sparse


def write_scannet(folder: Path, count: int = 3, *, depth_size: tuple[int, int] = (32, 24)) -> None:
    """A ScanNet export; the depth of a pixel is 1000 + its column, in millimetres."""
    (folder / "pose").mkdir(parents=True)
    (folder / "intrinsic").mkdir()
    w, h = depth_size
    for i, pose in enumerate(world_from_cams(count)):
        save(folder / f"color/{i}.png", photograph(i))
        save(folder / f"depth/{i}.png", np.tile(1000 + np.arange(w, dtype=np.uint16), (h, 1)))
        np.savetxt(folder / f"pose/{i}.txt", pose)
    for name, scale in (("color", 1.0), ("depth", w / 32)):
        k = np.diag([30 * scale, 31 * scale, 1.0, 1.0])
        k[0, 2], k[1, 2] = 16 * scale, 12 * scale
        np.savetxt(folder / f"intrinsic/intrinsic_{name}.txt", k)


def some_gaussians(means: np.ndarray, opacities: np.ndarray | None = None, scale: float = 0.01) -> Gaussians:
    return gaussians_at(means, scale, 1.0 if opacities is None else opacities)


def change(folder: Path, data: dict[str, Any], frame: int = 1, **values: Any) -> Path:
    """Saves the scene with some values of one frame set; None removes a value."""
    data = copy.deepcopy(data)
    data["frames"][frame] |= values
    data["frames"][frame] = {key: value for key, value in data["frames"][frame].items() if value is not None}
    return rewrite(folder, data)


def with_depth(depth: Path | None, scale: float = 1.0) -> PosedImage:
    """A view of which nothing but the depth file counts."""
    camera = CameraModel(model="PINHOLE", width=32, height=24, params=(30.0, 31.0, 16.0, 12.0))
    return PosedImage(
        name=str(depth), camera=camera, cam_from_world=np.eye(4), image=Path("x"), depth=depth, depth_scale=scale
    )
