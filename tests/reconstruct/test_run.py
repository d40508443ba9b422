"""`reconstruct()` as a Python call: what it returns, and how it continues an interrupted run."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from reconstructions import cut_at

from gsencoder.core.errors import InputError
from gsencoder.data.seeding.seed import SeedConfig
from gsencoder.reconstruct import Reconstruction, reconstruct
from gsencoder.reconstruct.optimize import OptimizeConfig
from gsencoder.reconstruct.run import ReconstructConfig
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
    assert scene.views is not None
    assert [each.name for each in result.comparisons] == [scene.views.names[view] for view in result.held_out]


def test_a_comparison_holds_the_photograph_and_the_render_of_the_same_view(
    scene: Scene, result: Reconstruction
) -> None:
    assert scene.views is not None
    assert scene.views.images is not None
    photographs = [each.photograph.astype(float) for each in result.comparisons]
    for row, (view, each) in enumerate(zip(result.held_out, result.comparisons, strict=True)):
        np.testing.assert_array_equal(each.photograph, scene.views.images[view])
        differences = [np.abs(each.render - photograph).mean() for photograph in photographs]
        assert np.argmin(differences) == row


@pytest.mark.usefixtures("no_gpu")
def test_an_interrupted_call_is_continued_from_its_folder_with_the_same_result(
    scene: Scene, result: Reconstruction, tmp_path: Path
) -> None:
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


def test_a_scene_without_views_is_refused(scene: Scene) -> None:
    with pytest.raises(InputError, match="no photographs"):
        reconstruct(replace(scene, views=None), QUICK)
