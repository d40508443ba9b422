"""Seeds from points, from a mesh, in which unit, and how they turn with their scene."""

import builtins
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from seed_views import camera, colors_of, frames, normals_of, plane_depth, same, sphere_depth
from textured_box import box_cameras, box_views

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.scenes import load_scene
from gsencoder.data.seeding.depth import room_frame, seed_from_depth
from gsencoder.data.seeding.points import unit_of
from gsencoder.data.seeding.seed import SeedConfig, seed, seed_from_mesh, seed_from_points, seed_from_tsdf
from gsencoder.data.synthetic import make_room
from gsencoder.types import Scene, Views
from gsencoder.types.scene import invert_rigid


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
    def test_a_coarse_box_is_covered_without_holes(self, tmp_path):
        mesh = trimesh.creation.box((1.0, 0.6, 0.4))
        mesh.export(tmp_path / "box.ply")
        g = seed_from_mesh(tmp_path / "box.ply", voxel=0.05)
        points, _ = trimesh.sample.sample_surface(mesh, 3000, seed=0)
        assert cKDTree(g.means).query(points)[0].max() < 0.05
        assert np.abs(g.means).max(axis=0) == pytest.approx([0.5, 0.3, 0.2], abs=1e-5)
        assert np.abs(normals_of(g)).max(axis=1).min() > 0.999

    def test_a_fine_sphere_keeps_its_shape_and_vertex_colors(self, tmp_path):
        mesh = trimesh.creation.icosphere(subdivisions=5, radius=0.5)
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
        sliver = trimesh.Trimesh([[0, 0, 0], [10, 0, 0], [10, 0.001, 0]], [[0, 1, 2]], process=False)
        sliver.export(tmp_path / "sliver.ply")
        g = seed_from_mesh(tmp_path / "sliver.ply", voxel=0.02)
        assert 450 < len(g) < 1100
        assert np.diff(np.sort(g.means[:, 0])).max() < 0.03  # So that no point is further than a voxel from one.

    def test_textures_and_the_placing_of_a_scene_graph_are_used(self, tmp_path):
        from PIL import Image

        picture = np.zeros((8, 8, 3), np.uint8)
        picture[:, :4], picture[:, 4:] = [250, 0, 0], [0, 250, 0]
        quad = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]], process=False)
        material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(picture))
        quad.visual = trimesh.visual.TextureVisuals(uv=[[0, 0], [1, 0], [1, 1], [0, 1]], material=material)
        scene = trimesh.Scene()
        scene.add_geometry(quad, transform=trimesh.transformations.translation_matrix([5, 0, 0]))
        scene.export(tmp_path / "quad.glb")
        g = seed_from_mesh(tmp_path / "quad.glb", voxel=0.1)
        assert g.means[:, 0].min() > 4.9
        left = g.means[:, 0] < 5.35
        right = g.means[:, 0] > 5.65
        assert (colors_of(g)[left, 0] > 0.9).all()
        assert (colors_of(g)[right, 1] > 0.9).all()

    def test_a_point_cloud_file_is_seeded_as_points(self, tmp_path, rng):
        points, colors = rng.uniform(0, 1, (500, 3)) * [1, 1, 0], np.full((500, 4), 200, np.uint8)
        trimesh.PointCloud(points, colors=colors).export(tmp_path / "cloud.ply")
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
        trimesh.creation.box((5000, 5000, 3000)).export(tmp_path / "mm.ply")
        with pytest.raises(InputError, match="give a larger voxel, or the scene's metres_per_unit"):
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
        grid = 4 * np.stack((*np.divmod(np.arange(400, dtype=np.float32), 20), np.zeros(400, np.float32)), axis=1)
        with pytest.warns(SceneWarning, match=r"lie 4 units apart, which is taken for 0\.02 m, so a unit for 0\.005 m"):
            assert unit_of(Scene(name="x", gaussians=seed_from_points(grid, np.zeros_like(grid, np.uint8)))) == 0.005

    def test_a_mesh_without_a_unit_takes_its_voxel_from_the_cameras(self, tmp_path):
        trimesh.creation.box((100.0, 100.0, 100.0)).export(tmp_path / "box.ply")
        config = SeedConfig(source="mesh", mesh=str(tmp_path / "box.ply"))
        views = Views(cameras=camera((0.0, 0.0, -400.0)), names=("a",))
        with pytest.warns(SceneWarning, match=r"voxel is 4 of"):
            g = seed(Scene(name="x", views=views), config)
        assert 2_000 < len(g) < 8_000

    def test_sources_that_the_scene_does_not_have_are_errors(self):
        scene = Scene(name="bare")
        problems = dict.fromkeys(("photographs", "depth", "tsdf"), "no views")
        for source, message in (problems | {"auto": "neither photographs", "points": "no structure"}).items():
            with pytest.raises(InputError, match=message):
                seed(scene, SeedConfig(source=source))
        room = make_room(0, views=1, width=8, height=6)
        with pytest.raises(InputError, match="no depth images"):
            seed(replace(room, views=replace(room.views, depths=None)), SeedConfig(source="depth"))

    @pytest.mark.shared
    def test_the_plush_is_usable_through_its_sfm_points(self, shared):
        scene = load_scene(shared / "scenes/plush")
        with pytest.warns(SceneWarning, match="unit of scene 'plush' is unknown"):
            g = seed(scene)
        assert 0.7 * len(scene.sfm_points) < len(g) <= len(scene.sfm_points)
        spread = np.ptp(np.quantile(g.means, [0.05, 0.95], axis=0), axis=0)
        assert g.scales.max() < 0.1 * np.linalg.norm(spread)


