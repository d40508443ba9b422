import builtins
import time
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.scenes import load_scene
from gsencoder.data.seeding.depth import depth_samples, surface_pixels
from gsencoder.data.seeding.flat import flat_gaussians, quats_from_normals
from gsencoder.data.seeding.seed import (
    SeedConfig,
    seed,
    seed_from_depth,
    seed_from_mesh,
    seed_from_points,
    seed_from_tsdf,
)
from gsencoder.data.seeding.surface_grid import LAYER, SurfaceGrid
from gsencoder.data.synthetic.room import make_room
from gsencoder.types import Cameras, Gaussians, Scene, Views

K = np.array([[260.0, 0, 160], [0, 260, 120], [0, 0, 1]], np.float32)


def camera(center=(0.0, 0.0, 0.0), target=(0.0, 0.0, 1.0), size=(320, 240), K=K) -> Cameras:
    """One camera that looks from `center` to `target`; image down is world +y where that is possible."""
    forward = np.subtract(target, center) / np.linalg.norm(np.subtract(target, center))
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = [right, np.cross(forward, right), forward]
    pose[:3, 3] = -pose[:3, :3] @ center
    return Cameras(
        cam_from_world=pose[None].astype(np.float32),
        Ks=K[None],
        widths=np.array([size[0]], np.int32),
        heights=np.array([size[1]], np.int32),
    )


def rays(cameras: Cameras) -> np.ndarray:
    v, u = np.mgrid[: cameras.heights[0], : cameras.widths[0]] + 0.5
    M = cameras.Ks[0]
    local = np.stack([(u - M[0, 2]) / M[0, 0], (v - M[1, 2]) / M[1, 1], np.ones_like(u)], axis=-1)
    return local @ cameras.cam_from_world[0, :3, :3].astype(np.float64)


def plane_depth(cameras: Cameras, normal, offset: float) -> np.ndarray:
    """z of the plane n·x = offset."""
    t = (offset - cameras.centers[0] @ normal) / (rays(cameras) @ normal)
    return np.where(t > 0, t, 0).astype(np.float32)


def sphere_depth(cameras: Cameras, center, radius: float) -> np.ndarray:
    d, o = rays(cameras), cameras.centers[0] - np.asarray(center)
    a, b, c = (d * d).sum(-1), d @ o, o @ o - radius**2
    root = b * b - a * c
    return np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, 0).astype(np.float32)


def frames(*parts: tuple[Cameras, np.ndarray], color=(200, 100, 50)) -> Views:
    stacked = {
        name: np.concatenate([getattr(cameras, name) for cameras, _ in parts])
        for name in ("cam_from_world", "Ks", "widths", "heights")
    }
    return Views(
        cameras=Cameras(**stacked),
        names=tuple(f"view {row}" for row in range(len(parts))),
        images=[np.broadcast_to(np.array(color, np.uint8), (*depth.shape, 3)).copy() for _, depth in parts],
        depths=[depth for _, depth in parts],
    )


def normals_of(g: Gaussians) -> np.ndarray:
    """Third axis of each rotation, which is the thin one."""
    w, x, y, z = g.quats.T
    return np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)


def colors_of(g: Gaussians) -> np.ndarray:
    return 0.5 + 0.28209479177387814 * g.sh[:, 0]


def same(a: Gaussians, b: Gaussians) -> bool:
    names = ("means", "quats", "scales", "opacities", "sh")
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in names)


