"""Holes that objects leave: pixels that were opaque and are no longer, and their area at the depth that they had."""

from dataclasses import replace

import numpy as np
import pytest
from selected_rooms import selected_room, splat_of

from gsencoder.data.orbits import looking_cameras
from gsencoder.infer.select import find_holes, sample_views
from gsencoder.types import Cameras, Gaussians

SIDE = np.arange(-0.2, 0.2001, 0.01)
SQUARE = np.stack([*np.meshgrid(SIDE, SIDE), np.zeros((41, 41))], axis=-1).reshape(-1, 3)
DOWN, NORTH = np.array([[0.0, 0.0, -1.0]]), np.array([0.0, 1.0, 0.0])


def above(*heights: float, turned: bool = False) -> Cameras:
    """Cameras above the middle of the square that look down at it, or up and away from it."""
    eyes = np.array([[0.0, 0.0, height] for height in heights])
    return looking_cameras(eyes, np.repeat(-DOWN if turned else DOWN, len(eyes), axis=0), NORTH, 100.0, 100, 80)


def square_splat() -> Gaussians:
    return replace(splat_of(SQUARE), scales=np.full((len(SQUARE), 3), 0.006, np.float32))


TAKEN = SQUARE[:, 0] > -0.199


def test_a_hole_is_what_was_opaque_and_is_not_with_its_area_at_the_depth_that_it_had() -> None:
    wall = np.stack([*np.meshgrid(SIDE * 6, SIDE * 6), np.full((41, 41), -0.5)], axis=-1).reshape(-1, 3)
    camera = above(1.0)
    every = sample_views(camera, 1)
    (hole,) = find_holes(square_splat(), camera, TAKEN, every)
    # Seen from above, 0.4 × 0.4 units; the Gaussians at the edge reach a little beyond.
    assert hole.area == pytest.approx(0.16, rel=0.1)
    assert hole.pixels == pytest.approx(1600, rel=0.1)
    assert hole.pixels * 1e-4 == pytest.approx(hole.area, rel=1e-3)
    behind = splat_of(np.concatenate([SQUARE, wall]))
    behind = replace(behind, scales=np.repeat(np.float32([[0.006], [0.06]]), len(SQUARE), axis=0).repeat(3, axis=1))
    removed = np.arange(len(behind)) < len(SQUARE)
    (covered,) = find_holes(behind, camera, removed, every)
    assert covered.pixels == 0
    assert covered.area == 0
    assert covered.removed == pytest.approx(1700, rel=0.1)
    assert find_holes(behind, camera, np.zeros(len(behind), bool), every) == []


@pytest.mark.parametrize(("height", "stretch"), [(0.8, 1.0), (2.0, 1.0), (1.0, 1.6)])
def test_the_area_of_a_hole_does_not_depend_on_the_camera_and_its_pixels_do(height: float, stretch: float) -> None:
    camera = above(height)
    Ks = camera.Ks.copy()
    Ks[:, 1, 1] *= stretch
    camera = replace(camera, Ks=Ks)
    (hole,) = find_holes(square_splat(), camera, TAKEN, sample_views(camera, 1))
    assert hole.area == pytest.approx(0.16, rel=0.12)
    assert hole.pixels == pytest.approx(1600 / height**2 * stretch, rel=0.12)


def test_a_hole_is_as_large_where_every_third_pixel_is_looked_at() -> None:
    camera = above(1.0)
    sparse = sample_views(camera, 1, 1000)
    assert sparse == [(0, 3)]
    (hole,) = find_holes(square_splat(), camera, TAKEN, sparse)
    assert hole.area == pytest.approx(0.16, rel=0.15)
    assert hole.pixels == pytest.approx(1600, rel=0.15)
    assert hole.removed == pytest.approx(1600, rel=0.15)


def test_holes_have_the_numbers_of_their_views_and_views_without_the_object_have_none() -> None:
    away, down = above(1.0, turned=True), above(1.0, 2.0)
    cameras = Cameras(
        cam_from_world=np.concatenate([away.cam_from_world, down.cam_from_world]),
        Ks=np.concatenate([away.Ks, down.Ks]),
        widths=np.concatenate([away.widths, down.widths]),
        heights=np.concatenate([away.heights, down.heights]),
    )
    holes = find_holes(square_splat(), cameras, TAKEN, sample_views(cameras, 3))
    assert [hole.view for hole in holes] == [1, 2]


@pytest.mark.parametrize(("opacities", "opens"), [((0.45, 0.2), True), ((0.2, 0.45), False), ((0.3, 0.1), None)])
def test_a_pixel_is_of_what_more_than_half_of_its_opacity_is_of(
    opacities: tuple[float, float], opens: bool | None
) -> None:
    """A wide half-transparent Gaussian that is removed before another one that is not."""
    gaussians = splat_of(np.array([[0.0, 0.0, 0.1], [0.0, 0.0, 0.0]]), np.float32(opacities))
    gaussians = replace(gaussians, scales=np.full((2, 3), (2.0, 2.0, 0.01), np.float32))
    camera = above(1.0)
    holes = find_holes(gaussians, camera, np.array([True, False]), sample_views(camera, 1))
    if opens:
        assert holes[0].pixels > 1000
    else:
        # The first is not most of the pixels, or both together are not opaque.
        assert holes == []


def test_a_mug_on_a_table_that_ends_below_it_leaves_a_hole() -> None:
    open_table, kinds = selected_room(under=False)
    closed_table, closed_kinds = selected_room()
    assert open_table.gaussians is not None
    assert open_table.views is not None
    assert closed_table.gaussians is not None
    cameras = open_table.views.cameras
    every = sample_views(cameras, 8)
    holes = find_holes(open_table.gaussians, cameras, kinds == 0, every)
    assert sum(hole.pixels for hole in holes) > 100
    closed = find_holes(closed_table.gaussians, cameras, closed_kinds == 0, every)
    assert sum(hole.pixels for hole in closed) < 0.1 * sum(hole.pixels for hole in holes)
