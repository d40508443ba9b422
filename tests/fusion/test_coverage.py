"""What views see of a sample, against B; and the choice of views by what they show."""

from dataclasses import replace

import numpy as np
import pytest
from fixed_teachers import EXACT, FixedTeacher, make_scene

from gsencoder.fusion.fuse import fuse
from gsencoder.fusion.lift import VisibilityConfig, keep_visible
from gsencoder.fusion.view_coverage import (
    count_rays,
    covering_views,
    list_rays,
    near_rays,
    pixels_of,
    trace_sight,
    view_order,
)
from gsencoder.render import BlendConfig, blend

OPEN = VisibilityConfig(against=())


@pytest.mark.parametrize("depth", [False, True])
def test_rays_that_are_followed_have_the_weights_of_b(depth: bool, rng: np.random.Generator) -> None:
    depths = [rng.uniform(1.5, 3.0, (24, 32)).astype(np.float32) for _ in range(5)]
    scene = make_scene(n=400, **({"depths": depths} if depth else {}))
    assert scene.gaussians is not None
    assert scene.views is not None
    config = BlendConfig(stop_transmittance=1e-6)
    visibility = VisibilityConfig(against=("sensor",), relative=0.2) if depth else OPEN
    sight = trace_sight(scene.gaussians, scene.views, pixels_of(scene.views), visibility, config)
    assert sight.followed > 50
    for view, rays in enumerate(sight.rays):
        b = blend(scene.gaussians, scene.views.cameras, view, config=config)
        b = keep_visible(b, depths[view], visibility) if depth else b
        dense = np.zeros((b.rows, b.gaussians), np.float32)
        dense[np.repeat(np.arange(b.rows), b.crow.diff().numpy()), b.col.numpy()] = b.weight.numpy()
        owners = sight.sample[sight.singles :][rays.owners]
        np.testing.assert_allclose(rays.weights, dense[rays.rows, owners], rtol=1e-4, atol=1e-6)


def test_the_first_views_cover_most_and_one_that_adds_nothing_comes_last() -> None:
    weights = np.array([[1, 1, 0, 0, 0], [0, 0, 0, 0, 0], [1, 1, 1, 0, 0], [0, 0, 0, 1, 1]], np.float32)
    order = view_order(weights, 5, 0.05)
    assert order[0] == 2
    assert order[1] == 3
    assert order[-1] == 1


@pytest.mark.parametrize("weight", [0.01, 0.5, 1.0, 3.0])
def test_a_view_of_the_same_gaussians_comes_after_one_that_shows_another(weight: float) -> None:
    weights = weight * np.array([[1, 1, 1, 0], [1, 1, 1, 0], [0, 0, 0, 1]], np.float32)
    assert view_order(weights, 4, 0.05).tolist() == [0, 2, 1]


def test_views_by_coverage_see_more_than_evenly_spaced_ones() -> None:
    """All but two cameras stand together and look at one end; evenly spaced ones are of these."""
    scene = make_scene(n=600, count=9)
    assert scene.gaussians is not None
    assert scene.views is not None
    poses = scene.views.cameras.cam_from_world.copy()
    poses[:, 0, 3] = 2.0
    poses[[3, 5], 0, 3] = [0.0, -2.0]
    scene = replace(scene, views=replace(scene.views, cameras=replace(scene.views.cameras, cam_from_world=poses)))
    teacher = FixedTeacher([np.ones((6, 8, 6), np.float32)] * 9)
    even, covering = (
        fuse(scene, teacher, replace(EXACT, views=3, view_choice=choice)) for choice in ("even", "coverage")
    )
    assert covering.features.seen.sum() > even.features.seen.sum()
    assert {3, 5} <= set(covering.views)


def test_all_views_need_no_choice_and_rows_are_those_that_are_given() -> None:
    scene, teacher = make_scene(), FixedTeacher([np.ones((6, 8, 6), np.float32)] * 5)
    assert scene.gaussians is not None
    assert scene.views is not None
    assert covering_views(scene.gaussians, scene.views, OPEN, BlendConfig(), 9) == (0, 1, 2, 3, 4)
    of_rows, even = fuse(scene, teacher, EXACT, rows=(0, 2, 4)), fuse(scene, teacher, replace(EXACT, views=3))
    assert of_rows.views == even.views == (0, 2, 4)
    np.testing.assert_array_equal(of_rows.features.features, even.features.features)


def test_views_are_judged_by_gaussians_that_they_were_not_chosen_by() -> None:
    scene = make_scene(n=400)
    splat, views = scene.gaussians, scene.views
    assert splat is not None
    assert views is not None
    sight = trace_sight(splat, views, pixels_of(views), OPEN, BlendConfig(), size=100)
    choosing, judging = sight.halves()
    first, second = (set(each.sample[: each.singles].tolist()) for each in (choosing, judging))
    assert (len(first), len(second), first & second) == (50, 50, set())
    assert first | second == set(sight.sample[:100].tolist())
    for each in (choosing, judging):
        np.testing.assert_array_equal(each.sample[each.singles :], sight.sample[100:])
        columns = [sight.sample[:100].tolist().index(row) for row in each.sample[: each.singles]]
        np.testing.assert_array_equal(each.weights[:, : each.singles], sight.weights[:, columns])
        np.testing.assert_array_equal(each.areas[:, each.singles :], sight.areas[:, 100:])
    whole = trace_sight(splat, views, pixels_of(views), OPEN, BlendConfig())
    assert whole.complete
    assert whole.halves() == (whole, whole)