TILTED = np.array([0.3, -0.5, 0.8]) / np.linalg.norm([0.3, -0.5, 0.8])


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

    def test_a_wire_of_one_pixel_is_kept(self):
        depth = np.full((240, 320), 2.0, np.float32)
        depth[:, 150] = 1.0
        found = surface_pixels(depth, K)
        assert found.use[:, 150].all()
        assert np.abs(found.depth[:, 150] - 1).max() < 1e-6

    def test_normals_survive_the_noise_and_the_rounding_of_sensors(self, rng):
        view = camera()
        clean = plane_depth(view, TILTED, 1.5 * TILTED[2])
        for noisy, limit in (
            (np.round(clean * 1000) / 1000, 6),
            (clean + 0.003 * rng.standard_normal(clean.shape), 12),
        ):
            found = surface_pixels(noisy.astype(np.float32), K)
            cos = np.abs(found.normals[found.use] @ TILTED)
            assert np.degrees(np.arccos(np.median(cos))) < limit
            assert found.use.mean() > 0.95
            errors = (found.depth - clean)[5:-5, 5:-5]
            assert errors.std() < 0.6 * max((noisy - clean)[5:-5, 5:-5].std(), 1e-4)

    def test_surfaces_seen_at_a_slant_are_not_taken(self):
        view = camera()
        steep = np.array([1.0, 0.0, 0.02]) / np.linalg.norm([1.0, 0.0, 0.02])
        depth = plane_depth(view, steep, 1.5 * steep[2])
        depth[depth > 20] = 0
        cos = np.abs(rays(view) @ steep) / np.linalg.norm(rays(view), axis=-1)
        use = surface_pixels(depth, K, min_cos=0.1).use
        assert not use[cos < 0.095].any()

    def test_a_rigid_motion_of_the_scene_moves_the_seeds(self):
        scene = make_room(1, views=6, width=120, height=90)
        views = scene.views
        still = seed_from_depth(views, voxel=0.04)
        turn, shift = rotation(0.4, -0.7, 0.2), np.array([3.0, -2.0, 1.0])
        pose = views.cameras.cam_from_world.astype(np.float64).copy()
        pose[:, :3, 3] -= np.einsum("vij,j->vi", pose[:, :3, :3] @ turn.T, shift)
        pose[:, :3, :3] = pose[:, :3, :3] @ turn.T
        moved = seed_from_depth(
            replace(views, cameras=replace(views.cameras, cam_from_world=pose.astype(np.float32))), voxel=0.04
        )
        assert 0.8 < len(moved) / len(still) < 1.25
        expected = still.means @ turn.T + shift
        distance, row = cKDTree(moved.means).query(expected)
        assert distance.max() < 2 * 0.04
        assert np.median(distance) < 0.03
        cos = np.abs((normals_of(moved)[row] * (normals_of(still) @ turn.T)).sum(1))
        assert np.mean(cos > 0.9) > 0.9
        assert abs(np.median(moved.scales[:, 0]) / np.median(still.scales[:, 0]) - 1) < 0.1

    def test_the_same_views_give_the_same_bits_and_their_order_only_rounding(self):
        views = make_room(2, views=5, width=100, height=75).views
        first = seed_from_depth(views, voxel=0.03)
        assert same(first, seed_from_depth(views, voxel=0.03))
        back = [4, 2, 0, 3, 1]
        shuffled = Views(
            cameras=views.cameras.select(back),
            names=tuple(views.names[row] for row in back),
            images=[views.images[row] for row in back],
            depths=[views.depths[row] for row in back],
        )
        again = seed_from_depth(shuffled, voxel=0.03)
        assert np.abs(again.means - first.means).max() < 1e-5

    def test_a_scale_of_the_scene_scales_the_seeds(self):
        view = camera()
        depth = sphere_depth(view, (0, 0, 1.2), 0.2)
        g = seed_from_depth(frames((view, depth)), voxel=0.02)
        big = seed_from_depth(frames((view, (1024 * depth).astype(np.float32))), voxel=0.02 * 1024)
        assert np.abs(big.means / 1024 - g.means).max() < 1e-5
        assert np.abs(big.scales / 1024 - g.scales).max() < 1e-5

    def test_masked_and_far_pixels_are_not_used(self):
        view = camera()
        depth = plane_depth(view, (0, 0, 1.0), 1.5)
        depth[:, 160:] = 3.0
        mask = np.zeros((240, 320), bool)
        mask[:, :80] = True
        masked = seed_from_depth(replace(frames((view, depth)), masks=[mask]), voxel=0.05)
        assert masked.means[:, 0].max() < -0.4
        near = seed_from_depth(frames((view, depth)), voxel=0.05, max_depth=2.0)
        assert near.means[:, 2].max() < 2

    def test_a_single_pixel_is_a_single_gaussian(self):
        one = np.array([[100, 0, 0.5], [0, 100, 0.5], [0, 0, 1]], np.float32)
        view = camera(size=(1, 1), K=one)
        g = seed_from_depth(frames((view, np.full((1, 1), 2.0, np.float32))), voxel=0.02)
        assert np.abs(g.means - [[0, 0, 2]]).max() < 1e-6
        assert g.scales[0, 0] < 0.1

    @pytest.mark.usefixtures("no_jaxtyping")
    def test_bad_frames_are_errors_that_name_the_view(self):
        view = camera()
        good = plane_depth(view, (0, 0, 1.0), 1.5)
        views = frames((view, good), (view, good.copy()))
        views.depths[1][3, 4] = np.nan
        with pytest.raises(InputError, match=r"view 'view 1': 1 of 76800 depths are NaN"):
            seed_from_depth(views, voxel=0.02)
        for depths, images, message in (
            ([np.zeros_like(good)] * 2, views.images, "none of the 2 depth images"),
            ([good, good[:100]], views.images, "view 'view 1': the depth is 320×100"),
            ([good, good], [views.images[0], views.images[1][:, :7]], "view 'view 1': the image is 7×240"),
            (None, views.images, "no depth images"),
            ([good, good], None, "no images"),
        ):
            with pytest.raises(InputError, match=message):
                seed_from_depth(replace(views, depths=depths, images=images), voxel=0.02)
        with pytest.raises(InputError, match="voxel must be a positive length"):
            seed_from_depth(frames((view, good)), voxel=0.0)
        with pytest.raises(InputError, match="voxels\\) from the cameras"):
            seed_from_depth(frames((view, good * 1000)), voxel=0.001)

    def test_no_views_is_an_error(self):
        none = camera().select([])
        with pytest.raises(InputError, match="no views"):
            seed_from_depth(Views(cameras=none, names=(), images=[], depths=[]), voxel=0.02)

    def test_views_without_depth_are_counted(self):
        view = camera()
        views = frames((view, plane_depth(view, (0, 0, 1.0), 1.5)), (view, np.zeros((240, 320), np.float32)))
        with pytest.warns(SceneWarning, match=r"1 of 2 views have no usable depth \(first: 'view 1'\)"):
            seed_from_depth(views, voxel=0.05)

    def test_a_grid_that_has_to_grow_holds_the_sums_of_every_voxel_facing_and_layer(self, rng, monkeypatch):
        monkeypatch.setattr("gsencoder.data.seeding.surface_grid.MIN_SLOTS", 2)
        points = rng.uniform(-0.25, 0.25, (3000, 3)).astype(np.float32)
        normals = rng.standard_normal((3000, 3)).astype(np.float32)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        colors = rng.integers(0, 256, (3000, 3)).astype(np.uint8)
        grid = SurfaceGrid(0.1, np.zeros(3))
        for start, stop in ((0, 1), (1, 40), (40, 700), (700, 3000)):
            grid.add(points[start:stop], normals[start:stop], colors[start:stop])
        expected = {}
        for point, normal, color in zip(points, normals, colors, strict=True):
            place = point / np.float32(0.1)
            axis = int(np.abs(normal).argmax())
            layer = np.clip(np.rint(float((place - np.floor(place) - 0.5) @ normal) / LAYER), -4, 3)
            key = (*np.floor(place).astype(int).tolist(), axis, bool(normal[axis] > 0), int(layer))
            expected.setdefault(key, []).append([*point, *normal, *color, 1])
        rows = grid._sums[np.argsort(grid._keys[: grid._rows])]
        sums = np.array([np.sum(expected[key], axis=0) for key in sorted(expected)])
        np.testing.assert_allclose(rows, sums, rtol=1e-6, atol=1e-6)


