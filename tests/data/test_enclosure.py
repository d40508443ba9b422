"""Rooms and objects are told apart by their free space; surfaces from Gaussians, planes and depth."""

from dataclasses import fields, replace

import numpy as np
import pytest
from scene_files import some_gaussians
from scipy.spatial.transform import Rotation
from splats import front_camera

from gsencoder.data.enclosure import (
    MIN_GAUSSIANS,
    Enclosure,
    enclosure_of,
    planes_of_gaussians,
    surfaces_of_depth,
    surfaces_of_gaussians,
)
from gsencoder.data.seeding.points import flat_gaussians
from gsencoder.data.up import turn, with_up
from gsencoder.fusion.cameras import with_views
from gsencoder.types import Gaussians, Scene, Views

Box = tuple[tuple[float, float, float], tuple[float, float, float]]
BOARDS = {
    "chair": [
        ((0, 0, 0.45), (0.45, 0.45, 0.49)),
        ((0, 0.41, 0.45), (0.45, 0.45, 0.95)),
        *(((x, y, 0), (x + 0.04, y + 0.04, 0.45)) for x in (0, 0.41) for y in (0, 0.41)),
    ],
    "box": [((0, 0, 0), (0.3, 0.2, 0.12))],
    "sheet": [((0, 0, 0), (2.0, 1.4, 0.02))],
}
"""Objects: low and high corners of boards."""
FURNITURE = [((0.1, 0.1, 0), (0.7, 2.0, 0.5)), ((1.6, 1.4, 0), (2.6, 2.2, 0.75)), ((3.4, 0.1, 0), (4.0, 0.6, 1.8))]


def sides(low: np.ndarray, high: np.ndarray, spacing: float, left_out: tuple[int, ...] = ()) -> list[np.ndarray]:
    """Points and normals, as rows of six, on the sides of a box but some of (x low, x high, y low, …)."""
    generator, size, rows = np.random.default_rng(0), high - low, []
    for number in range(6):
        if number not in left_out:
            axis, end = divmod(number, 2)
            points = generator.uniform(0, 1, (int(np.delete(size, axis).prod() / spacing**2) + 1, 3))
            points[:, axis] = end
            normals = np.broadcast_to((2 * end - 1) * np.eye(3)[axis], points.shape)
            rows.append(np.concatenate((low + points * size, normals), axis=1))
    return rows


def splat(rows: list[np.ndarray]) -> Gaussians:
    both = np.concatenate(rows).astype(np.float32)
    return flat_gaussians(both[:, :3], both[:, 3:], np.full((len(both), 3), 0.5, np.float32), largest=0.1)


def room() -> Gaussians:
    """Floor and two walls, as a scan has them that nobody completed, with three pieces of furniture."""
    rows = sides(np.zeros(3), np.array([6.0, 5.0, 1.6]), 0.06, left_out=(1, 3, 5))
    for low, high in FURNITURE:
        rows += sides(np.array(low), np.array(high), 0.045)
    return splat(rows)


def made_object(name: str) -> Gaussians:
    corners = [(np.array(low, float), np.array(high, float)) for low, high in BOARDS[name]]
    area = sum(2 * (np.prod(d) * (1 / d).sum()) for d in (high - low for low, high in corners))
    return splat([each for low, high in corners for each in sides(low, high, np.sqrt(area / 8000))])


def moved(gaussians: Gaussians, number: int) -> Gaussians:
    rotation, size = Rotation.random(random_state=number), 10.0 ** (number - 1)
    quats = (rotation * Rotation.from_quat(gaussians.quats, scalar_first=True)).as_quat(scalar_first=True)
    means = size * rotation.apply(gaussians.means) + [3, -7, 20 * number]
    scales = size * gaussians.scales
    means, quats, scales = (array.astype(np.float32) for array in (means, quats, scales))
    return replace(gaussians, means=means, quats=quats, scales=scales)


def denser(gaussians: Gaussians) -> Gaussians:
    """Four overlapping Gaussians for each one in half of the scene, beside each other within its disc."""
    half = gaussians.means[:, 0] < np.median(gaussians.means[:, 0])
    rows = np.concatenate((np.repeat(np.flatnonzero(half), 4), np.flatnonzero(~half)))
    made = gaussians.select(rows)
    shift = np.random.default_rng(1).normal(size=made.means.shape) * made.scales
    turned = Rotation.from_quat(made.quats, scalar_first=True).apply(shift)
    return replace(made, means=(made.means + turned).astype(np.float32))


