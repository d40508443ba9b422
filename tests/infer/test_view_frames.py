"""Which frames of a recording are candidates."""

from dataclasses import replace

import numpy as np
import pytest
from rooms import UP, corner_cameras, cube
from viewed_targets import SHELLS, around, cube_in_room, joined

from gsencoder.data.orbits import looking_cameras
from gsencoder.infer.views.candidates import FreeSpace, frames_on
from gsencoder.infer.views.choose import choose_views
from gsencoder.infer.views.targets import target_of

pytestmark = pytest.mark.slow


def test_frames_that_would_show_most_are_taken_first() -> None:
    scene, target = cube_in_room()
    free = FreeSpace(scene.gaussians).without(target.rows)
    middle = corner_cameras(6)
    outward = middle.centers / np.linalg.norm(middle.centers, axis=1, keepdims=True)
    behind = looking_cameras(middle.centers, outward, UP, 40.0, 64, 48)
    both = joined(behind, middle)
    assert frames_on(both, scene.gaussians, [target], 6, [free]).tolist() == list(range(6, 12))
    assert frames_on(both, scene.gaussians, [target], 99, [free]).tolist() == list(range(12))


def test_frames_that_look_at_a_wall_are_taken_last_however_near_the_target_is_behind_it() -> None:
    scene, target = cube_in_room()
    # Next door, nearer to the cube than the cameras of the room are, and pointed at it.
    next_door = around(np.array([0.3, 0.2, 0.8]), np.full(20, 2.4), np.linspace(-0.4, 0.4, 20))
    cameras = joined(next_door, corner_cameras())
    free = FreeSpace(scene.gaussians).without(target.rows)
    assert (frames_on(cameras, scene.gaussians, [target], 6, [free]) >= 20).all()
    names = tuple(f"{number:02d}" for number in range(len(cameras)))
    both = replace(scene, views=replace(scene.views, cameras=cameras, names=names))
    for source in ("frames", "both"):
        chosen = choose_views(both, [target], replace(SHELLS, source=source))
        assert all(each.target_scores[0].visible > 0.5 for each in chosen.chosen)


def test_frames_of_a_film_are_taken_from_all_along_it() -> None:
    scene, target = cube_in_room()
    turns = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    film = around(np.array([0.3, 0.2, 0.8]), 1.0 + 0.3 * np.abs(turns - np.pi) / np.pi, turns)
    free = FreeSpace(scene.gaussians).without(target.rows)
    frames = frames_on(film, scene.gaussians, [target], 16, [free])
    assert len(frames) == 16
    assert len(np.unique(frames)) == 16
    # The nearest stand together on one side.
    assert np.ptp(turns[frames]) > 0.8


def test_targets_take_turns_at_the_frames() -> None:
    scene, target = cube_in_room(cube((-1.2, -1.2, 0.5), half=0.5))
    large = target_of("crate", scene.gaussians, np.arange(len(scene.gaussians) - 5000, len(scene.gaussians)))
    at = np.linspace(0, 6, 20)
    cameras = joined(around(large.center, np.full(20, 1.2), at), around(target.center, np.full(20, 1.2), at))
    free = FreeSpace(scene.gaussians)
    spaces = [free.without(each.rows) for each in (large, target)]
    frames = frames_on(cameras, scene.gaussians, [large, target], 8, spaces)
    assert len(frames) == 8
    for each, space in zip((large, target), spaces, strict=True):
        (best,) = frames_on(cameras, scene.gaussians, [each], 1, [space])
        assert best in frames
