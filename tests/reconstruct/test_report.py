"""What people read: plans, scores and comparisons say what they were given, and nothing that is not worth a word."""

import pytest
from walls import wall_views

from gsencoder.data.photographs import Photographs
from gsencoder.data.seeding.seed import seed_from_depth
from gsencoder.reconstruct.exposure import IDENTITY
from gsencoder.reconstruct.optimize import OptimizeConfig, Optimizer, PruneConfig
from gsencoder.reconstruct.parameters import RowAdam, parameters_from
from gsencoder.reconstruct.score import MATCHED_GAIN, compare, describe, describe_plan

ROW = {"step": 5, "psnr": 24.0, "ssim": 0.9, "matched_psnr": 24.0}


@pytest.fixture(scope="module")
def optimizer() -> Optimizer:
    adam = RowAdam(parameters_from(seed_from_depth(wall_views(depth=True), voxel=0.3), 0))
    config = OptimizeConfig(steps=2000, sh_degree=0)
    return Optimizer(adam, Photographs(wall_views(7)), [1, 2], config, prune=PruneConfig(), step=400)


def test_a_plan_names_what_is_left_and_what_chose_the_number_of_steps(optimizer: Optimizer) -> None:
    size = f"2 photographs of 96×72, {len(optimizer.parameters['means']):,} Gaussians"
    left = f"{size}, 1,600 more of 2,000 steps"
    assert describe_plan(optimizer, 2000, "budget.seconds") == left
    assert describe_plan(optimizer, 3000, "budget.minutes") == f"{left} instead of 3,000 (budget.minutes)"


def test_matched_scores_are_named_where_they_are_clearly_better() -> None:
    assert describe(ROW) == "24.00 dB, SSIM 0.900"
    assert describe({**ROW, "matched_psnr": 24 + 0.9 * MATCHED_GAIN}) == "24.00 dB, SSIM 0.900"
    matched = describe({**ROW, "matched_psnr": 25.0})
    assert matched == "25.00 dB with exposures matched, 24.00 dB, SSIM 0.900 without"
    seen = describe({**ROW, "seen_psnr": 27.0, "seen_ssim": 0.95, "seen": 0.81})
    assert seen == "27.00 dB where a fitted photograph shows the surface (81%), 24.00 dB, SSIM 0.900 in all"


def test_four_photographs_are_compared_at_most_evenly_spaced(optimizer: Optimizer) -> None:
    names = optimizer.photographs.names
    shown = compare(optimizer, [0, 2, 3, 4, 5, 6], matched=False)
    assert len(shown) == 4
    assert (shown[0].name, shown[-1].name) == (names[0], names[6])
    assert [each.name for each in compare(optimizer, [3], matched=False)] == [names[3]]
    assert compare(optimizer, [], matched=False) == ()
    pictures = optimizer.pictures(3, optimizer.photographs.at_scale(3), IDENTITY)
    for matched, picture in ((False, pictures.expected), (True, pictures.matched)):
        (one,) = compare(optimizer, [3], matched=matched)
        assert abs(one.render / 255 - picture.numpy()).max() <= 0.5 / 255 + 1e-6