@pytest.mark.parametrize("number", [0, 2])
def test_a_room_stays_a_room_wherever_it_lies_and_however_large_it_is(number):
    first, second = enclosure_of(room()), enclosure_of(moved(room(), number))
    assert first.is_room
    assert second.is_room
    dense = enclosure_of(denser(room()))
    assert dense.is_room
    assert dense.openness == pytest.approx(first.openness, abs=0.03)
    for field in fields(Enclosure):
        assert getattr(second, field.name) == pytest.approx(getattr(first, field.name), abs=0.12), field.name


@pytest.mark.parametrize("name", list(BOARDS))
def test_an_object_stays_an_object_turned_enlarged_and_denser_in_one_half(name):
    gaussians = made_object(name)
    assert not any(enclosure_of(each).is_room for each in (gaussians, moved(gaussians, 2), denser(gaussians)))


@pytest.mark.parametrize(("axis", "sign"), [(0, -1), (1, 1)])
def test_two_thirds_of_a_room_are_a_room_and_half_of_a_box_is_none(axis, sign):
    def part(gaussians: Gaussians, share: float) -> Gaussians:
        values = sign * gaussians.means[:, axis]
        return gaussians.select(np.flatnonzero(values < np.quantile(values, share)))

    assert enclosure_of(part(room(), 0.67)).is_room
    assert not enclosure_of(part(made_object("box"), 0.6)).is_room


@pytest.mark.parametrize(
    ("change", "is_room"),
    [
        ({}, True),
        ({"adjacent": 0.82}, False),
        ({"space": 0.27}, False),
        ({"openness": 0.3}, False),
        ({"flatness": 0.56}, False),
        ({"content": 0.09}, False),
        ({"content": 0.09, "space": 0.44}, True),
        ({"content": 0.005, "space": 0.44}, False),
        ({"enough": False}, False),
    ],
)
def test_every_sign_of_a_room_with_walls_is_needed(change, is_room):
    walls = Enclosure(flatness=0.4, openness=0.35, space=0.4, adjacent=0.9, content=0.15)
    assert replace(walls, **change).is_room == is_room


@pytest.mark.parametrize(
    ("change", "is_room"),
    [
        ({}, True),
        ({"adjacent": 0.64}, False),
        ({"space": 0.57}, False),
        ({"openness": 0.23}, False),
        ({"content": 0.024}, False),
        ({"enough": False}, False),
    ],
)
def test_a_room_whose_free_space_is_most_of_it_may_be_as_high_as_it_is_wide(change, is_room):
    bathroom = Enclosure(flatness=0.97, openness=0.36, space=0.8, adjacent=0.8, content=0.05)
    assert replace(bathroom, **change).is_room == is_room


def bathroom() -> list[np.ndarray]:
    """Floor, walls and ceiling, about as high as wide, and three things on the floor."""
    things = [((0.05, 0.05, 0), (0.75, 1.7, 0.55)), ((1.5, 0.1, 0), (2.0, 0.6, 0.85)), ((1.5, 1.3, 0), (1.9, 1.9, 0.8))]
    rows = sides(np.zeros(3), np.array([2.2, 2.0, 2.3]), 0.04)
    for low, high in things:
        rows += sides(np.array(low), np.array(high), 0.04)
    return rows


def test_a_bathroom_with_a_ceiling_is_a_room_and_the_same_without_its_furniture_is_none():
    assert enclosure_of(splat(bathroom())).is_room
    assert not enclosure_of(splat(bathroom()[:6])).is_room


@pytest.mark.parametrize("up", [(0, -1, 0), (0, 1, 0)])
def test_what_stands_on_the_floor_tells_it_from_a_ceiling_that_is_as_large(up):
    to_from = Rotation.align_vectors([up], [[0, 0, 1]])[0].as_matrix()
    scene = Scene(name="bathroom", gaussians=turn(splat(bathroom()), to_from, 1.0))
    assert with_up(scene)[1].direction @ up > 0.99


def test_few_gaussians_show_no_room():
    gaussians = room()
    few = gaussians.select(np.linspace(0, len(gaussians) - 1, MIN_GAUSSIANS - 1).astype(int))
    assert not enclosure_of(few).is_room
    assert "fewer than 4,000" in enclosure_of(few).reason


def test_what_was_decided_is_said_and_an_object_has_no_up_of_its_own():
    scene, up = with_up(Scene(name="chair", gaussians=made_object("chair")))
    assert up is None
    seen, reason = with_views(scene, 12)
    assert seen.views.names[0] == "orbit_000"
    assert "no free space borders most of its surfaces" in reason
    # No direction is up, so that cameras surround it on all sides.
    directions = seen.views.cameras.centers - scene.gaussians.means.mean(axis=0)  # type: ignore[union-attr]
    assert (directions.max(axis=0) > 0.3).all()
    assert (directions.min(axis=0) < -0.3).all()