def rotation(a: float, b: float, c: float) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return Rotation.from_euler("xyz", [a, b, c]).as_matrix()


def test_an_empty_grid_gives_no_samples():
    grid = SurfaceGrid(0.1, np.zeros(3))
    grid.add(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8))
    assert len(grid.samples().points) == 0


def test_quaternions_take_z_to_the_normal_up_to_its_sign(rng):
    normals = np.concatenate([rng.standard_normal((500, 3)), np.eye(3), -np.eye(3)])
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
    quats = quats_from_normals(normals)
    w, x, y, z = quats.T
    axis = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)
    assert np.abs(np.abs((axis * normals).sum(1)) - 1).max() < 1e-5
    assert np.abs(np.linalg.norm(quats, axis=1) - 1).max() < 1e-6


def test_coincident_points_get_a_finite_size():
    n = 40
    g = flat_gaussians(
        np.zeros((n, 3), np.float32), np.tile(np.float32([0, 0, 1]), (n, 1)), np.zeros((n, 3), np.float32), largest=0.1
    )
    assert (g.scales[:, 0] <= 0.08).all()


class TestPoints:
    def test_a_sphere_of_points_gets_normals_spacing_and_colors(self, rng):
        points = rng.standard_normal((4000, 3))
        points = (points / np.linalg.norm(points, axis=1, keepdims=True)).astype(np.float32)
        colors = np.where(points[:, :1] > 0, [[250, 10, 10]], [[10, 10, 250]]).astype(np.uint8)
        g = seed_from_points(points, colors)
        assert len(g) == 4000
        assert np.quantile(np.abs((normals_of(g) * g.means).sum(1)), 0.02) > 0.97
        spacing = np.sqrt(4 * np.pi / 4000)
        assert 0.5 * spacing < np.median(g.scales[:, 0]) < spacing
        assert np.array_equal(colors_of(g)[:, 0] > 0.5, g.means[:, 0] > 0)

    def test_the_grid_averages_and_a_stray_point_stays_small(self, rng):
        points = np.concatenate([rng.uniform(0, 1, (3000, 3)) * [1, 1, 0], [[0.5, 0.5, 30.0]]]).astype(np.float32)
        g = seed_from_points(points, np.full((3001, 3), 90, np.uint8), voxel=0.05)
        assert 390 < len(g) <= 20 * 20 + 1
        assert g.scales[:, 0].max() < 0.2

    def test_a_point_at_the_lens_stays_small(self, rng):
        sheet = (rng.uniform(-1, 1, (500, 3)) * [1, 1, 0] + [0, 0, 3]).astype(np.float32)
        points = np.concatenate([sheet, [[0, 0, 0.05]]]).astype(np.float32)
        views = Views(cameras=camera(), names=("a",))
        g = seed_from_points(points, np.zeros((501, 3), np.uint8), views=views)
        assert g.scales[np.argmin(g.means[:, 2]), 0] < 0.1 * 0.05

    def test_a_cloud_without_a_sheet_is_thick_and_a_sheet_is_thin(self, rng):
        cloud = rng.standard_normal((2000, 3)).astype(np.float32)
        black = np.zeros((2000, 3), np.uint8)
        thick, thin = (seed_from_points(p, black) for p in (cloud, cloud * np.float32([1, 1, 0.001])))
        assert np.median(thick.scales[:, 2] / thick.scales[:, 0]) > 0.3
        assert np.median(thin.scales[:, 2] / thin.scales[:, 0]) < 0.15

    @pytest.mark.parametrize(
        "points", [[[1, 2, 3]], [[0, 0, 0], [1, 0, 0]], [[0, 0, 0]] * 20, np.eye(3)[:, [0]] * np.ones(3)]
    )
    def test_one_two_equal_and_collinear_points_work(self, points):
        points = np.array(points, np.float32)
        g = seed_from_points(points, np.zeros((len(points), 3), np.uint8))
        assert len(g) == len(np.unique(points, axis=0))

    @pytest.mark.usefixtures("no_jaxtyping")
    def test_bad_points_are_errors(self):
        black = np.zeros((2, 3), np.uint8)
        with pytest.raises(InputError, match="no points"):
            seed_from_points(np.zeros((0, 3), np.float32), None)
        with pytest.raises(InputError, match=r"1 of 2 points are not finite \(first: row 1\)"):
            seed_from_points(np.array([[0, 0, 0], [0, np.nan, 0]], np.float32), black)
        with pytest.raises(InputError, match="expected 3 colors"):
            seed_from_points(np.zeros((3, 3), np.float32), black)
        with pytest.raises(InputError, match="too small"):
            seed_from_points(np.full((2, 3), 1e30, np.float32), black, voxel=1e-6)

    def test_points_without_colors_are_grey_with_a_warning(self):
        with pytest.warns(SceneWarning, match="2 points without colors"):
            g = seed_from_points(np.float32([[0, 0, 0], [1, 0, 0]]), None)
        assert np.abs(colors_of(g) - 0.5).max() < 0.01


