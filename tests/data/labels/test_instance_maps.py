"""Instance maps of labeled meshes at their limits, and what is counted in them."""

import numpy as np
import pytest
from splats import front_camera, random_gaussians

from gsencoder.data.labels.mesh import MeshInstances, draw_instances
from gsencoder.data.labels.scans import with_counted_views
from gsencoder.types import MeshLabels, Scene, SceneObject, Views


@pytest.mark.parametrize(
    ("sensor", "seen"),
    [
        # The mesh is at 4 m, where a twentieth of the sensor's depth is more than 0.1 m.
        (0.0, True),
        (4.21, True),
        (4.22, False),
        (3.81, True),
        (3.80, False),
    ],
)
def test_the_sensor_may_differ_by_a_twentieth_of_its_depth_far_away(sensor: float, seen: bool) -> None:
    assert (instance_of_wall(4.0, sensor) == 1) is seen


@pytest.mark.parametrize(("sensor", "seen"), [(1.09, True), (1.11, False), (0.91, True), (0.89, False)])
def test_the_sensor_may_differ_by_a_tenth_of_a_metre_near_by(sensor: float, seen: bool) -> None:
    assert (instance_of_wall(1.0, sensor) == 1) is seen


@pytest.mark.parametrize(("depth", "drawn"), [(0.02, True), (0.009, False)])
def test_triangles_nearer_than_a_centimeter_are_not_drawn(depth: float, drawn: bool) -> None:
    assert (instance_of_wall(depth, 0.0) == 1) is drawn


def instance_of_wall(depth: float, sensor: float) -> int:
    """At the middle pixel of a camera before a wall, away from the world's origin."""
    origin = np.array([100.0, -50.0, 7.0])
    corners = np.array([[-9, -9, depth], [9, -9, depth], [9, 9, depth], [-9, 9, depth]]) + origin
    labels = MeshLabels(
        vertices=corners.astype(np.float32),
        instances=np.ones(4, np.int32),
        objects=((1, "wall"),),
        faces=np.array([[0, 1, 2], [0, 2, 3]], np.int32),
    )
    views = Views(cameras=front_camera(5, 3, 4.0), names=("a",), depths=[np.full((3, 5), sensor, np.float32)])
    instances = MeshInstances(labels, views, origin)[0]
    assert instances.shape == (3, 5)
    assert (instances == instances[1, 2]).all()
    return int(instances[1, 2])


def test_views_and_areas_are_counted_by_id_in_any_order_of_objects() -> None:
    first = np.array([[9, 9, 2], [9, 5, 0]], np.int32)
    second = np.array([[5, 5, 5], [7, 7, 2]], np.int32)
    corner = np.zeros(3)
    scene = Scene(
        name="s",
        gaussians=random_gaussians(1),
        views=Views(cameras=front_camera(3, 2).select([0, 0]), names=("a", "b"), instances=[first, second]),
        objects=tuple(
            SceneObject(id=number, name="x", aabb_min=corner, aabb_max=corner, views=None, max_pixels=None)
            for number in (9, 2, 11, 5)
        ),
    )
    counts = [(each.id, each.views, each.max_pixels) for each in with_counted_views(scene).objects]
    assert counts == [(9, 1, 3), (2, 2, 1), (11, 0, 0), (5, 2, 3)]


def test_each_pixel_has_the_object_of_the_vertex_that_is_nearest_on_the_triangle_itself() -> None:
    # One edge of a slanted triangle goes from z = 1 to z = 4: its middle is at z = 2.5, which a picture shows four
    # fifths of the way to the far end.
    vertices = np.array([[-1, 0, 1], [4, 0, 4], [-1, 50, 1]], np.float32)
    labels = MeshLabels(
        vertices=vertices,
        instances=np.array([1, 2, 3], np.int32),
        objects=((1, "a"), (2, "b"), (3, "c")),
        faces=np.array([[0, 1, 2]], np.int32),
    )
    K = np.array([[50, 0, 50], [0, 50, 0], [0, 0, 1]], np.float64)
    instances, depth = draw_instances(labels, np.eye(4), K, 101, 3)
    # The middle (1.5, 0, 2.5) projects to 50 + 50 · 0.6 = 80.
    assert instances[0, 1:79].tolist() == [1] * 78
    assert instances[0, 81:99].tolist() == [2] * 18
    # At pixel column c, x / z = (c + 0.5 - 50) / 50 = r on the line x = -1 + 5 s, z = 1 + 3 s.
    r = (np.arange(1, 99) + 0.5 - 50) / 50
    s = (1 + r) / (5 - 3 * r)
    np.testing.assert_allclose(depth[0, 1:99], 1 + 3 * s, rtol=0.02)


def test_triangles_with_a_common_edge_leave_no_pixel_between_them() -> None:
    """Squares cut along a diagonal that goes through many centers of pixels, and along others."""
    rng = np.random.default_rng(0)
    K = np.array([[10, 0, 10], [0, 10, 10], [0, 0, 1]], np.float64)
    for depth in (0.02, 0.7, 1.0, 3.3):
        for turn in (0, 1):
            size = 9 if turn == 0 else float(rng.uniform(5, 20))
            corners = np.array([[-size, -size, depth], [size, -size, depth], [size, size, depth], [-size, size, depth]])
            labels = MeshLabels(
                vertices=np.roll(corners, turn, axis=0).astype(np.float32),
                instances=np.ones(4, np.int32),
                objects=((1, "wall"),),
                faces=np.array([[0, 1, 2], [0, 2, 3]], np.int32),
            )
            assert draw_instances(labels, np.eye(4), K, 20, 20)[0].all()
