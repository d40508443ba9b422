"""Judging: what no fitted photograph shows is told apart, and counts nowhere but in the whole picture."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from walls import wall_views

from gsencoder.data.photographs import Photographs
from gsencoder.data.seeding.seed import seed_from_depth
from gsencoder.reconstruct.optimize import OptimizeConfig, Optimizer, PruneConfig
from gsencoder.reconstruct.parameters import RowAdam, parameters_from
from gsencoder.reconstruct.score import covisible_pixels, score
from gsencoder.types import Views


def optimizer(views: Views) -> Optimizer:
    config = OptimizeConfig(steps=4, sh_degree=0)
    adam = RowAdam(parameters_from(seed_from_depth(views, voxel=0.06), 0))
    return Optimizer(adam, Photographs(views), [0, 1], config, prune=PruneConfig(at=()))


def test_a_pixel_is_seen_where_its_point_lies_in_another_picture() -> None:
    views = wall_views(depth=True)
    mask = covisible_pixels(Photographs(views), [3], [0])[3]
    assert views.depths is not None
    K, depth = views.cameras.Ks[3].astype(np.float64), views.depths[3].astype(np.float64)
    # Camera 3 stands 0.45 to the right of camera 0, and both look along z: the point moves right by f·0.45/z pixels.
    moved = np.arange(96) + 0.5 + K[0, 0] * 0.45 / depth
    inside = moved < 96
    assert 0.8 < inside.mean() < 0.95
    # At the edge of the picture a pixel may fall on either side.
    sure = np.abs(moved - 96) > 1e-3
    np.testing.assert_array_equal(mask.numpy()[sure], inside[sure])
    assert bool(covisible_pixels(Photographs(views), [3], [0, 2, 3])[3].all())


def test_what_something_hides_is_not_seen_and_what_is_not_measured_neither() -> None:
    views = wall_views(depth=True)
    assert views.depths is not None
    depths = [depth.copy() for depth in views.depths]
    depths[0][20:40] *= 0.9
    depths[1][50:60] = 0
    mask = covisible_pixels(Photographs(replace(views, depths=depths)), [1], [0])[1]
    assert not mask[21:39].any()
    assert not mask[50:60].any()
    assert mask[:18, :80].all()
    assert mask[42:49, :80].all()


def test_pixels_that_are_all_seen_score_as_the_whole_picture() -> None:
    one = optimizer(wall_views(depth=True))
    scores = score(one, [2], {2: torch.ones(72, 96, dtype=torch.bool)})
    assert (scores.seen_psnr, scores.seen) == (scores.psnr, 1.0)
    assert scores.seen_ssim == pytest.approx(scores.ssim, rel=1e-6)
    half = torch.zeros(72, 96, dtype=torch.bool)
    half[:, 48:] = True
    parts = [score(one, [2], {2: mask}) for mask in (half, ~half)]
    errors = [10 ** (-(part.seen_psnr or 0) / 10) for part in parts]
    np.testing.assert_allclose(np.mean(errors), 10 ** (-scores.psnr / 10), rtol=1e-6)
    assert [part.seen for part in parts] == [0.5, 0.5]


def test_nothing_is_said_about_seen_pixels_where_no_sensor_or_no_photograph_tells() -> None:
    one = optimizer(wall_views(depth=True))
    bare = Photographs(wall_views())
    assert covisible_pixels(bare, [2], [0, 1]) == {}
    for seen in ({}, {2: torch.zeros(72, 96, dtype=torch.bool)}):
        scores = score(one, [2], seen)
        assert (scores.seen_psnr, scores.seen_ssim, scores.seen) == (None, None, None)
    average_by_voxel = torch.zeros(72, 96, dtype=torch.bool)
    average_by_voxel[:3] = True
    assert score(one, [2], {2: average_by_voxel}).seen_psnr is None
