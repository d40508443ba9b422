"""Pixels of true objects in pictures: of instance maps, whole, cut and resized, and of labeled Gaussians."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scripted_answerer import PictureTruth

from gsencoder.core.errors import InputError
from gsencoder.data.synthetic import make_room
from gsencoder.types import Scene
from gsencoder.types.checks import move_origin

ORIGIN = np.array([1000.0, -2000.0, 0.0])


@pytest.fixture(scope="module")
def room() -> Scene:
    """Away from the origin of the world."""
    room = make_room(0, views=6, width=80, height=60)
    moved = tuple(
        replace(each, aabb_min=each.aabb_min + ORIGIN, aabb_max=each.aabb_max + ORIGIN) for each in room.objects
    )
    return replace(room, origin=ORIGIN, objects=moved)


@pytest.fixture(scope="module")
def truth(room: Scene) -> PictureTruth:
    return PictureTruth(room, room)


def row(room: Scene, frame: int, kind: str, window: tuple[float, float, float, float] | None = None) -> dict[str, Any]:
    """A view in a frame's place, of all of it or of a window (left, upper, width, height) shown 80 × 60."""
    assert room.views is not None
    cameras = room.views.cameras
    K = cameras.Ks[frame].astype(np.float64)
    if window is not None:
        K[:2, 2] -= window[:2]
        K[:2] *= (np.array([80, 60]) / window[2:])[:, None]
    pose = move_origin(cameras.cam_from_world[frame].astype(np.float64), -room.origin)
    size = {"width": 80, "height": 60}
    return {"kind": kind, "frame": frame, "cam_from_world": pose.tolist(), "K": K.tolist(), **size}


def counts(labels: np.ndarray) -> dict[int, int]:
    values, pixels = np.unique(labels, return_counts=True)
    return {int(value): int(count) for value, count in zip(values, pixels, strict=True) if value}


def test_a_whole_photograph_has_the_pixels_of_its_instance_map(room: Scene, truth: PictureTruth) -> None:
    assert room.views is not None
    assert room.views.instances is not None
    for frame in (0, 3):
        assert truth.pixels(row(room, frame, "photograph")) == counts(room.views.instances[frame])


def test_a_close_up_has_those_of_its_window_as_large_as_it_is_shown(room: Scene, truth: PictureTruth) -> None:
    assert room.views is not None
    assert room.views.instances is not None
    part = room.views.instances[1][15:45, 20:60]
    expected = {label: 4 * count for label, count in counts(part).items()}
    assert truth.pixels(row(room, 1, "photograph", (20, 15, 40, 30))) == expected


def test_a_render_shows_nearly_what_a_photograph_from_there_would(room: Scene, truth: PictureTruth) -> None:
    assert room.views is not None
    assert room.views.instances is not None
    photographed = counts(room.views.instances[2])
    rendered = truth.pixels(row(room, 2, "render"))
    apart = [abs(rendered.get(label, 0) - count) for label, count in photographed.items()]
    assert sum(apart) <= 0.1 * sum(photographed.values())
    assert set(rendered) <= {each.id for each in room.objects}
    assert {label for label, count in photographed.items() if count >= 40} <= set(rendered)


def test_a_box_is_of_the_instance_that_it_holds_best(room: Scene, truth: PictureTruth) -> None:
    for each in room.objects:
        if each.placed and each.max_pixels >= 60:
            assert truth.instance_in(each.aabb_min.tolist(), each.aabb_max.tolist()) == each.id
    assert truth.instance_in([0.0, 0.0, 0.0], [1.0, 1.0, 1.0]) == 0


def test_scenes_without_what_is_needed_are_refused(room: Scene) -> None:
    assert room.views is not None
    renamed = replace(room, views=replace(room.views, names=tuple(f"other {view}" for view in range(6))))
    for scene, labeled, problem in (
        (replace(room, gaussians=None), room, "no Gaussians or no cameras"),
        (replace(room, views=None), room, "no Gaussians or no cameras"),
        (room, replace(room, views=replace(room.views, instances=None)), "no instance maps"),
        (room, renamed, "no instance map of view"),
    ):
        with pytest.raises(InputError, match=problem):
            PictureTruth(scene, labeled)
