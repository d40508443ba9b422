"""Close-ups: windows of photographs, as they were taken, that show small targets large."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from rooms import corner_cameras, room

from gsencoder.infer.views.candidates import closeups
from gsencoder.infer.views.choose import choose_views
from gsencoder.infer.views.photographs import photograph_cameras, photograph_of, with_photographs
from gsencoder.infer.views.pictures import picture_kinds, view_pictures
from gsencoder.infer.views.targets import CONSTANTS, Target, ViewsConfig, target_of
from gsencoder.types import Cameras, Scene

pytestmark = pytest.mark.slow

WIDTH, HEIGHT = 1280, 960
SIZE = {"width": 320, "height": 240}


@cache
def photographed() -> tuple[Scene, Target]:
    """The room with small cameras and large photographs, whose red and green say where a pixel is."""
    scene, rows = room(step=0.12)
    x, y = np.meshgrid((np.arange(WIDTH) + 0.5) / WIDTH, (np.arange(HEIGHT) + 0.5) / HEIGHT)
    pictures = [
        np.stack([255 * x, 255 * y, np.full_like(x, 20 * view)], axis=-1).round().astype(np.uint8)
        for view in range(len(scene.views))
    ]
    large = replace(scene.views, cameras=scene.views.cameras.resized(WIDTH), images=pictures)
    whole = with_photographs(scene, replace(scene, views=large))
    return whole, target_of("cube", scene.gaussians, rows)


def places(cameras: Cameras, view: int, points: np.ndarray) -> np.ndarray:
    return cameras.project(points, view)[0]


def test_a_close_up_shows_each_point_where_the_photograph_has_it() -> None:
    scene, target = photographed()
    large = photograph_cameras(scene.views)
    assert large.widths.tolist() == [WIDTH] * len(scene.views)
    raw = photograph_of(scene.views, 7, large, 7)
    assert raw.shape == (HEIGHT, WIDTH, 3)
    assert raw[5, 600, 0] == round(255 * 600.5 / WIDTH)
    cameras, rows = closeups(large, scene.gaussians, target, **SIZE)
    assert len(cameras) == len(rows) > 6
    points = scene.gaussians.means[target.rows].astype(np.float64)
    for view, frame in enumerate(rows):
        picture = photograph_of(scene.views, int(frame), cameras, view).astype(np.float64)
        assert picture.shape == (240, 320, 3)
        at = places(cameras, view, points)
        shown = ((at > 2) & (at < np.array([318, 238]))).all(axis=1)
        assert shown.mean() > 0.9
        column, row = at[shown].astype(int).T
        color = picture[row, column]
        wanted = places(scene.views.cameras, int(frame), points[shown]) / (64, 48) * 255
        assert np.abs(color[:, :2] - wanted).max() < 2
        assert (color[:, 2] == 20 * frame).all()


def test_windows_keep_their_shape_stay_in_the_frame_and_leave_room_around_the_target() -> None:
    scene, target = photographed()
    large = photograph_cameras(scene.views)
    for shape in ((320, 240), (200, 400)):
        cameras, rows = closeups(large, scene.gaussians, target, width=shape[0], height=shape[1])
        assert len(rows)
        zoom = large.Ks[rows][:, [0, 1], [0, 1]] / cameras.Ks[:, [0, 1], [0, 1]]
        assert np.allclose(zoom[:, 0], zoom[:, 1], rtol=1e-5)
        begins = large.Ks[rows][:, :2, 2] - zoom * cameras.Ks[:, :2, 2]
        size = zoom * shape
        assert (begins > -0.01).all()
        assert (begins + size < np.array([WIDTH, HEIGHT]) + 0.01).all()
        assert (size[:, 0] >= CONSTANTS.min_closeup_width * 0.999).all()
        assert (size <= CONSTANTS.max_closeup_share * np.array([WIDTH, HEIGHT]) * 1.001).all()
        for view in range(len(rows)):
            at = places(cameras, view, scene.gaussians.means[target.rows].astype(np.float64))
            # Half of the target's size on every side: it takes half of the picture along one axis at most.
            assert np.ptp(at, axis=0)[0] <= 0.501 * shape[0]
            assert np.ptp(at, axis=0)[1] <= 0.501 * shape[1]


def test_only_what_is_clearly_closer_is_cut() -> None:
    scene, target = photographed()
    # So few pixels that any window would be most of the frame.
    small, none = closeups(scene.views.cameras, scene.gaussians, target, **SIZE)
    assert len(small) == len(none) == 0
    everything = target_of("room", scene.gaussians, np.arange(len(scene.gaussians)))
    assert not len(closeups(photograph_cameras(scene.views), scene.gaussians, everything, **SIZE)[0])
    turned = corner_cameras().cam_from_world.copy()
    turned[:, :3] *= np.array([-1, 1, -1], np.float32)[:, None]
    away = replace(photograph_cameras(scene.views), cam_from_world=turned)
    assert not len(closeups(away, scene.gaussians, target, **SIZE)[0])


@pytest.mark.parametrize(("source", "candidates"), [("frames", 8), ("both", 24)])
def test_close_ups_are_chosen_where_there_are_photographs_and_nowhere_else(source: str, candidates: int) -> None:
    scene, target = photographed()
    config = ViewsConfig(source=source, candidates=candidates, count=6, **SIZE)
    views = choose_views(scene, [target], config)
    assert views.judged <= candidates
    near = [number for number, each in enumerate(views.chosen) if each.name.endswith(" near cube")]
    assert near
    kinds, (pictures, _) = picture_kinds(scene, views), view_pictures(scene, views)
    for number in near:
        frame = views.chosen[number].frame
        assert views.chosen[number].name == f"{scene.views.names[frame]} near cube"
        assert kinds[number] == "photograph"
        assert (pictures[number][..., 2] == 20 * frame).all()
        assert (views.cameras.cam_from_world[number] == scene.views.cameras.cam_from_world[frame]).all()
    bare = choose_views(replace(scene, views=replace(scene.views, images=None)), [target], config)
    assert not any("near" in each.name for each in bare.chosen)
    if source == "frames":
        shares = [max(each.target_scores[0].share for each in chosen.chosen) for chosen in (views, bare)]
        assert shares[0] > 2 * shares[1]


def test_several_targets_share_the_close_ups() -> None:
    scene, target = photographed()
    wall = np.flatnonzero(np.abs(scene.gaussians.means - np.array([2, 0, 1.2], np.float32)).max(axis=1) < 0.2)
    both = [target, target_of("patch", scene.gaussians, wall)]
    views = choose_views(scene, both, ViewsConfig(source="frames", candidates=24, count=12, **SIZE))
    names = " ".join(each.name for each in views.chosen)
    assert "near cube" in names
    assert "near patch" in names
    assert views.judged <= 24
    # With hardly any candidates whole frames come first.
    few = choose_views(scene, both, ViewsConfig(source="frames", candidates=3, count=3, **SIZE))
    assert not any("near" in each.name for each in few.chosen)