class TestMesh:
    @pytest.fixture(autouse=True)
    def _trimesh(self):
        self.trimesh = pytest.importorskip("trimesh")

    def test_a_coarse_box_is_covered_without_holes(self, tmp_path):
        mesh = self.trimesh.creation.box((1.0, 0.6, 0.4))
        mesh.export(tmp_path / "box.ply")
        g = seed_from_mesh(tmp_path / "box.ply", voxel=0.05)
        points, _ = self.trimesh.sample.sample_surface(mesh, 3000, seed=0)
        assert cKDTree(g.means).query(points)[0].max() < 0.05
        assert np.abs(g.means).max(axis=0) == pytest.approx([0.5, 0.3, 0.2], abs=1e-5)
        assert np.abs(normals_of(g)).max(axis=1).min() > 0.999

    def test_a_fine_sphere_keeps_its_shape_and_vertex_colors(self, tmp_path):
        mesh = self.trimesh.creation.icosphere(subdivisions=5, radius=0.5)
        mesh.visual.vertex_colors = np.where(mesh.vertices[:, 2:] > 0, [[255, 0, 0, 255]], [[0, 0, 255, 255]])
        mesh.export(tmp_path / "ball.ply")
        g = seed_from_mesh(tmp_path / "ball.ply", voxel=0.05, origin=np.array([10.0, 0, 0]))
        centered = g.means + np.float32([10, 0, 0])
        assert np.abs(np.linalg.norm(centered, axis=1) - 0.5).max() < 0.005
        assert np.abs((normals_of(g) * centered).sum(1) / 0.5).min() > 0.98
        red = colors_of(g)[:, 0] > 0.5
        away = np.abs(centered[:, 2]) > 0.05
        assert np.array_equal(red[away], centered[away, 2] > 0)

    def test_slivers_take_few_samples_and_leave_no_hole(self, tmp_path):
        sliver = self.trimesh.Trimesh([[0, 0, 0], [10, 0, 0], [10, 0.001, 0]], [[0, 1, 2]], process=False)
        sliver.export(tmp_path / "sliver.ply")
        g = seed_from_mesh(tmp_path / "sliver.ply", voxel=0.02)
        assert 450 < len(g) < 1100
        assert np.diff(np.sort(g.means[:, 0])).max() < 0.03  # So that no point is further than a voxel from one.

    def test_textures_and_the_placing_of_a_scene_graph_are_used(self, tmp_path):
        from PIL import Image

        picture = np.zeros((8, 8, 3), np.uint8)
        picture[:, :4], picture[:, 4:] = [250, 0, 0], [0, 250, 0]
        quad = self.trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]], process=False)
        material = self.trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(picture))
        quad.visual = self.trimesh.visual.TextureVisuals(uv=[[0, 0], [1, 0], [1, 1], [0, 1]], material=material)
        scene = self.trimesh.Scene()
        scene.add_geometry(quad, transform=self.trimesh.transformations.translation_matrix([5, 0, 0]))
        scene.export(tmp_path / "quad.glb")
        g = seed_from_mesh(tmp_path / "quad.glb", voxel=0.1)
        assert g.means[:, 0].min() > 4.9
        left = g.means[:, 0] < 5.35
        right = g.means[:, 0] > 5.65
        assert (colors_of(g)[left, 0] > 0.9).all()
        assert (colors_of(g)[right, 1] > 0.9).all()

    def test_a_point_cloud_file_is_seeded_as_points(self, tmp_path, rng):
        cloud = self.trimesh.PointCloud(
            rng.uniform(0, 1, (500, 3)) * [1, 1, 0], colors=np.full((500, 4), 200, np.uint8)
        )
        cloud.export(tmp_path / "cloud.ply")
        g = seed_from_mesh(tmp_path / "cloud.ply", voxel=0.001)
        assert 480 < len(g) <= 500
        assert np.abs(colors_of(g) * 255 - 200).max() < 1

    def test_files_that_are_no_mesh_are_errors(self, tmp_path):
        with pytest.raises(InputError, match="no such mesh file"):
            seed_from_mesh(tmp_path / "none.ply", voxel=0.1)
        for name, content in (("a.ply", b"ply\nnonsense"), ("b.obj", b""), ("c.txt", b"hello"), ("d.glb", b"glTF1")):
            (tmp_path / name).write_bytes(content)
            with pytest.raises(InputError, match=name):
                seed_from_mesh(tmp_path / name, voxel=0.1)

    def test_a_mesh_in_other_units_than_the_voxel_is_an_error_that_says_so(self, tmp_path):
        self.trimesh.creation.box((5000, 5000, 3000)).export(tmp_path / "mm.ply")
        with pytest.raises(InputError, match="its unit is not the voxel's"):
            seed_from_mesh(tmp_path / "mm.ply", voxel=0.02)


