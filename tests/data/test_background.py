"""Backgrounds of one color and transparency say where nothing is; photographs of real places have no background."""

import json
import math
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from PIL import Image
from scene_files import photograph, save, write_transforms
from textured_box import blotches

from gsencoder.core.errors import SceneWarning
from gsencoder.data.orbits import looking_cameras
from gsencoder.data.readers.masks import Background, _outline, background_pixels, find_background
from gsencoder.data.scenes import SceneConfig, load_scene
from gsencoder.data.synthetic import Solid
from gsencoder.types import Cameras, Views
from gsencoder.types.scene import OPENCV_FROM_OPENGL

Ground = Literal["transparent", "white", "black"]
DISTANCE, FIELD = 4.0, 0.69
"""Of the cameras from the middle, and their horizontal field of view in radians, as in the NeRF synthetic scenes."""


SOLIDS = [
    Solid(shape=shape, center=np.array(center), half=np.array(half), yaw=yaw)
    for shape, center, half, yaw in (
        ("box", (0, 0, -0.35), (0.8, 0.5, 0.08), 0.0),
        ("box", (-0.35, 0, 0), (0.25, 0.3, 0.3), 0.3),
        ("cylinder", (0.35, 0.1, 0.05), (0.18, 0.18, 0.4), 0.0),
        ("ellipsoid", (0.35, 0.1, 0.6), (0.3, 0.3, 0.2), 0.0),
        ("box", (0.5, -0.35, -0.15), (0.05, 0.05, 0.15), 0.0),
    )
]
WHITE_SOLID = 3
"""This one is as white as paper, so that a white background hides its outline in part."""


def hemisphere_cameras(count: int, size: int, *, first: int = 0) -> Cameras:
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


