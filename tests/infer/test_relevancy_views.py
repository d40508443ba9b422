"""Which views are drawn for a word, and what the pictures are called."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from feature_fields import answer_of
from PIL import Image
from rooms import UP, splat
from splats import random_gaussians

from gsencoder.data.orbits import looking_cameras
from gsencoder.infer.draw import enlarge, legible_factor
from gsencoder.infer.localize import LocalizeConfig
from gsencoder.infer.pictures import best_views, relevancy_pictures
from gsencoder.render import blend
from gsencoder.render.images import visible_shares
from gsencoder.types import Cameras, Gaussians, Scene, Views


def wall(x: float, half: float = 1.0, step: float = 0.1) -> np.ndarray:
    """Points of a square wall across the x axis."""
    side = np.arange(-half, half + step / 2, step)
    y, z = np.meshgrid(side, side)
    return np.stack([np.full(y.size, x), y.ravel(), z.ravel()], axis=1)


def facing(*sides: float) -> Cameras:
    """One camera on the x axis for each side, looking at the origin."""
    centers = np.array([[3.0 * side, 0, 0] for side in sides])
    return looking_cameras(centers, -np.sign(centers), UP, 40.0, 64, 48)


def test_a_wall_is_best_seen_from_its_own_side() -> None:
    left, right = wall(-0.5), wall(0.5)
    gaussians = splat(np.concatenate([left, right]))
    groups = [np.arange(len(left)), np.arange(len(left), len(gaussians))]
    assert best_views(gaussians, facing(1.0, -1.0), groups, 2) == [[1, 0], [0, 1]]


def test_the_best_views_are_those_of_all_views(monkeypatch: pytest.MonkeyPatch) -> None:
    """A depth buffer spares most blends; the oracle blends every view."""
    gaussians = random_gaussians(400)
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    centers = 3.0 * np.stack((np.cos(angles), np.sin(angles), 0.2 * np.sin(5 * angles)), axis=1)
    cameras = looking_cameras(centers, -centers / np.linalg.norm(centers, axis=1, keepdims=True), UP, 40.0, 64, 48)
    groups = [np.arange(10), np.arange(30, 45), np.arange(100, 190)]
    worth = np.zeros((24, 3))
    for view in range(24):
        blended = blend(gaussians, cameras.resized(96), view)
        for column, rows in enumerate(groups):
            member = np.zeros(400, np.float32)
            member[rows] = 1
            worth[view, column] = float(blended.render(torch.from_numpy(member)).mean())
    counted = []

    def counting(gaussians: Gaussians, *arguments: Any, **options: Any) -> Any:
        counted.append(len(gaussians))
        return blend(gaussians, *arguments, **options)

    monkeypatch.setattr("gsencoder.infer.pictures.blend", counting)
    chosen = best_views(gaussians, cameras, groups, 3)
    for column, views in enumerate(chosen):
        best = np.sort(worth[:, column])[::-1]
        np.testing.assert_array_equal(worth[views, column], np.sort(worth[views, column])[::-1])
        assert worth[views, column].sum() > 0.8 * best[:3].sum()
        assert worth[views[0], column] == best[0]
    assert len(counted) < 24


def test_the_depth_buffer_sees_what_blending_sees() -> None:
    """Two walls, one behind the other from each side: shares of the pictures, and what hides what."""
    left, right = wall(-0.5), wall(0.5)
    gaussians = splat(np.concatenate([left, right]))
    groups = [np.arange(len(left)), np.arange(len(left), len(gaussians)), np.zeros(0, np.int64)]
    cameras = facing(1.0, -1.0)
    shares = visible_shares(gaussians, cameras, groups)
    for view, (seen, hidden) in enumerate(((1, 0), (0, 1))):
        member = np.zeros(len(gaussians), np.float32)
        member[groups[seen]] = 1
        exact = float(blend(gaussians, cameras, view).render(torch.from_numpy(member)).mean())
        assert shares[view, seen] == pytest.approx(exact, rel=0.15)
        assert shares[view, hidden] < 0.02
        assert shares[view, 2] == 0
    clear = replace(gaussians, opacities=np.full(len(gaussians), 0.1, np.float32))
    assert not visible_shares(clear, cameras, groups).any()


def test_views_that_show_nothing_come_in_their_own_order() -> None:
    gaussians = splat(wall(50.0))
    cameras = looking_cameras(np.zeros((3, 3)), np.tile([-1.0, 0, 0], (3, 1)), UP, 40.0, 64, 48)
    assert best_views(gaussians, cameras, [np.arange(5)], 3) == [[0, 1, 2]]


def test_every_word_gets_its_pictures_with_names_that_any_disk_takes() -> None:
    gaussians = splat(wall(0.0))
    cameras = facing(1.0, -1.0)
    scene = Scene(name="wall", gaussians=gaussians, views=Views(cameras=cameras, names=("a", "b")))
    scores = np.linspace(0, 1, len(gaussians), dtype=np.float32)
    scores[3] = np.nan
    words = ("a/b\\c", "é?", "x" * 500)
    localization = answer_of(words, np.tile(scores, (3, 1)), threshold=LocalizeConfig().threshold.fixed)
    pictures = dict(relevancy_pictures(scene, localization, per_word=2))
    assert sorted(pictures) == [
        f"{index:02d}_{word}_view{view:03d}" for index, word in enumerate(("a_b_c", "é_", "x" * 60)) for view in (0, 1)
    ]
    assert all(picture.width >= 64 for picture in pictures.values())


def test_the_photograph_is_on_the_left_and_relevancy_on_the_right() -> None:
    gaussians = splat(wall(0.0))
    cameras = facing(1.0)
    rng = np.random.default_rng(0)
    photograph = rng.integers(0, 256, (int(cameras.heights[0]), int(cameras.widths[0]), 3), dtype=np.uint8)
    views = Views(cameras=cameras, names=("a",), images=[photograph])
    localization = answer_of(("wall",), np.ones((1, len(gaussians)), np.float32), threshold=0.5)
    drawn = {}
    for name, images in (("photograph", [photograph]), ("rendered", None)):
        scene = Scene(name="wall", gaussians=gaussians, views=replace(views, images=images))
        ((_, picture),) = relevancy_pictures(scene, localization, per_word=1)
        drawn[name] = np.asarray(picture)
    assert drawn["photograph"].shape == drawn["rendered"].shape
    middle = drawn["photograph"].shape[1] // 2
    differs = (drawn["photograph"] != drawn["rendered"]).any(axis=(0, 2))
    assert differs[:middle].mean() > 0.9
    assert not differs[middle:].any()
    left = Image.fromarray(drawn["photograph"][:, :middle])
    factor = legible_factor(photograph.shape[1])
    large = enlarge(photograph, factor)
    windows = np.lib.stride_tricks.sliding_window_view(np.asarray(left), large.shape)
    assert any(np.array_equal(window, large) for window in windows.reshape(-1, *large.shape))
