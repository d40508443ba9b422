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
from gsencoder.evaluate.tradeoff.stages import Inputs, ReconstructionSettings, make_stage
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
    settings = make_stage("reconstruction", INPUTS).base
    quick = OptimizeConfig(steps=8, sh_degree=1, exposure=False)
    return replace(settings, reconstruct=replace(settings.reconstruct, optimize=quick, holdout=2))


def test_scores_are_those_of_the_reconstruction_itself_in_the_size_that_is_judged(folder, base):
    assert base.data == INPUTS.data
    with make_stage("reconstruction", INPUTS).open(folder) as (run, judge):
        product = run(base)
        scores, size = judge(product, base)
        assert scores["psnr"].total == pytest.approx(product.log[-1]["psnr"], abs=1e-3)
        assert scores["ssim"].total == pytest.approx(product.log[-1]["ssim"], abs=1e-4)
        assert scores["gaussians"].total == len(product.gaussians)
        assert size == 4 * (11 + 12) * len(product.gaussians)
        # What a prediction of exposures expects is in the scores.
        np.testing.assert_array_equal(product.held_out_colors, np.tile(np.eye(3, 4), (len(product.held_out), 1, 1)))
        darker = replace(product, held_out_colors=0.5 * product.held_out_colors)
        assert judge(darker, base)[0]["psnr"].total < scores["psnr"].total - 2


def test_photographs_that_are_fitted_smaller_are_judged_in_the_size_of_all_settings(folder, base, monkeypatch):
    sizes = list[tuple[int, int]]()
    half = replace(base, data=SceneConfig(image_scale=0.4))
    at_scale = Photographs.at_scale

    def seen(self: Photographs, view: int, shrink: int = 1) -> object:
        sizes.append((int(self.cameras.widths[view]), int(self.cameras.heights[view])))
        return at_scale(self, view, shrink)

    with make_stage("reconstruction", INPUTS).open(folder) as (run, judge):
        product = run(half)
        monkeypatch.setattr(Photographs, "at_scale", seen)
        scores, _ = judge(product, half)
    assert sizes == [(64, 48)] * len(product.held_out)
    # A splat that knows a quarter of the pixels looks the sharper, the smaller it is looked at.
    assert scores["ssim"].total < product.log[-1]["ssim"]


def test_a_scene_of_which_nothing_is_held_out_is_refused(folder: Path, base: ReconstructionSettings) -> None:
    none = replace(base, reconstruct=replace(base.reconstruct, holdout=0))
    with make_stage("reconstruction", INPUTS).open(folder) as (run, judge):
        product = run(none)
        with pytest.raises(InputError, match="room: no photograph was held out"):
            judge(product, none)
