"""Seeds from a mesh, and from depth images that are fused into one."""

import builtins

import numpy as np
import pytest
from scipy.spatial import cKDTree
from seed_views import camera, colors_of, frames, normals_of, plane_depth, sphere_depth

from gsencoder.core.errors import InputError
from gsencoder.data.seeding.seed import seed_from_mesh, seed_from_tsdf


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