class TestTsdf:
    @pytest.mark.usefixtures("open3d")
    @pytest.mark.slow
    def test_a_sphere_is_fused_to_its_surface(self):
        center = np.array([0.1, -0.05, 1.6])
        cameras = [camera(p, center) for p in ((0, 0, 0.3), (1.2, 0.1, 1.1), (-1.1, 0.3, 1.0))]
        g = seed_from_tsdf(frames(*[(view, sphere_depth(view, center, 0.2)) for view in cameras]), voxel=0.02)
        radius = np.linalg.norm(g.means - center, axis=1)
        assert np.quantile(np.abs(radius - 0.2), 0.95) < 0.004
        assert np.median(np.abs((normals_of(g) * (g.means - center)).sum(1) / radius)) > 0.98
        assert np.abs(np.median(colors_of(g), axis=0) * 255 - [200, 100, 50]).max() < 2

    def test_a_missing_system_library_is_an_error_that_names_the_packages(self, monkeypatch):
        real = builtins.__import__

        def fails(name, *rest, **more):
            if name == "open3d":
                raise OSError("libusb-1.0.so.0: cannot open shared object file")
            return real(name, *rest, **more)

        monkeypatch.setattr(builtins, "__import__", fails)
        view = camera()
        with pytest.raises(InputError, match=r"libusb-1\.0\.so\.0.*apt-get install libusb-1\.0-0 libgl1"):
            seed_from_tsdf(frames((view, plane_depth(view, (0, 0, 1.0), 1.5))), voxel=0.02)


