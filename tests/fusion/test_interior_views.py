"""Cameras inside a bare splat: in the room of a room, and nowhere in an object."""

from dataclasses import replace

import numpy as np
import pytest
from rooms import UP, merged
from splats import gaussians_at

from gsencoder.core.errors import InputError
from gsencoder.fusion.cameras import _cover, interior_views, with_views
from gsencoder.types import Gaussians, Scene


@pytest.fixture(autouse=True)
def _fewer_positions(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsencoder.fusion.cameras.POSITIONS", 24)


def box_of_discs(rng: np.random.Generator, size: tuple[float, float, float], count: int = 6000) -> Gaussians:
    """Flat Gaussians on the six sides of a box around the origin."""
    half = np.array(size) / 2
    areas = half.prod() / half
    axis = rng.choice(3, count, p=areas / areas.sum())
    means = rng.uniform(-half, half, (count, 3))
    rows = np.arange(count)
    means[rows, axis] = half[axis] * rng.choice([-1, 1], count)
    scales = np.full((count, 3), 0.08)
    scales[rows, axis] = 0.002
    return gaussians_at(means, scales, 0.9)


@pytest.mark.parametrize("up", [None, UP])
def test_a_room_is_seen_from_inside(rng: np.random.Generator, up: np.ndarray | None) -> None:
    room = box_of_discs(rng, (5.0, 4.0, 2.5))
    made = interior_views(room, 12, up=up)
    assert made.covered > 0.9
    assert made.filled > 0.9
    assert (np.abs(made.cameras.centers) < [2.5, 2.0, 1.25]).all()
    if up is not None:
        # Level: the right axis of each camera is horizontal.
        np.testing.assert_allclose(made.cameras.cam_from_world[:, 0, 2], 0, atol=1e-6)


def test_an_object_is_seen_from_around(rng: np.random.Generator) -> None:
    """A ball of Gaussians, which leaves no room inside."""
    count = 4000
    ball = rng.normal(size=(count, 3))
    ball *= rng.uniform(0, 1, (count, 1)) ** (1 / 3) / np.linalg.norm(ball, axis=1, keepdims=True)
    gaussians = replace(box_of_discs(rng, (1, 1, 1), count), means=ball.astype(np.float32))
    made = interior_views(gaussians, 8)
    assert made is None or made.covered < 0.2
    scene = Scene(name="ball", gaussians=gaussians)
    views = with_views(scene, 8)[0].views
    assert views.names[0] == "orbit_000"


def test_a_splat_without_any_room_refuses_cameras_inside(rng: np.random.Generator) -> None:
    point = Scene(name="point", gaussians=box_of_discs(rng, (1, 1, 1)).select(np.array([0])))
    with pytest.raises(InputError, match="cameras=inside: no camera in point"):
        with_views(point, 8, cameras="inside")


def test_where_cameras_stand_can_be_stated(rng: np.random.Generator) -> None:
    walls, shelf = box_of_discs(rng, (5.0, 4.0, 2.5)), box_of_discs(rng, (2.0, 0.02, 1.5), 400)
    shelf = replace(shelf, means=shelf.means + np.float32([0.3, 0.4, -0.4]))
    scene = Scene(name="room", gaussians=merged(walls, shelf), up=UP)
    for cameras, begin in (("auto", "inside_000"), ("inside", "inside_000"), ("around", "orbit_000")):
        views = with_views(scene, 6, cameras=cameras)[0].views  # type: ignore[arg-type]
        assert views.names[0] == begin
        assert len(views) <= 6


def test_the_next_camera_is_the_one_that_shows_most_of_what_is_not_covered_yet() -> None:
    shares, weights = np.array([[0, 0.03], [0.05, 0], [0.05, 0], [0, 0]]), np.array([0.6, 0.4])
    assert _cover(shares, weights, 2) == [1, 0]
    # A camera that shows nothing is never chosen, and none twice.
    assert _cover(shares, weights, 9) == [1, 0, 2]
    assert _cover(np.zeros((3, 2)), weights, 2) == []


def test_nothing_opaque_has_no_inside(rng: np.random.Generator) -> None:
    room = box_of_discs(rng, (5.0, 4.0, 2.5))
    assert interior_views(replace(room, opacities=np.zeros(len(room), np.float32)), 5) is None
