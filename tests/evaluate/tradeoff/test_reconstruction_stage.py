"""The stage of reconstruction: whatever size is fitted, held-out photographs are looked at in one size."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gsencoder.core.errors import InputError
from gsencoder.data.photographs import Photographs
from gsencoder.data.scenes import SceneConfig
from gsencoder.data.seeding.seed import SeedConfig
from gsencoder.data.synthetic import make_room, write_room
from gsencoder.evaluate.tradeoff.stage import Inputs
from gsencoder.evaluate.tradeoff.stages import ReconstructionScene, ReconstructionSettings, reconstruction_stage
from gsencoder.reconstruct.optimize import OptimizeConfig

pytestmark = pytest.mark.slow

INPUTS = Inputs(data=SceneConfig(image_scale=0.8), seeds=SeedConfig(voxel=0.12))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("photographs") / "room"
    write_room(make_room(0, objects=3, views=4, width=80, height=60), path)
    return path


@pytest.fixture(scope="module")
def base() -> ReconstructionSettings:
    settings = reconstruction_stage(INPUTS).base
    quick = OptimizeConfig(steps=8, sh_degree=1, exposure=False)
    return replace(settings, reconstruct=replace(settings.reconstruct, optimize=quick, holdout=2))


def test_the_scores_of_the_size_that_is_judged_are_those_of_the_reconstruction_itself(
    folder: Path, base: ReconstructionSettings
) -> None:
    assert base.data == INPUTS.data
    with reconstruction_stage(INPUTS).open(folder) as scene:
        for exposure in (False, True):
            optimize = replace(base.reconstruct.optimize, exposure=exposure)
            settings = replace(base, reconstruct=replace(base.reconstruct, optimize=optimize))
            product = scene.run(settings)
            judged = scene.judge(product, settings)
            last = product.log[-1]
            assert judged.scores["psnr"].total == pytest.approx(last["psnr"], abs=1e-3)
            assert judged.scores["ssim"].total == pytest.approx(last["ssim"], abs=1e-4)
            assert judged.scores["gaussians"].total == len(product.gaussians)
            assert judged.bytes == 4 * (11 + 12) * len(product.gaussians)


def test_photographs_that_are_fitted_smaller_are_judged_in_the_size_of_all_settings(
    folder: Path, base: ReconstructionSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, sizes = ReconstructionScene(folder, INPUTS.data), list[tuple[int, int]]()
    half = replace(base, data=SceneConfig(image_scale=0.4))
    product = scene.run(half)
    at_scale = Photographs.at_scale

    def seen(self: Photographs, view: int, shrink: int = 1) -> object:
        sizes.append((int(self.cameras.widths[view]), int(self.cameras.heights[view])))
        return at_scale(self, view, shrink)

    monkeypatch.setattr(Photographs, "at_scale", seen)
    judged = scene.judge(product, half)
    assert sizes == [(64, 48)] * len(product.held_out)
    # A splat that knows a quarter of the pixels looks the sharper, the smaller it is looked at.
    assert judged.scores["ssim"].total < product.log[-1]["ssim"]


def test_what_a_prediction_of_exposures_expects_is_in_the_scores(folder: Path, base: ReconstructionSettings) -> None:
    scene = ReconstructionScene(folder, INPUTS.data)
    product = scene.run(base)
    np.testing.assert_array_equal(product.held_out_colors, np.tile(np.eye(3, 4), (len(product.held_out), 1, 1)))
    darker = replace(product, held_out_colors=0.5 * product.held_out_colors)
    assert scene.judge(darker, base).scores["psnr"].total < scene.judge(product, base).scores["psnr"].total - 2


def test_a_scene_of_which_nothing_is_held_out_is_refused(folder: Path, base: ReconstructionSettings) -> None:
    none = replace(base, reconstruct=replace(base.reconstruct, holdout=0))
    scene = ReconstructionScene(folder, INPUTS.data)
    with pytest.raises(InputError, match="room: no photograph was held out"):
        scene.judge(scene.run(none), none)
