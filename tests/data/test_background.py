"""Backgrounds of one color and transparency say where nothing is; photographs of real places have no background."""

from pathlib import Path

import numpy as np
import pytest
from lone_object import Ground, hemisphere_cameras, look, save_over, write_blender
from scene_files import photograph, save, write_transforms

from gsencoder.core.errors import SceneWarning
from gsencoder.data.readers.masks import Background, _outline, background_pixels, find_background
from gsencoder.data.scenes import SceneConfig, load_scene
from gsencoder.types import Views

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
        write_blender(folder, size=SIZE, train=6, others=1, ground=ground, suffix=".jpg" if name == "jpeg" else ".png")
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
