"""A box with blotchy walls and what cameras in it see: exact photographs and depth, with features to match."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from gsencoder.data.orbits import looking_cameras
from gsencoder.types import Cameras, Views
from gsencoder.types.poses import OPENCV_FROM_OPENGL

HALF = np.array([2.0, 2.5, 1.4])
"""Half of the box's sides, meters; z is up."""


def box_cameras(count: int = 10, width: int = 320, height: int = 240, focal: float = 224.0) -> Cameras:
    """Cameras on an arc around the middle that look across it, level, each somewhat higher than the one before."""
    turns = np.linspace(0, 1.2 * np.pi, count)
    centers = np.stack((0.9 * np.cos(turns), 1.1 * np.sin(turns), np.linspace(-0.5, 0.4, count)), axis=1)
    aims = np.stack((-1.5 * np.cos(turns + 0.2), -1.8 * np.sin(turns + 0.2), np.zeros(count)), axis=1)
    forward = aims - centers
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    return looking_cameras(centers, forward, np.array([0.0, 0, 1]), width=width, height=height, focal=focal)


def look(cameras: Cameras, view: int) -> tuple[np.ndarray, np.ndarray]:
    """Photograph uint8 [H, W, 3] and depth float32 [H, W] of a view."""
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
    total = np.zeros(points.shape)
    for _ in range(20):
        direction, phase = made.normal(size=(6, 3)) * 11, made.uniform(0, 6.3, 3)
        along = np.einsum("...i,...i->...", points, direction[side])
        total += np.sin(along)[..., None] * np.cos(phase)
    return np.asarray(0.5 + 0.5 * np.tanh(total / 3))


def box_views(cameras: Cameras | None = None, *, color_cameras: Cameras | None = None) -> Views:
    """Photographs and depth; with `color_cameras` the photographs are theirs."""
    cameras = box_cameras() if cameras is None else cameras
    colors = cameras if color_cameras is None else color_cameras
    rows = range(len(cameras))
    return Views(
        cameras=cameras,
        names=tuple(f"{view:03d}.png" for view in rows),
        images=[look(colors, view)[0] for view in rows],
        depths=[look(cameras, view)[1] for view in rows],
    )


def write_box(folder: Path, views: Views, *, millimeters: float = 1000.0) -> dict[str, Any]:
    """Writes views as a nerfstudio scene, 16-bit depth in steps of 1 / `millimeters`; returns its transforms.json."""
    assert views.images is not None
    assert views.depths is not None
    for name in ("images", "depth"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    frames = []
    for view, pose in enumerate(views.cameras.world_from_cam @ OPENCV_FROM_OPENGL):
        stem = f"{view:03d}.png"
        Image.fromarray(views.images[view]).save(folder / "images" / stem)
        steps = np.round(views.depths[view].astype(np.float64) * millimeters).astype(np.uint16)
        Image.fromarray(steps).save(folder / "depth" / stem)
        frames.append(
            {"file_path": f"images/{stem}", "depth_file_path": f"depth/{stem}", "transform_matrix": pose.tolist()}
        )
    K = views.cameras.Ks[0].astype(float)
    content = {
        "fl_x": K[0, 0],
        "fl_y": K[1, 1],
        "cx": K[0, 2],
        "cy": K[1, 2],
        "depth_unit_scale_factor": 1 / millimeters,
        "frames": frames,
    }
    (folder / "transforms.json").write_text(json.dumps(content), encoding="utf-8")
    return content