def test_rays_of_slanted_ellipses_are_those_within_them() -> None:
    """Counted against the inequality itself, at every pixel, of an ellipse whose axes are not the picture's."""
    a, b, c, r2, u, v = 0.3, 0.14, 0.2, 3.0, 20.3, 15.6
    projected = np.array([[u, v, 8.0, 8.0, a, b, c, r2]])
    side, width, height = 4, 10, 8
    index, depths = np.zeros(1, np.int64), np.array([2.0])
    least, most = np.zeros(width * height), np.full(width * height, 9.0)
    counts = np.zeros(1, np.int64)
    shape = (height, width, side)
    count_rays(projected, index, depths, least, most, shape, counts)
    y, x = np.mgrid[0 : height * side, 0 : width * side]
    dx, dy = x - u, y - v
    inside = (a * dx * dx + 2 * b * dx * dy + c * dy * dy <= r2) & (abs(dx) <= 8) & (abs(dy) <= 8)
    assert counts[0] == inside.sum() > 30
    rays, owners = np.zeros(999, np.int64), np.zeros(999, np.int64)
    total = list_rays(projected, index, depths, least, most, shape, counts, 999, rays, owners)
    assert set(rays[:total].tolist()) == set((y * width * side + x)[inside].tolist())
    # A sample is evenly spread over the list.
    some = np.zeros(999, np.int64)
    assert list_rays(projected, index, depths, least, most, shape, counts, 5, some, owners) == 5
    ranks = [rays[:total].tolist().index(each) for each in some[:5].tolist()]
    assert ranks == [(2 * k + 1) * total // 10 for k in range(5)]


def test_balls_that_a_ray_meets_are_near_it_in_pictures_of_unequal_steps() -> None:
    centers = np.array([[0.0, 0.0, 2.0], [0.0, 0.62, 2.0], [0.62, 0.0, 2.0], [0.0, 0.0, -1.0]])
    reaches = np.array([0.05, 0.05, 0.05, 0.05])
    K = np.array([[40.0, 0, 32.0], [0, 40.0, 32.0], [0, 0, 1]])
    for dx, dy in ((1.0, 1.0), (2.0, 4.0), (4.0, 2.0)):
        shape = (int(64 / dx / 8), int(64 / dy / 8))
        for number, (x, y, z) in enumerate(centers[:3]):
            ends = np.zeros(shape[0] * shape[1])
            column, row = (40 * x / z + 32) / dx, (40 * y / z + 32) / dy
            ends[int(row) // 8 * shape[0] + int(column) // 8] = 9.0
            out = np.zeros(4, np.int64)
            parts = np.array([[0, 4]])
            lattice = (0.0, 0.0, dx, dy)
            count = near_rays(centers, reaches, 1.0, parts, np.eye(4), K, 0.01, lattice, ends, shape, out)
            assert number in out[:count].tolist()
            assert 3 not in out[:count].tolist()


def test_balls_are_near_every_square_that_they_touch_and_few_others(rng: np.random.Generator) -> None:
    """Against points on their surfaces, at slants of up to 60 degrees and depths on both sides of 1."""
    count = 60
    depths = rng.uniform(0.3, 4, count)
    centers = np.column_stack((*(rng.uniform(-1.2, 1.2, (2, count)) * depths), depths))
    reaches = rng.uniform(0.02, 0.1, count) * depths
    directions = rng.normal(size=(2000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    K, side = np.array([[200.0, 0, 256], [0, 300, 256], [0, 0, 1]]), 64
    for number in range(count):
        points = centers[number] + reaches[number] * directions
        columns, rows = np.floor((points[:, :2] / points[:, 2:] * (200, 300) + 256) / 8).astype(int).T
        inside = (columns >= 0) & (columns < side) & (rows >= 0) & (rows < side)
        touched = set(zip(columns[inside].tolist(), rows[inside].tolist(), strict=True))
        middle = (columns.min() + columns.max()) // 2, (rows.min() + rows.max()) // 2
        width, height = columns.max() - columns.min() + 1, rows.max() - rows.min() + 1
        apart = {(middle[0] + 2 * width + 3, middle[1]), (middle[0], middle[1] - 2 * height - 3)}
        for square, found in [(each, True) for each in touched] + [(each, False) for each in apart]:
            if not (0 <= square[0] < side and 0 <= square[1] < side):
                continue
            ends, out = np.zeros(side * side), np.zeros(1, np.int64)
            ends[square[1] * side + square[0]] = 9.0
            ball = centers[number : number + 1], reaches[number : number + 1]
            lattice, shape, one = (0.0, 0.0, 1.0, 1.0), (side, side), np.array([[0, 1]])
            assert bool(near_rays(*ball, 1.0, one, np.eye(4), K, 0.01, lattice, ends, shape, out)) == found


def test_groups_count_as_much_as_single_gaussians() -> None:
    """Two views: one sees all groups, one all single Gaussians; of the latter there are more."""
    weights = np.zeros((2, 6), np.float32)
    weights[0, 4:], weights[1, :4] = 1, 1
    weights[1, 4] = 0.5
    assert view_order(weights, 4, 0.05).tolist() == [1, 0]
    # Weights below nothing and of nothing gain nothing, whatever their order.
    assert view_order(np.array([[0, 0], [0, 1], [1, 0], [1, 1]], np.float32), 1, 0.05)[0] == 3
    assert view_order(np.array([[0, 0], [0, 1], [1, 0], [1, 1]], np.float32), 1, 0.05, first=(1,))[0] == 1
