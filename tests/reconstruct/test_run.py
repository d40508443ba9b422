"""Python's `reconstruct()`: where it begins, what it returns, and how it continues an interrupted run."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from reconstructions import cut_at
from walls import DEPTH, TILT, wall_points, wall_views

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.photographs import Photographs
from gsencoder.data.seeding.depth import seed_from_depth
from gsencoder.data.seeding.from_photographs import DenseConfig
from gsencoder.data.seeding.seed import SeedConfig
from gsencoder.reconstruct import Reconstruction, reconstruct
from gsencoder.reconstruct.optimize import OptimizeConfig
from gsencoder.reconstruct.run import ReconstructConfig, Start, initial_gaussians
from gsencoder.types import Scene

QUICK = ReconstructConfig(
    holdout=3,
    validate_every=2,
    seeds=SeedConfig(voxel=0.15),
    optimize=OptimizeConfig(steps=4, shrinks=(1,), shares=(1.0,)),
)


@pytest.fixture(scope="module")
def result(scene: Scene) -> Reconstruction:
    return reconstruct(scene, QUICK)


def test_the_result_says_what_was_fitted_and_what_was_held_out(scene: Scene, result: Reconstruction) -> None:
    assert result.held_out == (0, 3)
    assert result.training == (1, 2, 4, 5)
    assert result.steps == 4
    assert [row["step"] for row in result.log] == [0, 2, 4]
    assert result.log[-1]["gaussians"] == len(result.gaussians)
    assert result.seeding["source"] == "depth"
    assert set(result.seconds) == {"read", "seeds", "plan", "optimise"}
    assert [each.name for each in result.comparisons] == [scene.views.names[view] for view in result.held_out]


@pytest.mark.usefixtures("no_gpu")
def test_an_interrupted_call_is_continued_from_its_folder_with_the_same_result(scene, result, tmp_path):
    with cut_at(2):
        reconstruct(scene, QUICK, work=tmp_path)
    continued = reconstruct(scene, QUICK, work=tmp_path)
    np.testing.assert_array_equal(continued.gaussians.means, result.gaussians.means)
    np.testing.assert_array_equal(continued.gaussians.opacities, result.gaussians.opacities)
    assert [row["step"] for row in continued.log] == [0, 2, 4]


def test_a_folder_of_other_settings_is_refused(scene: Scene, tmp_path: Path) -> None:
    reconstruct(scene, QUICK, work=tmp_path)
    with pytest.raises(InputError, match="holdout"):
        reconstruct(scene, replace(QUICK, holdout=2), work=tmp_path)
    with pytest.raises(InputError, match="author"):
        reconstruct(scene, QUICK, work=tmp_path, made_from={"author": "another"})


NEVER = DenseConfig(enough=0.0)


def wall(**parts: object) -> Scene:
    return Scene(**{"name": "wall", "views": wall_views(depth=True), "metres_per_unit": 1.0, **parts})


def begun(made: Scene, seeds: SeedConfig = SeedConfig(), dense: DenseConfig = NEVER) -> Start:
    return initial_gaussians(made, Photographs(made.views), [0, 1, 3], seeds, dense)


def test_a_splat_is_taken_as_it_is() -> None:
    splat = seed_from_depth(wall_views(depth=True), voxel=0.1)
    start = begun(wall(gaussians=splat))
    assert (start.source, start.dense) == ("splat", None)
    assert start.gaussians is splat


def test_depth_of_the_photographs_that_are_kept_is_not_looked_at() -> None:
    made = wall()
    spoilt = [depth if view != 2 else depth * 0.5 for view, depth in enumerate(made.views.depths)]
    one, other = (begun(wall(views=replace(made.views, depths=depths))) for depths in (made.views.depths, spoilt))
    assert one.source == "depth"
    np.testing.assert_array_equal(one.gaussians.means, other.gaussians.means)


def test_gaussians_stand_on_a_mesh(tmp_path: Path) -> None:
    corners = np.array([[x, y, DEPTH + TILT * x] for x in (-2.0, 3.0) for y in (-1.8, 1.8)])
    trimesh.Trimesh(corners, [[0, 1, 2], [1, 3, 2]]).export(tmp_path / "wall.ply")
    config = SeedConfig(source="mesh", mesh=str(tmp_path / "wall.ply"), voxel=0.1)
    start = begun(wall(), config)
    assert start.source == "mesh"
    assert len(start.gaussians) > 1000
    means = start.gaussians.means
    np.testing.assert_allclose(means[:, 2], DEPTH + TILT * means[:, 0], atol=1e-3)


def test_points_without_colors_are_grey_and_it_is_said_once() -> None:
    points = wall_points()
    bare = wall(views=wall_views(), sfm_points=points)
    for dense in (NEVER, DenseConfig(samples=1)):
        with pytest.warns(SceneWarning, match="40 points without colors are made mid-grey") as warned:
            start = begun(bare, dense=dense)
        assert len(warned) == 1
        grey = np.abs(start.gaussians.sh[:, 0]).max(axis=1) < 0.02
        assert 40 <= grey.sum() < 45 + 0.02 * len(grey)
        assert (len(start.gaussians) > 300) == (dense is not NEVER)
