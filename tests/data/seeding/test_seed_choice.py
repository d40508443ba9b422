"""Which source a scene is seeded from, and in what unit."""

from dataclasses import replace

import numpy as np
import pytest
from seed_views import camera, frames, plane_depth, same

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.scenes import load_scene
from gsencoder.data.seeding.depth import seed_from_depth
from gsencoder.data.seeding.seed import SeedConfig, seed
from gsencoder.data.synthetic import make_room
from gsencoder.types import Scene, Views


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

    @pytest.mark.shared
    def test_the_plush_is_usable_through_its_sfm_points(self, shared):
        scene = load_scene(shared / "scenes/plush")
        with pytest.warns(SceneWarning, match="unit of scene 'plush' is unknown"):
            g = seed(scene)
        assert 0.7 * len(scene.sfm_points) < len(g) <= len(scene.sfm_points)
        spread = np.ptp(np.quantile(g.means, [0.05, 0.95], axis=0), axis=0)
        assert g.scales.max() < 0.1 * np.linalg.norm(spread)
