"""What photographs show to be empty stays empty: no seeds, no opacity, and held-out photographs measure it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from walls import DEPTH, TILT, cameras, wall_points, wall_views

from gsencoder.data.photographs import Photographs
from gsencoder.data.seeding.from_photographs import DenseConfig, covered_share, densify, outside_hull
from gsencoder.data.seeding.seed import seed_from_depth
from gsencoder.reconstruct.optimize import RATES, OptimizeConfig, Optimizer, PruneConfig, losses_of
from gsencoder.reconstruct.parameters import RowAdam, parameters_from
from gsencoder.reconstruct.score import describe, score
from gsencoder.render.rasterize import Raster
from gsencoder.types import Views

EMPTY_ABOVE = 24
"""Rows of the pictures above this one are declared empty, and the two beside it are used for nothing."""


def half_empty_views(*, depth: bool = False) -> Views:
    empty = np.zeros((72, 96), bool)
    empty[:EMPTY_ABOVE] = True
    used = np.zeros((72, 96), bool)
    used[EMPTY_ABOVE + 2 :] = True
    return replace(wall_views(depth=depth), masks=[used] * 4, empty=[empty] * 4)


def test_the_loss_is_the_opacity_over_empty_pixels() -> None:
    photo = Photographs(half_empty_views()).at_scale(0)
    alpha = torch.rand((72, 96), generator=torch.Generator().manual_seed(0), requires_grad=True)
    raster = Raster(
        rgb=photo.image.clone().requires_grad_(),
        alpha=alpha,
        depth=alpha,
        means2d=torch.zeros(1, 2),
        radii=torch.zeros(1),
    )
    terms = losses_of(raster, photo, ssim_weight=0.0, depth_weight=0.0, empty_weight=0.5)
    used = 1 - (EMPTY_ABOVE + 2) / 72
    assert float(terms["empty"].detach()) == pytest.approx(
        0.5 * float(alpha.detach()[:EMPTY_ABOVE].sum()) / (72 * 96) / used
    )
    terms["empty"].backward()
    assert alpha.grad is not None
    assert (alpha.grad[:EMPTY_ABOVE] > 0).all()
    assert not alpha.grad[EMPTY_ABOVE:].any()
    assert "empty" not in losses_of(raster, photo, ssim_weight=0.0, depth_weight=0.0, empty_weight=0.0)
    assert "empty" not in losses_of(
        raster, replace(photo, empty=None), ssim_weight=0.0, depth_weight=0.0, empty_weight=1.0
    )


@pytest.mark.parametrize("weight", [0.0, 0.5])
def test_what_floats_in_empty_space_fades_and_the_wall_stays(weight: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """The seeds stand on the wall everywhere; without the term nothing acts on those before empty pixels."""
    monkeypatch.setitem(RATES, "logit_opacities", 0.5)
    gaussians = seed_from_depth(wall_views(depth=True), voxel=0.2)
    config = OptimizeConfig(steps=12, sh_degree=0, empty_weight=weight, exposure=False, shrinks=(2,), shares=(1.0,))
    adam = RowAdam(parameters_from(gaussians, 0))
    one = Optimizer(adam, Photographs(half_empty_views()), [0, 1, 2], config, prune=PruneConfig(at=()))
    before = score(one, [3])
    for _ in range(config.steps):
        one.advance()
    after = score(one, [3])
    assert before.floating is not None
    assert after.floating is not None
    assert before.floating > 0.8
    assert (after.floating < 0.3) == (weight > 0)
    low = one.parameters["means"][:, 1] > 0.3
    assert float(one.parameters["logit_opacities"][low].sigmoid().median()) > 0.5
    line = describe({name: value for name, value in after._asdict().items() if value is not None})
    assert f"opacity {after.floating:.3f} in empty space" in line


def test_scores_of_photographs_that_are_empty_nowhere_say_nothing_about_it() -> None:
    adam = RowAdam(parameters_from(seed_from_depth(wall_views(depth=True), voxel=0.12), 0))
    one = Optimizer(adam, Photographs(wall_views()), [0, 1], OptimizeConfig(steps=4), prune=PruneConfig(at=()))
    assert score(one, [2]).floating is None


def test_points_before_empty_pixels_of_two_photographs_are_outside_the_hull() -> None:
    photographs, points = Photographs(half_empty_views()), wall_points(400)
    outside = outside_hull(points, photographs, range(4))
    seen_empty = np.zeros(len(points), int)
    for view in range(4):
        pixels, depths = cameras().project(points.astype(np.float64), view)
        inside = cameras().in_image(pixels, depths, view)
        seen_empty += inside & (pixels[:, 1] < EMPTY_ABOVE)
    np.testing.assert_array_equal(outside, seen_empty >= 2)
    assert 0.05 < outside.mean() < 0.5
    assert not outside_hull(points, Photographs(wall_views()), range(4)).any()
    assert not outside_hull(points, photographs, [0])[seen_empty == 0].any()


def test_seeds_are_added_where_something_is_and_masked_cells_need_none() -> None:
    photographs, points = Photographs(half_empty_views()), wall_points()
    small = DenseConfig(spacing=4.0)
    cloud = densify(photographs, range(4), points, np.full((len(points), 3), 128, np.uint8), small)
    assert cloud is not None
    assert cloud.swept + cloud.filled > 20
    assert not outside_hull(cloud.points, photographs, range(4)).any()
    below = wall_points(20_000)
    below = below[below[:, 1] > -0.4 * (DEPTH + TILT * below[:, 0]) / 3]
    assert covered_share(photographs, range(4), below) > 0.9 > covered_share(Photographs(wall_views()), range(4), below)


def test_blocks_of_pixels_are_empty_where_all_are() -> None:
    photo = Photographs(half_empty_views()).at_scale(0, 5)
    assert photo.empty is not None
    assert photo.empty[: EMPTY_ABOVE // 5].all()
    assert not photo.empty[EMPTY_ABOVE // 5 :].any()


def test_what_is_empty_is_part_of_the_digest_where_something_is() -> None:
    plain, empty = half_empty_views(), half_empty_views()
    plain = replace(plain, empty=[np.zeros((72, 96), bool)] * 4)
    assert Photographs(plain).digest() == Photographs(replace(plain, empty=None)).digest()
    assert Photographs(empty).digest() != Photographs(plain).digest()
