"""Where a reconstruction begins: each source gives what it holds, and held-out photographs are not looked at."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from walls import DEPTH, TILT, wall_points, wall_views

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.photographs import Photographs
from gsencoder.data.seeding.from_photographs import DenseConfig
from gsencoder.data.seeding.seed import SeedConfig, seed_from_depth
from gsencoder.reconstruct.run import Start, initial_gaussians
from gsencoder.types import Scene

NEVER = DenseConfig(enough=0.0)


def scene(**parts: object) -> Scene:
    return Scene(**{"name": "wall", "views": wall_views(depth=True), "metres_per_unit": 1.0, **parts})


def begun(made: Scene, seeds: SeedConfig = SeedConfig(), dense: DenseConfig = NEVER) -> Start:
    assert made.views is not None
    return initial_gaussians(made, Photographs(made.views), [0, 1, 3], seeds, dense)


def test_a_splat_is_taken_as_it_is() -> None:
    splat = seed_from_depth(wall_views(depth=True), voxel=0.1)
    start = begun(scene(gaussians=splat))
    assert (start.source, start.dense) == ("splat", None)
    assert start.gaussians is splat


def test_depth_of_the_photographs_that_are_kept_is_not_looked_at() -> None:
    made = scene()
    assert made.views is not None
    assert made.views.depths is not None
    spoilt = [depth if view != 2 else depth * 0.5 for view, depth in enumerate(made.views.depths)]
    one, other = (begun(scene(views=replace(made.views, depths=depths))) for depths in (made.views.depths, spoilt))
    assert one.source == "depth"
    np.testing.assert_array_equal(one.gaussians.means, other.gaussians.means)


def test_gaussians_stand_on_a_mesh(tmp_path: Path) -> None:
    corners = np.array([[x, y, DEPTH + TILT * x] for x in (-2.0, 3.0) for y in (-1.8, 1.8)])
    trimesh.Trimesh(corners, [[0, 1, 2], [1, 3, 2]]).export(tmp_path / "wall.ply")
    config = SeedConfig(source="mesh", mesh=str(tmp_path / "wall.ply"), voxel=0.1)
    start = begun(scene(), config)
    assert start.source == "mesh"
    assert len(start.gaussians) > 1000
    means = start.gaussians.means
    np.testing.assert_allclose(means[:, 2], DEPTH + TILT * means[:, 0], atol=1e-3)


def test_a_mesh_whose_triangles_have_no_corners_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "wall.ply"
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 3\n1 0 3\n0 1 3\n3 0 1 9\n"
    )
    with pytest.raises(InputError, match=r"wall.ply: its triangles name vertices up to 9 of 3"):
        begun(scene(), SeedConfig(source="mesh", mesh=str(path), voxel=0.1))


def test_points_without_colors_are_grey_and_it_is_said_once() -> None:
    points = wall_points()
    bare = scene(views=wall_views(), sfm_points=points)
    for dense in (NEVER, DenseConfig(samples=1)):
        with pytest.warns(SceneWarning, match="40 points without colors are made mid-grey") as warned:
            start = begun(bare, dense=dense)
        assert len(warned) == 1
        grey = np.abs(start.gaussians.sh[:, 0]).max(axis=1) < 0.02
        assert 40 <= grey.sum() < 45 + 0.02 * len(grey)
        assert (len(start.gaussians) > 300) == (dense is not NEVER)


def test_nothing_to_begin_with_is_told() -> None:
    with pytest.raises(InputError, match="has no structure-from-motion points"):
        begun(scene(), SeedConfig(source="points"))
