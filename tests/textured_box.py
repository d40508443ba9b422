"""A box with blotchy walls and what cameras in it see: exact photographs and depth, with features to match."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from gsencoder.data.orbits import looking_cameras
from gsencoder.types import Cameras, Views
from gsencoder.types.scene import OPENCV_FROM_OPENGL

HALF = np.array([2.0, 2.5, 1.4])
"""Half of the box's sides, meters; z is up."""
SEEN: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}
"""Photographs and depth that were looked at before, by their cameras."""


def box_cameras(count: int = 10, width: int = 320, height: int = 240, focal: float = 224.0) -> Cameras:
    """Cameras on an arc around the middle that look across it, level, each somewhat higher than the one before."""
    turns = np.linspace(0, 1.2 * np.pi, count)
    centers = np.stack((0.9 * np.cos(turns), 1.1 * np.sin(turns), np.linspace(-0.5, 0.4, count)), axis=1)
    aims = np.stack((-1.5 * np.cos(turns + 0.2), -1.8 * np.sin(turns + 0.2), np.zeros(count)), axis=1)
    forward = aims - centers
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    return looking_cameras(centers, forward, np.array([0.0, 0, 1]), width=width, height=height, focal=focal)


def look(cameras: Cameras, view: int) -> tuple[np.ndarray, np.ndarray]:
    """Photograph uint8 [H, W, 3] and depth float32 [H, W] of a view; tests look again and again, and share both."""
    arrays = [getattr(cameras, name)[view] for name in ("cam_from_world", "Ks", "widths", "heights")]
    key = b"".join(np.asarray(array).tobytes() for array in arrays)
    if key not in SEEN:
        SEEN[key] = _look(cameras, view)
        for array in SEEN[key]:
            array.flags.writeable = False
    return SEEN[key]


def _look(cameras: Cameras, view: int) -> tuple[np.ndarray, np.ndarray]:
    center, rays = cameras.centers[view], cameras.rays(view)
    with np.errstate(divide="ignore"):
        distances = (np.sign(rays) * HALF - center) / rays
    wall = np.nanargmin(distances, axis=2)
    depth = np.take_along_axis(distances, wall[..., None], axis=2)
    points = center + depth * rays
    side = 2 * wall + (np.take_along_axis(rays, wall[..., None], axis=2)[..., 0] > 0)
    return (255 * blotches(points, side) + 0.5).astype(np.uint8), depth[..., 0].astype(np.float32)


def blotches(points: np.ndarray, side: np.ndarray) -> np.ndarray:
    """RGB in [0, 1]: waves in many directions, other ones on each wall."""
    made = np.random.default_rng(0)
    waves = [(made.normal(size=(6, 3)) * 11, made.uniform(0, 6.3, 3)) for _ in range(20)]
    directions = np.stack([direction for direction, _ in waves], axis=2)
    colors = np.cos([phase for _, phase in waves])
    total = np.zeros(points.shape)
    for each in np.unique(side):
        rows = side == each
        total[rows] = np.sin(points[rows] @ directions[each]) @ colors
    return np.asarray(0.5 + 0.5 * np.tanh(total / 3))


def box_views(cameras: Cameras | None = None, *, color_cameras: Cameras | None = None) -> Views:
    """Photographs and depth; with `color_cameras` the photographs are theirs."""
    cameras = box_cameras() if cameras is None else cameras
    rows = range(len(cameras))
    looks = [look(cameras, view) for view in rows]
    return Views(
        cameras=cameras,
        names=tuple(f"{view:03d}.png" for view in rows),
        images=[look(color_cameras, view)[0] if color_cameras is not None else looks[view][0] for view in rows],
        depths=[depth for _, depth in looks],
    )


def write_box(folder: Path, views: Views) -> dict[str, Any]:
    """Writes views as a nerfstudio scene, 16-bit depth in millimetres; returns its transforms.json."""
    for name in ("images", "depth"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    frames = []
    for view, pose in enumerate(views.cameras.world_from_cam @ OPENCV_FROM_OPENGL):
        stem = f"{view:03d}.png"
        Image.fromarray(views.images[view]).save(folder / "images" / stem)
        steps = np.round(views.depths[view].astype(np.float64) * 1000).astype(np.uint16)
        Image.fromarray(steps).save(folder / "depth" / stem)
        frames.append(
            {"file_path": f"images/{stem}", "depth_file_path": f"depth/{stem}", "transform_matrix": pose.tolist()}
        )
    K = views.cameras.Ks[0].astype(float)
    content = {
        "fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2],
        "depth_unit_scale_factor": 1 / 1000, "frames": frames,
    }  # fmt: skip
    (folder / "transforms.json").write_text(json.dumps(content), encoding="utf-8")
    return content
