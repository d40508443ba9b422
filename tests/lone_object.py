"""An object in empty space and what cameras on a hemisphere around it see, in the files that Blender scenes have."""

import json
import math
from pathlib import Path
from typing import Literal

import numpy as np
from PIL import Image
from textured_box import blotches

from gsencoder.data.orbits import looking_cameras
from gsencoder.data.synthetic import Solid
from gsencoder.types import Cameras
from gsencoder.types.checks import OPENCV_FROM_OPENGL

Ground = Literal["transparent", "white", "black"]
DISTANCE, FIELD = 4.0, 0.69
"""Of the cameras from the middle, and their horizontal field of view in radians, as in the NeRF synthetic scenes."""


def _solid(
    shape: Literal["box", "ellipsoid", "cylinder"],
    center: tuple[float, float, float],
    half: tuple[float, float, float],
    yaw: float = 0.0,
) -> Solid:
    return Solid(shape=shape, center=np.array(center), half=np.array(half), yaw=yaw)


SOLIDS = (
    _solid("box", (0, 0, -0.35), (0.8, 0.5, 0.08)),
    _solid("box", (-0.35, 0, 0), (0.25, 0.3, 0.3), 0.3),
    _solid("cylinder", (0.35, 0.1, 0.05), (0.18, 0.18, 0.4)),
    _solid("ellipsoid", (0.35, 0.1, 0.6), (0.3, 0.3, 0.2)),
    _solid("box", (0.5, -0.35, -0.15), (0.05, 0.05, 0.15)),
)
WHITE_SOLID = 3
"""This one is as white as paper, so that a white background hides its outline in part."""


def hemisphere_cameras(count: int, size: int = 80, *, first: int = 0) -> Cameras:
    """Cameras on a golden-angle spiral over the upper hemisphere, square pictures."""
    steps = np.arange(count) + first + 0.5
    sines, turns = 0.1 + 0.75 * (steps * 0.618034 % 1), steps * math.pi * (3 - math.sqrt(5))
    level = np.sqrt(1 - sines**2)
    outward = np.stack((level * np.cos(turns), level * np.sin(turns), sines), axis=1)
    focal = size / (2 * math.tan(FIELD / 2))
    return looking_cameras(DISTANCE * outward, -outward, np.array([0.0, 0, 1]), width=size, height=size, focal=focal)


def look(cameras: Cameras, view: int, *, oversampling: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """RGB float [H, W, 3], not premultiplied, and alpha [H, W]; each pixel is the mean of so many rays squared."""
    fine = cameras.select([view]).resized(oversampling * int(cameras.widths[view]), enlarge=True)
    center, rays = fine.centers[0].astype(np.float64), fine.rays(0).astype(np.float64)
    hits = np.stack([solid.hits(center, rays) for solid in SOLIDS])
    nearest, depth = hits.argmin(axis=0), hits.min(axis=0)
    seen = np.isfinite(depth)
    points = center + depth[seen][:, None] * rays[seen]
    normals = np.zeros((len(points), 3))
    for row, solid in enumerate(SOLIDS):
        chosen = nearest[seen] == row
        normals[chosen] = solid.normals(points[chosen])
    colors = blotches(3 * points, nearest[seen]) * 0.8
    white = nearest[seen] == WHITE_SOLID
    colors[white] = 0.96 + 0.08 * (blotches(3 * points[white], nearest[seen][white]) - 0.5)
    light = 0.75 + 0.25 * np.clip(normals @ np.array([0.3, -0.4, 0.87]), 0, 1)
    picture = np.zeros((*seen.shape, 3))
    picture[seen] = np.clip(colors * light[:, None], 0, 1)
    height, width = (side // oversampling for side in seen.shape)
    blocks = (height, oversampling, width, oversampling)
    alpha = seen.reshape(blocks).mean(axis=(1, 3))
    summed = picture.reshape(*blocks, 3).mean(axis=(1, 3))
    return summed / np.maximum(alpha, 1e-9)[..., None], alpha


def write_blender(
    folder: Path,
    *,
    size: int = 80,
    train: int = 12,
    others: int = 2,
    ground: Ground = "transparent",
    suffix: str = ".png",
    oversampling: int = 3,
) -> dict[str, Cameras]:
    """Writes transforms_train.json, _val and _test with their pictures; the cameras of each."""
    written, first = {}, 0
    for split, count in (("train", train), ("val", others), ("test", others)):
        cameras = hemisphere_cameras(count, size, first=first)
        first += count
        frames = []
        (folder / split).mkdir(parents=True, exist_ok=True)
        for view, pose in enumerate(cameras.world_from_cam.astype(float) @ OPENCV_FROM_OPENGL):
            color, alpha = look(cameras, view, oversampling=oversampling)
            file = folder / split / f"r_{view}{suffix}"
            save_over(file, color, alpha, ground)
            frames.append({"file_path": f"./{split}/r_{view}", "rotation": 0.01, "transform_matrix": pose.tolist()})
        content = {"camera_angle_x": FIELD, "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(content), encoding="utf-8")
        written[split] = cameras
    return written


def save_over(file: Path, color: np.ndarray, alpha: np.ndarray, ground: Ground) -> None:
    """Writes a picture with its alpha, or over a background of one color."""
    if ground == "transparent":
        pixels = np.concatenate((color, alpha[..., None]), axis=2)
    else:
        behind = 1.0 if ground == "white" else 0.0
        pixels = color * alpha[..., None] + behind * (1 - alpha[..., None])
    Image.fromarray((255 * np.clip(pixels, 0, 1) + 0.5).astype(np.uint8)).save(file, quality=92)