def test_surfaces_of_gaussians_are_their_thin_axes_and_areas_count_opacity():
    rotations = Rotation.random(3, random_state=0)
    scales = np.array([[0.01, 0.2, 0.3], [0.2, 0.01, 0.5], [0.2, 0.3, 0.11]], np.float32)
    some = some_gaussians(np.arange(9.0).reshape(3, 3), np.array([0.5, 1.0, 1.0]))
    some = replace(some, quats=rotations.as_quat(scalar_first=True).astype(np.float32), scales=scales)
    surfaces = surfaces_of_gaussians(some)
    order = np.argsort(surfaces.means[:, 0])
    # The third is thicker than half of its middle axis.
    np.testing.assert_allclose(surfaces.means[order], some.means[:2])
    axes = rotations.as_matrix()
    for row, axis in ((0, axes[0][:, 0]), (1, axes[1][:, 1])):
        assert abs(surfaces.normals[order][row] @ axis) == pytest.approx(1, abs=1e-6)
    np.testing.assert_allclose(surfaces.areas[order], (0.2 * 0.3 * 0.5, 0.2 * 0.5), rtol=1e-6)


def test_areas_of_depth_samples_are_those_of_the_surfaces():
    """Of a plane across the view, seen by all pixels, z² / (fx fy) each; of a slanted one more by its cosine."""
    width, height, focal = 64, 48, 60.0
    cameras = front_camera(width, height, focal)
    columns = np.tile((np.arange(width) + 0.5 - 32) / focal, (height, 1))
    for slope in (0.0, 1.0):
        depth = (2 / (1 - slope * columns)).astype(np.float32)
        views = Views(cameras=cameras, names=("a",), depths=[depth])
        surfaces = surfaces_of_depth(views)
        normal = np.array([slope, 0, -1]) / np.hypot(1, slope)
        np.testing.assert_allclose(np.abs(surfaces.normals @ normal), 1, atol=1e-3)
        z = surfaces.means[:, 2]
        rays = surfaces.means / z[:, None]
        exact = z**2 / focal**2 / np.abs(rays @ normal) * np.linalg.norm(rays, axis=1)
        np.testing.assert_allclose(surfaces.areas, exact, rtol=0.01)
        np.testing.assert_allclose(z, 2 + slope * surfaces.means[:, 0], rtol=2e-3)


def cloud(means: np.ndarray, opacity: float = 1.0) -> Gaussians:
    return some_gaussians(means, np.full(len(means), opacity))


def test_planes_through_means_are_those_that_the_means_lie_on():
    made = np.random.default_rng(0)
    rotation = Rotation.random(random_state=1).as_matrix()
    flat = np.concatenate((made.uniform(0, 1, (2000, 2)), made.normal(0, 1e-3, (2000, 1))), axis=1)
    surfaces = planes_of_gaussians(cloud(flat @ rotation.T))
    assert len(surfaces.normals) == 2000
    assert surfaces.rest == 0
    assert np.abs(surfaces.normals @ rotation[:, 2]).min() > 0.99
    ball = made.normal(size=(2000, 3))
    surfaces = planes_of_gaussians(cloud(ball))
    assert surfaces.rest > 10 * surfaces.areas.sum()


def test_areas_of_planes_grow_with_the_square_of_the_spacing_and_lone_means_do_not_outvote():
    made = np.random.default_rng(0)
    dense = np.concatenate((made.uniform(0, 1, (3000, 2)), np.zeros((3000, 1))), axis=1)
    once, wide = planes_of_gaussians(cloud(dense)), planes_of_gaussians(cloud(3 * dense))
    assert wide.areas.sum() == pytest.approx(9 * once.areas.sum(), rel=1e-4)
    lone = planes_of_gaussians(cloud(np.concatenate((dense, [[1e4, 0, 0], [0, 1e4, 0]]))))
    assert lone.areas.max() < 3 * once.areas.max()


def test_faint_few_and_coincident_gaussians_have_no_planes():
    made = np.random.default_rng(0)
    flat = np.concatenate((made.uniform(0, 1, (100, 2)), np.zeros((100, 1))), axis=1)
    for gaussians in (cloud(flat, 0.2), cloud(flat[:31]), cloud(np.zeros((100, 3)))):
        surfaces = planes_of_gaussians(gaussians)
        assert len(surfaces.areas) == len(surfaces.normals) == len(surfaces.means) == 0
    assert len(planes_of_gaussians(cloud(flat[:32])).areas) == 32