class TestSeed:
    def test_auto_takes_depth_where_there_is_some_and_points_else(self):
        room = make_room(0, views=3, width=80, height=60)
        by_depth = seed(room, SeedConfig(voxel=0.05))
        assert same(by_depth, seed_from_depth(room.views, voxel=0.05))
        points = np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
        colors = np.full((4, 3), 9, np.uint8)
        bare = replace(room, views=replace(room.views, depths=None), sfm_points=points, sfm_colors=colors)
        assert len(seed(bare)) == 4

    def test_the_voxel_is_metric_where_the_unit_is_known(self):
        view = camera()
        views = frames((view, plane_depth(view, (0, 0, 1.0), 1.5)))
        scene = Scene(name="cm", views=views, metres_per_unit=0.5)
        assert same(seed(scene, SeedConfig(voxel=0.02)), seed_from_depth(views, voxel=0.04))
        assert same(seed(scene, SeedConfig(voxel_units=0.1)), seed_from_depth(views, voxel=0.1))

    def test_an_unknown_unit_is_estimated_with_a_warning_that_says_how(self, rng):
        view = camera()
        views = frames((view, plane_depth(view, (0, 0, 1.0), 150.0)))
        with pytest.warns(SceneWarning, match=r"voxel is 1\.5 of its units, one hundredth of the median depth"):
            g = seed(Scene(name="x", views=views))
        assert same(g, seed_from_depth(views, voxel=1.5))
        points = rng.uniform(0, 9, (300, 3)).astype(np.float32)
        cloud = Scene(name="x", sfm_points=points, sfm_colors=np.zeros((300, 3), np.uint8))
        with pytest.warns(SceneWarning, match="median nearest-neighbor distance"):
            assert 100 < len(seed(cloud)) <= 300

    def test_a_mesh_without_a_unit_takes_its_voxel_from_the_cameras(self, tmp_path):
        trimesh = pytest.importorskip("trimesh")
        trimesh.creation.box((100.0, 100.0, 100.0)).export(tmp_path / "box.ply")
        config = SeedConfig(source="mesh", mesh=str(tmp_path / "box.ply"))
        views = Views(cameras=camera((0.0, 0.0, -400.0)), names=("a",))
        with pytest.warns(SceneWarning, match=r"voxel is 4 of"):
            g = seed(Scene(name="x", views=views), config)
        assert 2_000 < len(g) < 8_000

    def test_sources_that_the_scene_does_not_have_are_errors(self):
        scene = Scene(name="bare")
        for source, message in (
            ("auto", "neither photographs"),
            ("photographs", "no views"),
            ("points", "no structure"),
            ("depth", "no views"),
            ("tsdf", "no views"),
        ):
            with pytest.raises(InputError, match=message):
                seed(scene, SeedConfig(source=source))
        room = make_room(0, views=1, width=8, height=6)
        with pytest.raises(InputError, match="no depth images"):
            seed(replace(room, views=replace(room.views, depths=None)), SeedConfig(source="depth"))

    @pytest.mark.usefixtures("no_jaxtyping")
    def test_options_out_of_range_are_errors(self):
        for options in (
            {"voxel": 0.0},
            {"voxel": float("nan")},
            {"source": "sfm"},
            {"source": "mesh"},
            {"min_cos": 1.0},
        ):
            (name,) = options
            with pytest.raises(InputError, match=name):
                SeedConfig(**options)

    @pytest.mark.shared
    def test_a_house_scene_is_seeded_in_seconds_with_a_seed_at_every_seen_point(self, shared):
        scene = load_scene(shared / "scenes/house/train_004")
        start = time.process_time()
        g = seed(scene)
        assert time.process_time() - start < 8  # 1.7 s alone on one core.
        assert 50_000 < len(g) < 300_000
        depth, pose = scene.views.depths[5], scene.views.cameras.cam_from_world[5]
        view = scene.views.cameras.select([5])
        points = (rays(view) * depth[..., None] + view.centers[0])[depth > 0][::7]
        distance, _ = cKDTree(g.means).query(points)
        assert np.quantile(distance, 0.99) < 0.02
        assert np.isfinite(pose).all()

    @pytest.mark.shared
    @pytest.mark.slow
    def test_small_objects_keep_their_boxes(self, shared):
        """Seeds inside an object's box, on its surface by the instance maps, span at least half of its volume."""
        scene = load_scene(shared / "scenes/house/train_012")
        g = seed(scene)
        votes = np.zeros((len(g), max(found.id for found in scene.objects) + 1), np.int32)
        for view in range(len(scene.views)):
            pose, M = scene.views.cameras.cam_from_world[view], scene.views.cameras.Ks[view]
            local = g.means @ pose[:3, :3].T + pose[:3, 3]
            rows = np.flatnonzero(local[:, 2] > 0.05)
            x, y = np.floor(local[rows, :2] / local[rows, 2:] * np.diag(M)[:2] + M[:2, 2]).astype(int).T
            depth, labels = scene.views.depths[view], scene.views.instances[view]
            inside = (x >= 0) & (y >= 0) & (x < depth.shape[1]) & (y < depth.shape[0])
            rows, x, y = rows[inside], x[inside], y[inside]
            seen = (np.abs(depth[y, x] - local[rows, 2]) < 0.02) & (labels[y, x] < votes.shape[1])
            np.add.at(votes, (rows[seen], labels[y[seen], x[seen]]), 1)
        owner = np.where(votes.max(axis=1) > 0, votes.argmax(axis=1), 0)
        overlaps = []
        for found in scene.objects:
            if found.placed and found.views >= 5 and found.max_pixels >= 60:
                mine = g.means[owner == found.id].astype(np.float64) + scene.origin
                lower, upper = mine.min(axis=0), mine.max(axis=0)
                common = np.clip(np.minimum(upper, found.aabb_max) - np.maximum(lower, found.aabb_min), 0, None).prod()
                both = (upper - lower).prod() + (found.aabb_max - found.aabb_min).prod()
                overlaps.append(common / (both - common))
        assert len(overlaps) >= 5
        assert min(overlaps) > 0.5
        assert np.mean(overlaps) > 0.8

    @pytest.mark.shared
    def test_the_plush_is_usable_through_its_sfm_points(self, shared):
        scene = load_scene(shared / "scenes/plush")
        with pytest.warns(SceneWarning, match="unit of scene 'plush' is unknown"):
            g = seed(scene)
        assert 0.7 * len(scene.sfm_points) < len(g) <= len(scene.sfm_points)
        spread = np.ptp(np.quantile(g.means, [0.05, 0.95], axis=0), axis=0)
        assert g.scales.max() < 0.1 * np.linalg.norm(spread)