def moved(views: Views, other_from_world: np.ndarray) -> Views:
    """The views in another world."""
    poses = views.cameras.cam_from_world.astype(np.float64) @ invert_rigid(other_from_world)
    return replace(views, cameras=replace(views.cameras, cam_from_world=poses.astype(np.float32)))


def some_transform(number: int) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.random(random_state=number).as_matrix()
    matrix[:3, 3] = np.random.default_rng(number).uniform(-3, 3, 3)
    return matrix


def test_seeds_of_a_turned_room_are_its_turned_seeds():
    number = 0
    views = make_room(number, objects=6, views=6, width=96, height=72).views
    config = SeedConfig(voxel=0.04)
    other_from_world = some_transform(number)
    here = seed(Scene(name="room", views=views, metres_per_unit=1.0), config)
    there = seed(Scene(name="room", views=moved(views, other_from_world), metres_per_unit=1.0), config)
    assert abs(len(there) - len(here)) < 0.01 * len(here)
    expected = here.means @ other_from_world[:3, :3].T + other_from_world[:3, 3]
    distance, nearest = cKDTree(there.means).query(expected)
    same = distance < 1e-3
    assert same.mean() > 0.99
    assert np.isclose(there.scales[nearest], here.scales, rtol=0.05).all(axis=1)[same].mean() > 0.98
    normals = [normals_of(each) for each in (here, there)]
    cosines = np.einsum("ni,ni->n", normals[0] @ other_from_world[:3, :3].T, normals[1][nearest])
    assert np.mean(np.abs(cosines[same]) > 0.999) > 0.99


@pytest.mark.parametrize("number", range(2))
def test_the_axes_of_a_box_are_those_of_its_walls_and_the_origin_is_among_the_cameras(number):
    other_from_world = some_transform(number)
    views = moved(box_views(box_cameras(5, width=96, height=72, focal=67.2)), other_from_world)
    frame = room_frame(views)
    cosines = np.abs(frame[:3, :3] @ other_from_world[:3, :3])
    np.testing.assert_allclose(np.sort(cosines, axis=1), [[0, 0, 1]] * 3, atol=2e-3)
    np.testing.assert_allclose(frame[:3, :3] @ frame[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(frame[:3, :3]) == pytest.approx(1)
    center = views.cameras.centers.mean(axis=0)
    np.testing.assert_allclose(frame[:3, :3] @ center + frame[:3, 3], 0, atol=1e-5)


def test_depth_without_surfaces_has_no_frame():
    views = box_views(box_cameras(2, width=32, height=24, focal=22.0))
    for value in (0.0, np.nan, np.inf, 1e-30):
        depths = [np.full_like(depth, value) for depth in views.depths]
        frame = room_frame(replace(views, depths=depths))
        assert frame is None or np.isfinite(frame).all()
    assert room_frame(replace(views, depths=[np.zeros_like(depth) for depth in views.depths])) is None
