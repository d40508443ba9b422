"""Python's `reconstruct()`: where it begins, what it returns, how it continues; and the scores of what it returns."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from reconstructions import cut_at
from walls import DEPTH, TILT, cameras, wall_optimizer, wall_points, wall_views

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.photographs import Photographs
from gsencoder.data.seeding.depth import seed_from_depth
from gsencoder.data.seeding.from_photographs import DenseConfig, covered_share, densify, outside_hull
from gsencoder.data.seeding.seed import SeedConfig
from gsencoder.reconstruct import Reconstruction, reconstruct
from gsencoder.reconstruct.optimize import RATES, OptimizeConfig, Optimizer, losses_of
from gsencoder.reconstruct.run import ReconstructConfig, Start, initial_gaussians
from gsencoder.reconstruct.score import compare, covisible_pixels, describe, score
from gsencoder.render.images import IDENTITY
from gsencoder.render.rasterize import Raster
from gsencoder.types import Scene, Views

SHORT = OptimizeConfig(steps=4, shrinks=(1,), shares=(1.0,))
QUICK = ReconstructConfig(holdout=3, validate_every=2, seeds=SeedConfig(voxel=0.15), optimize=SHORT)


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


def test_a_pixel_is_seen_where_its_point_lies_in_another_picture() -> None:
    views = wall_views(depth=True)
    mask = covisible_pixels(Photographs(views), [3], [0])[3]
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
    depths = [depth.copy() for depth in views.depths]
    depths[0][20:40] *= 0.9
    depths[1][50:60] = 0
    mask = covisible_pixels(Photographs(replace(views, depths=depths)), [1], [0])[1]
    assert not mask[21:39].any()
    assert not mask[50:60].any()
    assert mask[:18, :80].all()
    assert mask[42:49, :80].all()


def test_pixels_that_are_all_seen_score_as_the_whole_picture() -> None:
    one = wall_optimizer(OptimizeConfig(steps=4, sh_degree=0))
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
    one = wall_optimizer(OptimizeConfig(steps=4, sh_degree=0))
    bare = Photographs(wall_views())
    assert covisible_pixels(bare, [2], [0, 1]) == {}
    for seen in ({}, {2: torch.zeros(72, 96, dtype=torch.bool)}):
        scores = score(one, [2], seen)
        assert (scores.seen_psnr, scores.seen_ssim, scores.seen) == (None, None, None)
    average_by_voxel = torch.zeros(72, 96, dtype=torch.bool)
    average_by_voxel[:3] = True
    assert score(one, [2], {2: average_by_voxel}).seen_psnr is None


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
    nothing = {"means2d": torch.zeros(1, 2), "radii": torch.zeros(1)}
    raster = Raster(rgb=photo.image.clone().requires_grad_(), alpha=alpha, depth=alpha, **nothing)
    losses = partial(losses_of, raster, ssim_weight=0.0, depth_weight=0.0)
    terms = losses(photo, empty_weight=0.5)
    used = 1 - (EMPTY_ABOVE + 2) / 72
    expected = 0.5 * float(alpha.detach()[:EMPTY_ABOVE].sum()) / (72 * 96) / used
    assert float(terms["empty"].detach()) == pytest.approx(expected)
    terms["empty"].backward()
    assert (alpha.grad[:EMPTY_ABOVE] > 0).all()
    assert not alpha.grad[EMPTY_ABOVE:].any()
    assert "empty" not in losses(photo, empty_weight=0.0)
    assert "empty" not in losses(replace(photo, empty=None), empty_weight=1.0)


@pytest.mark.parametrize("weight", [0.0, 0.5])
def test_what_floats_in_empty_space_fades_and_the_wall_stays(weight: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """The seeds stand on the wall everywhere; without the term nothing acts on those before empty pixels."""
    monkeypatch.setitem(RATES, "logit_opacities", 0.5)
    monkeypatch.setattr("gsencoder.reconstruct.optimize.EMPTY_WEIGHT", weight)
    gaussians = seed_from_depth(wall_views(depth=True), voxel=0.2)
    config = OptimizeConfig(steps=12, sh_degree=0, exposure=False, shrinks=(2,), shares=(1.0,))
    one = wall_optimizer(config, gaussians, half_empty_views(), (0, 1, 2))
    before = score(one, [3])
    for _ in range(config.steps):
        one.advance()
    after = score(one, [3])
    assert before.floating > 0.8
    assert (after.floating < 0.3) == (weight > 0)
    low = one.parameters["means"][:, 1] > 0.3
    assert float(one.parameters["logit_opacities"][low].sigmoid().median()) > 0.5
    line = describe({name: value for name, value in after._asdict().items() if value is not None})
    assert f"opacity {after.floating:.3f} in empty space" in line


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
    assert cloud.swept + cloud.filled > 20
    assert not outside_hull(cloud.points, photographs, range(4)).any()
    below = wall_points(20_000)
    below = below[below[:, 1] > -0.4 * (DEPTH + TILT * below[:, 0]) / 3]
    assert covered_share(photographs, range(4), below) > 0.9 > covered_share(Photographs(wall_views()), range(4), below)


@pytest.fixture(scope="module")
def compared() -> Optimizer:
    config = OptimizeConfig(steps=2000, sh_degree=0)
    return wall_optimizer(config, 0.3, wall_views(7), (1, 2), step=400)


def test_four_photographs_are_compared_at_most_evenly_spaced(compared: Optimizer) -> None:
    names = compared.photographs.names
    shown = compare(compared, [0, 2, 3, 4, 5, 6], matched=False)
    assert len(shown) == 4
    assert (shown[0].name, shown[-1].name) == (names[0], names[6])
    assert [each.name for each in compare(compared, [3], matched=False)] == [names[3]]
    assert compare(compared, [], matched=False) == ()
    pictures = compared.pictures(3, compared.photographs.at_scale(3), IDENTITY)
    for matched, picture in ((False, pictures.expected), (True, pictures.matched)):
        (one,) = compare(compared, [3], matched=matched)
        assert abs(one.render / 255 - picture.numpy()).max() <= 0.5 / 255 + 1e-6