@pytest.mark.parametrize("depth", [1e-42, 1e-20, 1e20, 3e38])
def test_depth_that_no_sensor_gives_is_taken_for_a_wrong_scale(depth):
    view = camera()
    with pytest.raises(InputError, match="76800 of 76800 depths lie outside .* check the depth scale"):
        seed_from_depth(frames((view, np.full((240, 320), depth, np.float32))), voxel=0.02)


@pytest.mark.parametrize(
    "wrong", [{"voxel_units": 1e-300}, {"voxel_units": 1e300}, {"voxel": 1e300}, {"voxel": 1e-300}]
)
def test_a_voxel_that_float32_cannot_count_in_is_refused(wrong):
    views = frames((camera(), np.ones((240, 320), np.float32)))
    with pytest.raises(InputError, match="is outside 1e-12 to 1e\\+12; check voxel"):
        seed(Scene(name="s", views=views, metres_per_unit=1.0), SeedConfig(**wrong))


def test_samples_out_of_the_grids_reach_are_told_without_a_cast_that_overflows():
    grid = SurfaceGrid(1e-12, np.zeros(3))
    far = np.full((1, 3), 1e12, np.float32)
    with pytest.raises(InputError, match="a sample lies further than"):
        grid.add(far, np.array([[0, 0, 1]], np.float32), np.zeros((1, 3), np.uint8))
