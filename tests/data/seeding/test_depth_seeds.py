"""Seeds from depth images, pixel by pixel in closed form: they lie on the surface, face it, and fill the voxels."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from seed_views import TILTED, K, camera, colors_of, frames, normals_of, plane_depth, rays, same, sphere_depth
from splats import front_camera

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.seeding import depth as seeds_depth
from gsencoder.data.seeding.depth import (
    BETWEEN,
    LARGEST_DEPTH,
    LAYER,
    OCCLUSION,
    SMALLEST_DEPTH,
    SMOOTHING_RADIUS,
    SurfaceGrid,
    depth_samples,
    read_rgbd,
    seed_from_depth,
    surface_pixels,
)
from gsencoder.data.seeding.points import quats_from_normals
from gsencoder.data.seeding.seed import SeedConfig, seed
from gsencoder.data.synthetic import make_room
from gsencoder.types import Scene, Views


class TestDepth:
    @pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), TILTED, np.array([1, 0, 1]) / np.sqrt(2)])
    def test_a_plane_becomes_one_sheet_of_flat_gaussians_with_its_normal(self, normal):
        view = camera()
        views = frames((view, plane_depth(view, normal, 1.5 * normal[2])))
        g = seed_from_depth(views, voxel=0.02)
        assert np.abs(g.means @ normal - 1.5 * normal[2]).max() < 1e-4
        assert np.abs(normals_of(g) @ normal).min() > np.cos(np.radians(2))
        assert (g.scales[:, 2] < 0.11 * g.scales[:, 0]).all()
        assert np.abs(colors_of(g) - np.array([200, 100, 50]) / 255).max() < 1e-5
        # One Gaussian a voxel that the plane crosses, not one a voxel and facing, also at 45° between two facings.
        points = depth_samples(views, voxel=0.02)[0].points
        cells = np.unique(np.floor(points / 0.02), axis=0)
        assert len(points) < 1.05 * len(cells)

    def test_a_sphere_has_its_normals_and_every_seen_point_has_a_seed_within_a_voxel(self):
        center = np.array([0.1, -0.05, 1.2])
        cameras = [camera(p, center) for p in ((0, 0, 0), (1.2, 0.1, 1.1), (-1.1, 0.3, 1.0), (0.1, 0.2, 2.4))]
        parts = [(view, sphere_depth(view, center, 0.15)) for view in cameras]
        g = seed_from_depth(frames(*parts), voxel=0.02)
        outwards = (g.means - center) / np.linalg.norm(g.means - center, axis=1, keepdims=True)
        assert np.abs(np.linalg.norm(g.means - center, axis=1) - 0.15).max() < 0.002
        assert np.median(np.abs((outwards * normals_of(g)).sum(1))) > np.cos(np.radians(3))
        assert np.abs((outwards * normals_of(g)).sum(1)).min() > np.cos(np.radians(20))
        for view, depth in parts:
            surface = (rays(view) * depth[..., None] + view.centers[0])[depth > 0]
            distance, _ = cKDTree(g.means).query(surface)
            assert np.quantile(distance, 0.99) < 0.02
            assert distance.max() < 0.03

    def test_the_gaussians_close_the_surface_and_are_sized_by_their_spacing(self):
        """They cover a plane as a perfect square grid of Gaussians of 0.6 spacings does."""
        view = camera()
        # In the middle of a layer of cells; at 1.5 rounding would decide between two.
        g = seed_from_depth(frames((view, plane_depth(view, (0, 0, 1.0), 1.51))), voxel=0.02)
        inner = (np.abs(g.means[:, :2]) < 0.4).all(axis=1)
        assert np.median(g.scales[inner, 0]) == pytest.approx(0.6 * 0.02, rel=0.03)
        lattice = np.stack(np.meshgrid(np.arange(-30, 30), np.arange(-30, 30)), axis=-1).reshape(-1, 2) * 0.02

        def coverage(means: np.ndarray, scales: np.ndarray | float, opacities: np.ndarray | float) -> np.ndarray:
            queries = np.random.default_rng(0).uniform(-0.4, 0.4, (600, 2))
            squares = np.square(queries[:, None] - means).sum(axis=-1)
            return 1 - np.exp(np.log1p(-opacities * np.exp(-squares / (2 * scales**2))).sum(axis=1))

        covered = coverage(g.means[:, :2], g.scales[:, 0], g.opacities)
        perfect = coverage(lattice, 0.6 * 0.02, float(np.median(g.opacities)))
        assert covered.min() > 0.9
        # The mean of the pixels in a cell is up to a pixel (0.3 spacings) off its center.
        assert np.median(covered) == pytest.approx(np.median(perfect), abs=0.01)

    def test_a_thin_plate_keeps_its_top_apart_from_the_table_under_it(self):
        """A plate 16 mm thick inside one 2 cm layer of voxels: the mean of both surfaces would lie between them."""
        view = camera()
        depth = plane_depth(view, (0, 0, 1.0), 1.0)
        points = rays(view)[..., :2] * (1.0 - 0.016)
        top = (np.abs(points) < [0.1, 0.015]).all(axis=-1)
        depth[top] = 1.0 - 0.016
        images = np.full((240, 320, 3), 40, np.uint8)
        images[top] = 220
        views = replace(frames((view, depth)), images=[images])
        g = seed_from_depth(views, voxel=0.02)
        height = 1.0 - g.means[:, 2]
        assert ((height < 0.001) | (np.abs(height - 0.016) < 0.001)).all()
        bright = colors_of(g)[:, 0] > 0.5
        assert np.array_equal(bright, height > 0.008)
        plate = g.means[height > 0.008]
        assert np.abs(plate[:, :2].max(axis=0) - [0.1, 0.015]).max() < 0.013  # Half a voxel and a pixel.

    def test_pixels_between_two_surfaces_are_dropped_and_silhouettes_kept(self):
        depth = np.full((240, 320), 2.0, np.float32)
        depth[60:180, 100:200] = 1.0
        mixed = depth.copy()
        mixed[60:180, 99] = 1.4  # What a sensor returns across the edge.
        use = surface_pixels(mixed, K).use
        assert not use[61:179, 99].any()
        # Beside it only the ring of background whose color the outline is mixed into is left out.
        ring = np.zeros_like(use)
        ring[59:181, 98:201] = True
        ring[60:180, 100:200] = False
        assert use[~ring].all()
        clean = surface_pixels(depth, K).use
        assert clean[60:180, 100:200].all()
        assert clean[~ring].all()
        assert not clean[100, [99, 200]].any()

    def test_normals_survive_the_noise_and_the_rounding_of_sensors(self, rng):
        view = camera()
        clean = plane_depth(view, TILTED, 1.5 * TILTED[2])
        noise = 0.003 * rng.standard_normal(clean.shape)
        for noisy, limit in ((np.round(clean * 1000) / 1000, 6), (clean + noise, 12)):
            surface = surface_pixels(noisy.astype(np.float32), K)
            cos = np.abs(surface.normals[surface.use] @ TILTED)
            assert np.degrees(np.arccos(np.median(cos))) < limit
            assert surface.use.mean() > 0.95
            errors = (surface.depth - clean)[5:-5, 5:-5]
            assert errors.std() < 0.6 * max((noisy - clean)[5:-5, 5:-5].std(), 1e-4)

    def test_the_same_views_give_the_same_bits_and_their_order_only_rounding(self):
        views = make_room(2, views=5, width=100, height=75).views
        first = seed_from_depth(views, voxel=0.03)
        assert same(first, seed_from_depth(views, voxel=0.03))
        back = [4, 2, 0, 3, 1]
        again = seed_from_depth(views.select(back), voxel=0.03)
        assert np.abs(again.means - first.means).max() < 1e-5

    @pytest.mark.usefixtures("no_jaxtyping")
    def test_bad_frames_are_errors_that_name_the_view(self):
        view = camera()
        good = plane_depth(view, (0, 0, 1.0), 1.5)
        views = frames((view, good), (view, good))
        narrow = views.images[1][:, :7]
        for depths, images, message in (
            ([np.zeros_like(good)] * 2, views.images, "none of the 2 depth images"),
            ([good, good[:100]], views.images, "view 'view 1': the depth is 320×100, but its camera says 320×240"),
            ([good] * 2, [*views.images[:1], narrow], "'view 1': the image is 7×240, but its camera says 320×240"),
            (None, views.images, "no depth images"),
            ([good, good], None, "no images"),
        ):
            with pytest.raises(InputError, match=message):
                seed_from_depth(replace(views, depths=depths, images=images), voxel=0.02)
        with pytest.raises(InputError, match="voxels\\) from the cameras"):
            seed_from_depth(frames((view, good * 1000)), voxel=0.001)

    def test_views_without_depth_are_counted(self):
        view = camera()
        views = frames((view, plane_depth(view, (0, 0, 1.0), 1.5)), (view, np.zeros((240, 320), np.float32)))
        with pytest.warns(SceneWarning, match=r"1 of 2 views have no usable depth \(first: 'view 1'\)"):
            seed_from_depth(views, voxel=0.05)

    def test_a_grid_that_has_to_grow_holds_the_sums_of_every_voxel_facing_and_layer(self, rng, monkeypatch):
        monkeypatch.setattr("gsencoder.data.seeding.depth.MIN_SLOTS", 2)
        points = rng.uniform(-0.25, 0.25, (3000, 3)).astype(np.float32)
        normals = rng.standard_normal((3000, 3)).astype(np.float32)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        colors = rng.integers(0, 256, (3000, 3)).astype(np.uint8)
        grid = SurfaceGrid(0.1, np.zeros(3))
        for start, stop in ((0, 1), (1, 40), (40, 700), (700, 3000)):
            grid.add(points[start:stop], normals[start:stop], colors[start:stop])
        expected = {}
        for point, normal, color in zip(points, normals, colors, strict=True):
            cell = point / np.float32(0.1)
            axis = int(np.abs(normal).argmax())
            layer = np.clip(np.rint(float((cell - np.floor(cell) - 0.5) @ normal) / LAYER), -4, 3)
            key = (*np.floor(cell).astype(int).tolist(), axis, bool(normal[axis] > 0), int(layer))
            expected.setdefault(key, []).append([*point, *normal, *color, 1])
        rows = grid._sums[np.argsort(grid._keys[: grid._rows])]
        sums = np.array([np.sum(expected[key], axis=0) for key in sorted(expected)])
        np.testing.assert_allclose(rows, sums, rtol=1e-6, atol=1e-6)


def test_quaternions_take_z_to_the_normal_up_to_its_sign(rng):
    normals = np.concatenate([rng.standard_normal((500, 3)), np.eye(3), -np.eye(3)])
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
    quats = quats_from_normals(normals)
    w, x, y, z = quats.T
    axis = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)
    assert np.abs(np.abs((axis * normals).sum(1)) - 1).max() < 1e-5
    assert np.abs(np.linalg.norm(quats, axis=1) - 1).max() < 1e-6


def test_a_voxel_that_float32_cannot_count_in_is_refused():
    views = frames((camera(), np.ones((240, 320), np.float32)))
    with pytest.raises(InputError, match="is outside 1e-12 to 1e\\+12; check voxel"):
        seed(Scene(name="s", views=views, metres_per_unit=1.0), SeedConfig(voxel=1e300))


def test_samples_out_of_the_grids_reach_are_told_without_a_cast_that_overflows():
    grid = SurfaceGrid(1e-12, np.zeros(3))
    far = np.full((1, 3), 1e12, np.float32)
    with pytest.raises(InputError, match="a sample lies further than"):
        grid.add(far, np.array([[0, 0, 1]], np.float32), np.zeros((1, 3), np.uint8))


def views_of(depth: np.ndarray, focal: float = 60.0) -> Views:
    height, width = depth.shape
    image = np.full((height, width, 3), 99, np.uint8)
    camera = front_camera(width, height, focal)
    return Views(cameras=camera, names=("v",), images=[image], depths=[depth.astype(np.float32)])


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
