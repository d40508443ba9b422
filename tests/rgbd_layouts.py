"""A synthetic room written in each layout of scenes but transforms.json and COLMAP: `WRITERS`."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from gsencoder.types import Scene


def _picture(path: Path, values: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(values).save(path)


def _frames(scene: Scene) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Photograph, depth in metres and world_from_camera of each view."""
    poses = scene.views.cameras.world_from_cam.astype(np.float64)
    poses[:, :3, 3] += scene.origin
    return list(zip(scene.views.images, scene.views.depths, poses, strict=True))


def _steps(depth: np.ndarray, a_metre: float, none: int = 0) -> np.ndarray:
    steps = np.round(depth * a_metre)
    return np.where((depth > 0) & (steps < 65535), steps, none).astype(np.uint16)


def write_seven_scenes(scene: Scene, folder: Path) -> None:
    """With 65535 where there is no depth."""
    for index, (color, depth, pose) in enumerate(_frames(scene)):
        stem = folder / f"frame-{12 * index:06d}"
        _picture(stem.with_name(stem.name + ".color.png"), color)
        _picture(stem.with_name(stem.name + ".depth.png"), _steps(depth, 1000, none=65535))
        np.savetxt(stem.with_name(stem.name + ".pose.txt"), pose, delimiter="\t", newline="\r\n")
    np.savetxt(folder / "camera-intrinsics.txt", scene.views.cameras.Ks[0])


def write_tum(scene: Scene, folder: Path, *, late: float = 0.004) -> None:
    """Depth is taken `late` seconds after each photograph, and poses are written five times as often."""
    frames = _frames(scene)
    times = 1305031102.0 + 0.033 * np.arange(len(frames))
    for name in ("rgb", "depth"):
        shift = late if name == "depth" else 0.0
        lines = [f"# {name} images", "# timestamp filename"]
        for time, (color, depth, _) in zip(times + shift, frames, strict=True):
            _picture(folder / name / f"{time:.6f}.png", color if name == "rgb" else _steps(depth, 5000))
            lines.append(f"{time:.6f} {name}/{time:.6f}.png")
        (folder / f"{name}.txt").write_text("\ufeff" + "\r\n".join(lines), encoding="utf-8")
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for time, (_, _, pose) in zip(times, frames, strict=True):
        quat = Rotation.from_matrix(pose[:3, :3]).as_quat()
        lines.append("\t".join(f"{value:.7f}" for value in (time, *pose[:3, 3], *quat)))
    (folder / "groundtruth.txt").write_text("\n".join(lines), encoding="utf-8")


def write_replica(scene: Scene, folder: Path) -> None:
    """With cam_params.json beside the folder, as all rooms of the data set share one."""
    poses = []
    for index, (color, depth, pose) in enumerate(_frames(scene)):
        _picture(folder / "results" / f"frame{index:06d}.png", color)
        _picture(folder / "results" / f"depth{index:06d}.png", _steps(depth, 6553.5))
        poses.append(pose.reshape(-1))
    np.savetxt(folder / "traj.txt", poses)
    K = scene.views.cameras.Ks[0].astype(float)
    camera = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "scale": 6553.5}
    (folder.parent / "cam_params.json").write_text(json.dumps({"camera": camera}))


def write_scannetpp(scene: Scene, folder: Path) -> None:
    """The dslr/ folder with its transforms.json, whose paths count from resized_images, in nerfstudio's world."""
    K, frames = scene.views.cameras.Ks[0].astype(float), []
    for index, (color, _, pose) in enumerate(_frames(scene)):
        name = f"DSC{index:05d}.png"
        _picture(folder / "dslr" / "resized_images" / name, color)
        _picture(folder / "dslr" / "resized_anon_masks" / name, np.full(color.shape[:2], 255, np.uint8))
        matrix = (pose @ np.diag([1.0, -1.0, -1.0, 1.0]))[[1, 0, 2, 3]]
        matrix[2] *= -1
        frames.append({"file_path": name, "mask_path": name, "transform_matrix": matrix.tolist()})
    data = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "frames": frames, "test_frames": []}
    (folder / "dslr" / "nerfstudio").mkdir(parents=True)
    (folder / "dslr" / "nerfstudio" / "transforms.json").write_text(json.dumps(data))


def write_scannet_frames(scene: Scene, folder: Path) -> None:
    """The export of a ScanNet scan, in millimetres."""
    for index, (color, depth, pose) in enumerate(_frames(scene)):
        _picture(folder / "color" / f"{index}.png", color)
        _picture(folder / "depth" / f"{index}.png", _steps(depth, 1000))
        (folder / "pose").mkdir(exist_ok=True)
        np.savetxt(folder / "pose" / f"{index}.txt", pose)
    K = np.eye(4)
    K[:3, :3] = scene.views.cameras.Ks[0]
    (folder / "intrinsic").mkdir()
    for name in ("color", "depth"):
        np.savetxt(folder / "intrinsic" / f"intrinsic_{name}.txt", K)


WRITERS: dict[str, Callable[[Scene, Path], None]] = {
    "7-Scenes": write_seven_scenes, "TUM RGB-D": write_tum, "Replica": write_replica,
    "ScanNet++": write_scannetpp, "ScanNet": write_scannet_frames,
}  # fmt: skip
