"""What a depth image says about surfaces, pixel by pixel in plain loops and in closed form."""

from dataclasses import replace

import numpy as np
import pytest
from splats import front_camera

from gsencoder.core.errors import InputError
from gsencoder.data.seeding import depth as seeds_depth
from gsencoder.data.seeding.depth import (
    BETWEEN,
    LARGEST_DEPTH,
    OCCLUSION,
    SMALLEST_DEPTH,
    SMOOTHING_RADIUS,
    depth_samples,
    read_rgbd,
    surface_pixels,
)
from gsencoder.types import Views


def views_of(depth: np.ndarray, focal: float = 60.0) -> Views:
    height, width = depth.shape
    image = np.full((height, width, 3), 99, np.uint8)
    return Views(
        cameras=front_camera(width, height, focal), names=("v",), images=[image], depths=[depth.astype(np.float32)]
    )


def inverse_depths(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Steps of many sizes in both directions, and holes."""
    sizes = rng.choice([0.0, 0.001, 0.004, 0.03, 0.2], (12, 15)) * rng.choice([-1, 1], (12, 15))
    inverse = 0.5 + rng.choice([0.0, 0.3], (12, 15)) + sizes + rng.normal(0, 1e-4, (12, 15))
    return inverse, rng.random((12, 15)) > 0.15


def test_the_noise_of_second_differences_is_the_root_of_six_times_that_of_a_pixel(rng):
    plane = 0.01 * np.arange(300) + 0.02 * np.arange(200)[:, None]
    inverse, valid = plane + rng.normal(0, 1e-3, plane.shape), rng.random(plane.shape) > 0.1
    inverse[~valid] = 1e6
    assert seeds_depth._second_difference_noise(inverse, valid) == pytest.approx(6**0.5 * 1e-3, rel=0.03)
    assert seeds_depth._second_difference_noise(inverse, np.zeros_like(valid)) == 0


@pytest.mark.parametrize("shape", [(12, 15), (3, 15), (1, 1), (5, 4)])
def test_smoothing_is_a_mean_over_pairs_of_opposite_pixels_that_lie_on_a_line(rng, shape):
    inverse, valid = (array[: shape[0], : shape[1]] for array in inverse_depths(rng))
    step, radius = 0.01, SMOOTHING_RADIUS
    height, width = inverse.shape
    expected = np.zeros_like(inverse)
    for y in range(height):
        for x in range(width):
            members = [inverse[y, x]]
            for dy in range(radius + 1):
                for dx in range(-radius if dy else 1, radius + 1):
                    ends = [(y + dy, x + dx), (y - dy, x - dx)]
                    if all(0 <= v < height and 0 <= u < width and valid[v, u] for v, u in ends):
                        pair = [inverse[end] for end in ends]
                        if abs(sum(pair) - 2 * inverse[y, x]) < step:
                            members += pair
            expected[y, x] = np.mean(members)
    np.testing.assert_allclose(seeds_depth._smooth(inverse, valid, np.float32(step)), expected, rtol=1e-12)
    assert min(shape) < 12 or (expected != inverse).mean() > 0.2


def test_gradients_keep_to_a_pixels_own_surface_and_name_those_that_lie_on_none(rng):
    step, seen = 0.01, set()
    for _ in range(8):
        inverse, valid = inverse_depths(rng)
        gradient, none = seeds_depth._gradient(inverse, valid, np.float32(step))
        for y, x in np.ndindex(*inverse.shape):
            line, known = inverse[y], valid[y]

            def rise(x: int, line: np.ndarray = line, known: np.ndarray = known) -> float | None:
                """From pixel x to the next one; None where that is not known."""
                inside = 0 <= x < len(line) - 1
                return float(line[x + 1] - line[x]) if inside and known[x] and known[x + 1] else None

            before, after = rise(x - 1), rise(x)
            floats = behind = False
            if before is None or after is None:
                slope = (after if before is None else before) or 0.0
            else:
                least = min(abs(before), abs(after))
                beyond = max(abs(rise(x - 2) or 0.0), abs(rise(x + 1) or 0.0))
                edge = max(step, OCCLUSION * line[x])
                floats = before * after > 0 and least > step and beyond < BETWEEN * least
                behind = max(after, -before) > edge + 3 * least or (after > edge and -before > edge)
                if abs(after - before) < step:
                    slope = (before + after) / 2
                elif before * after < 0 and least > step:
                    slope = 0.0
                else:
                    slope = before if abs(before) < abs(after) else after
                seen |= {("floats", floats), ("behind", behind), ("peak", slope == 0.0)}
            assert gradient[y, x] == pytest.approx(slope, abs=1e-7)
            assert none[y, x] == (floats or behind)
    assert len(seen) == 6


@pytest.mark.parametrize("min_cos", [0.3, 0.9])
def test_a_plane_is_used_where_it_is_seen_steeply_enough(min_cos):
    camera = front_camera(80, 60, 40.0)
    y, x = (np.mgrid[:60, :80] + 0.5 - np.array([30, 40])[:, None, None]) / 40
    normal = np.array([0.6, -0.1, -0.8]) / np.linalg.norm([0.6, -0.1, -0.8])
    facing = -(normal[0] * x + normal[1] * y + normal[2])
    depth = np.where(facing > 0.02, 2 / np.maximum(facing, 0.02), 0).astype(np.float32)
    surface = surface_pixels(depth, camera.Ks[0], min_cos=min_cos)
    cosines = facing / np.sqrt(x * x + y * y + 1)
    clear = (np.abs(cosines - min_cos) > 0.01) & (depth > 0)
    np.testing.assert_array_equal(surface.use[clear], cosines[clear] > min_cos)
    assert not surface.use[depth == 0].any()
    assert 0.1 < surface.use.mean() < 0.9
    np.testing.assert_allclose(surface.normals[surface.use], np.tile(normal, (surface.use.sum(), 1)), atol=2e-3)
    np.testing.assert_allclose(surface.depth[surface.use], depth[surface.use], rtol=1e-3)


def test_masked_depths_do_not_count():
    depth = np.full((40, 60), 2.0)
    depth[:, 30:] = 3.0
    views = views_of(depth)
    samples, empty = depth_samples(views, voxel=0.1)
    assert set(np.round(samples.points[:, 2], 4).tolist()) == {2.0, 3.0}
    assert empty == []
    assert depth_samples(replace(views, masks=[np.zeros((40, 60), bool)]), voxel=0.1)[1] == ["v"]
    mask = np.ones((40, 60), bool)
    mask[:, :30] = False
    samples, _ = depth_samples(replace(views, masks=[mask]), voxel=0.1)
    assert set(np.round(samples.points[:, 2], 4).tolist()) == {3.0}


def test_pixels_lie_on_the_rays_through_their_centers():
    """A wall as fine as a voxel: its samples are the centers of pixels."""
    samples, _ = depth_samples(views_of(np.full((8, 10), 2.0), focal=20.0), voxel=0.05)
    x, y = ((np.arange(size) + 0.5 - size / 2) / 20 * 2 for size in (10, 8))
    expected = np.stack([*np.meshgrid(x, y), np.full((8, 10), 2.0)], axis=-1).reshape(-1, 3)
    order = np.lexsort(np.round(samples.points, 4).T)
    np.testing.assert_allclose(samples.points[order], expected[np.lexsort(np.round(expected, 4).T)], atol=1e-4)
    np.testing.assert_allclose(samples.normals, np.tile([0, 0, -1], (80, 1)), atol=1e-5)


def test_the_smallest_and_the_largest_depth_are_allowed_and_what_lies_beyond_is_counted():
    depth = np.full((4, 5), 2.0)
    depth[0, 0], depth[0, 1], depth[1, 1] = 1.01 * SMALLEST_DEPTH, 0.99 * LARGEST_DEPTH, 0
    np.testing.assert_array_equal(read_rgbd(views_of(depth), 0)[0], depth.astype(np.float32))
    depth[2, :2] = 0.9 * SMALLEST_DEPTH, 1.1 * LARGEST_DEPTH
    with pytest.raises(InputError, match="view 'v': 2 of 20 depths lie outside"):
        read_rgbd(views_of(depth), 0)
    depth[3, :3] = np.nan, np.inf, -1e-6
    with pytest.raises(InputError, match="view 'v': 3 of 20 depths are NaN, infinite or negative"):
        read_rgbd(views_of(depth), 0)


@pytest.mark.parametrize("kind", ["depth", "image"])
def test_a_picture_of_another_size_names_width_and_height_of_both(kind):
    views = views_of(np.full((4, 5), 2.0))
    wrong = np.zeros((3, 7), np.float32) if kind == "depth" else np.zeros((3, 7, 3), np.uint8)
    with pytest.raises(InputError, match=f"the {kind} is 7×3, but its camera says 5×4"):
        read_rgbd(replace(views, **{f"{kind}s": [wrong]}), 0)