def write_blender(folder: Path, ground: Ground, suffix: str) -> None:
    """Writes transforms_train.json of six pictures, _val and _test of one, with their pictures."""
    first = 0
    for split, count in (("train", 6), ("val", 1), ("test", 1)):
        cameras = hemisphere_cameras(count, SIZE, first=first)
        first += count
        frames = []
        (folder / split).mkdir(parents=True, exist_ok=True)
        for view, pose in enumerate(cameras.world_from_cam.astype(float) @ OPENCV_FROM_OPENGL):
            save_over(folder / split / f"r_{view}{suffix}", *look(cameras, view), ground)
            frames.append({"file_path": f"./{split}/r_{view}", "rotation": 0.01, "transform_matrix": pose.tolist()})
        content = {"camera_angle_x": FIELD, "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(content), encoding="utf-8")


def save_over(file: Path, color: np.ndarray, alpha: np.ndarray, ground: Ground) -> None:
    """Writes a picture with its alpha, or over a background of one color."""
    if ground == "transparent":
        pixels = np.concatenate((color, alpha[..., None]), axis=2)
    else:
        behind = 1.0 if ground == "white" else 0.0
        pixels = color * alpha[..., None] + behind * (1 - alpha[..., None])
    Image.fromarray((255 * np.clip(pixels, 0, 1) + 0.5).astype(np.uint8)).save(file, quality=92)


SIZE = 64


@pytest.fixture(scope="module")
def alphas():
    cameras = hemisphere_cameras(6, SIZE)
    return [look(cameras, view)[1] for view in range(6)]


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    made = {}
    for name in ("transparent", "white", "black", "jpeg"):
        folder = tmp_path_factory.mktemp(name)
        ground: Ground = "white" if name == "jpeg" else name  # type: ignore[assignment]
        write_blender(folder, ground, ".jpg" if name == "jpeg" else ".png")
        made[name] = folder
    return made


def views_of(folder: Path, **options: object) -> Views:
    return load_scene(folder, options=SceneConfig(**options)).views  # type: ignore[arg-type]


def test_transparency_is_empty_where_nothing_shows_and_used_where_half_shows(scenes, alphas):
    views = views_of(scenes["transparent"])
    edges = 0
    for view, alpha in enumerate(alphas):
        rounded = np.round(255 * alpha)
        np.testing.assert_array_equal(views.masks[view], rounded >= 128)
        np.testing.assert_array_equal(views.empty[view], rounded < 4)
        edges += int((~views.masks[view] & ~views.empty[view]).sum())
    # Half-transparent edges are in neither.
    assert edges > 100


@pytest.mark.parametrize("name", ["white", "black", "jpeg"])
def test_a_background_of_one_color_is_empty_and_no_part_of_the_object_is(scenes, alphas, name):
    color = "black" if name == "black" else "white"
    with pytest.warns(SceneWarning, match=rf"background of one color \({color}, 79% of the pixels\); it is masked"):
        views = views_of(scenes[name])
    for view, alpha in enumerate(alphas):
        used, empty = views.masks[view], views.empty[view]
        assert not (used & empty).any()
        # A white solid's outline is hidden by white: that little may be taken for empty.
        assert empty[alpha > 0.5].mean() < 0.02
        assert used[alpha > 0].sum() > 0.7 * (alpha == 1).sum()
        assert not used[alpha == 0].any()
        assert empty[alpha == 0].mean() > 0.93


def test_the_background_can_be_kept(scenes):
    views = views_of(scenes["white"], background="none")
    assert views.masks is None
    assert views.empty is None


def test_what_has_the_color_and_is_not_connected_to_the_border_stays(tmp_path):
    picture = np.full((40, 40, 3), 255, np.uint8)
    picture[10:30, 10:30] = 90
    picture[15:25, 15:25] = 255
    path = save(tmp_path / "ring.png", picture)
    region = background_pixels(picture, (255, 255, 255), path)
    assert not region[10:30, 10:30].any()
    assert region.sum() == 1600 - 400
    used, empty = _outline(path, Background(color=(255, 255, 255), share=0.75), 0, 0)
    assert used[15:25, 15:25].all()
    # Two pixels beside the background mix both colors, one of the background's own may.
    assert used.sum() == 16 * 16
    assert empty.sum() == 1600 - 22 * 22 + 4


def test_bright_walls_windows_and_lens_shades_are_no_background(tmp_path):
    """White walls vary by more than rounding, windows end in the picture, and dark corners are the same everywhere."""
    made = np.random.default_rng(0)
    across = np.linspace(0, 6, 64)
    for view in range(6):
        wall = 244 + np.round(across + made.normal(0, 1.5, (64, 64))).clip(0, 11)
        wall[20:40, 10 + view : 40] = 60
        save(tmp_path / f"wall_{view}.png", np.repeat(wall[..., None], 3, axis=2).astype(np.uint8))
        window = made.integers(0, 200, (64, 64, 3), dtype=np.uint8)
        window[:40] = 255
        save(tmp_path / f"window_{view}.png", window)
        disc = photograph(view, 64, 64)
        y, x = np.mgrid[:64, :64] - 31.5
        disc[np.hypot(x, y) > 30] = 0
        save(tmp_path / f"lens_{view}.png", disc)
    for kind in ("wall", "window", "lens"):
        assert find_background([tmp_path / f"{kind}_{view}.png" for view in range(6)]) is None, kind


def test_few_photographs_that_the_object_fills_do_not_hide_the_background(tmp_path):
    cameras = hemisphere_cameras(8, 48)
    paths = [tmp_path / f"{view}.png" for view in range(8)]
    for view, path in enumerate(paths):
        save_over(path, *look(cameras, view, oversampling=2), "white")
    for view in range(4):
        background = find_background(paths)
        assert (background is not None) == (view < 3)
        save(paths[view], photograph(view, 48, 48))


def test_depth_on_it_makes_a_background_a_wall(tmp_path, recwarn):
    write_transforms(tmp_path, 4, depth=True)
    for view in range(4):
        picture = np.full((24, 32, 3), 255, np.uint8)
        picture[8:16, 8 + view : 20] = photograph(view, 12 - view, 8)
        save(tmp_path / f"images/{view:03d}.png", picture)
    assert views_of(tmp_path).empty is None
    assert not recwarn.list
    for view in range(4):
        save(tmp_path / f"depth/{view:03d}.png", np.zeros((24, 32), np.uint16))
    with pytest.warns(SceneWarning, match="background of one color"):
        assert views_of(tmp_path).empty is not None
