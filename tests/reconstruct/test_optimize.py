"""Fitting: it gets better, it takes up where it stopped, it prunes what does nothing, and nothing bad gets in."""

import os
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from splats import front_camera, random_gaussians
from walls import wall_views

from gsencoder.core.errors import InputError
from gsencoder.data.photographs import Photographs
from gsencoder.data.seeding.seed import seed_from_depth
from gsencoder.reconstruct.optimize import OptimizeConfig, Optimizer, PruneConfig, rows_to_keep
from gsencoder.reconstruct.parameters import (
    RowAdam,
    State,
    camera_of,
    gaussians_of,
    load_state,
    parameters_from,
    rows_in_view,
    save_state,
)
from gsencoder.reconstruct.score import score
from gsencoder.render.rasterize import RasterConfig
from gsencoder.types import Gaussians, Views

QUICK = OptimizeConfig(steps=40, sh_degree=1, shrinks=(2, 1), shares=(0.5, 0.5))
NEVER = PruneConfig(at=())


def seeds() -> Gaussians:
    return seed_from_depth(wall_views(depth=True), voxel=0.06)


def adam_of(start: Gaussians, config: OptimizeConfig) -> RowAdam:
    return RowAdam(parameters_from(start, config.sh_degree))


def optimizer(config: OptimizeConfig = QUICK, start: Gaussians | None = None, **changes: object) -> Optimizer:
    photographs = Photographs(wall_views(depth=True))
    adam = adam_of(start or seeds(), config)
    return Optimizer(adam, photographs, [0, 1, 3], config, **{"prune": NEVER, **changes})


def test_parameters_give_back_the_splat() -> None:
    splat = random_gaussians(50, degree=1)
    gaussians = gaussians_of(parameters_from(splat, 2))
    assert gaussians.sh.shape == (50, 9, 3)
    np.testing.assert_array_equal(gaussians.sh[:, :4], splat.sh)
    assert not gaussians.sh[:, 4:].any()
    for name in ("means", "quats", "scales"):
        np.testing.assert_allclose(getattr(gaussians, name), getattr(splat, name), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(gaussians.opacities, splat.opacities.clip(1e-3, 1 - 1e-3), atol=1e-6)
    assert gaussians_of(parameters_from(splat, 0)).sh.shape == (50, 1, 3)


@pytest.mark.parametrize("log_scale", [-6.0, -2.0, 1.0])
def test_rows_in_view_are_all_that_a_picture_shows(log_scale: float) -> None:
    splat = random_gaussians(600, center=(0, 0, 1.5), log_scale=log_scale)
    camera = front_camera()
    raw = parameters_from(splat, 0)
    pose, _ = camera_of(camera, 0, "cpu")
    K = torch.from_numpy(camera.Ks[0])
    rows = set(rows_in_view(raw, pose, K, 61, 43, near=0.01, eps2d=0.3).tolist())
    from gsencoder.render import blend

    assert set(blend(splat, camera).columns.tolist()) <= rows
    assert len(rows) < 600


@pytest.mark.slow
def test_a_splat_gets_nearer_to_photographs_that_it_was_not_fitted_to() -> None:
    one = optimizer(replace(QUICK, steps=60))
    before = score(one, [2])
    terms = [one.advance() for _ in range(60)]
    after = score(one, [2])
    assert after.psnr > before.psnr + 1.5
    assert after.ssim > before.ssim
    assert set(terms[0]) == {"l1", "ssim", "depth"}
    assert len(one.gaussians()) == len(seeds())


def test_each_round_shows_every_photograph_once() -> None:
    one = optimizer()
    for turn in range(3):
        assert sorted(one.view_at(3 * turn + step) for step in range(3)) == [0, 1, 3]


@pytest.mark.skipif(os.name != "posix", reason="signals")
@pytest.mark.usefixtures("interrupts")
def test_a_signal_within_a_step_is_heard_after_it() -> None:
    whole, cut = optimizer(), optimizer()
    step = cut.adam.step

    def half(*arguments: Any) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        step(*arguments)

    cut.adam.step = half  # type: ignore[method-assign]
    with pytest.raises(KeyboardInterrupt):
        cut.advance()
    whole.advance()
    assert (cut.step, cut.is_consistent) == (1, True)
    for name, value in whole.parameters.items():
        assert torch.equal(value, cut.parameters[name]), name


@pytest.mark.slow
def test_a_state_that_was_saved_goes_on_to_the_same_bits(tmp_path: Path) -> None:
    whole, cut = optimizer(), optimizer()
    for _ in range(20):
        whole.advance()
    for _ in range(8):
        cut.advance()
    assert cut.exposures is not None
    maps = cut.exposures.maps
    assert not torch.equal(maps[0], maps[1])
    state = State(adam=cut.adam, anchor=None, exposures=maps, step=cut.step, seconds=1.5, facts={"seeds": 7})
    save_state(tmp_path / "state", state, {"run": 1})
    read_state = load_state(tmp_path / "state", {"run": 1}, sh_degree=QUICK.sh_degree)
    assert (read_state.step, read_state.seconds, read_state.facts) == (8, 1.5, {"seeds": 7})
    carried_on = {"exposures": read_state.exposures, "step": read_state.step}
    again = Optimizer(read_state.adam, cut.photographs, cut.training, QUICK, prune=NEVER, **carried_on)
    for _ in range(12):
        again.advance()
    for name, value in whole.parameters.items():
        assert torch.equal(value, again.parameters[name]), name
    with pytest.raises(InputError, match=r"run=1, and this run asks run=2; give resume=false"):
        load_state(tmp_path / "state", {"run": 2}, sh_degree=QUICK.sh_degree)
    with pytest.raises(InputError, match=r"parameters.shN"):
        load_state(tmp_path / "state", {"run": 1}, sh_degree=2)


def test_what_does_nothing_is_taken_out_and_nothing_else() -> None:
    splat, photographs = seeds(), Photographs(wall_views(depth=True))
    raw = parameters_from(splat, 0)
    raw["logit_opacities"][3] = -9
    raw["means"][5] = torch.tensor([0.0, 0, -5])
    raw["log_scales"][7] = 3
    raw["means"][9] += torch.tensor([0.0, 0, 2.0])  # Behind the wall.
    photos = [(view, photographs.at_scale(view, 2)) for view in range(4)]
    rows = rows_to_keep(raw, photographs.cameras, photos, PruneConfig(screen=0.9), RasterConfig())
    gone = sorted(set(range(len(splat))) - set(rows.tolist()))
    assert {3, 5, 7} <= set(gone)
    raw["log_scales"][7] = raw["log_scales"][8]
    rows = rows_to_keep(raw, photographs.cameras, photos, PruneConfig(screen=0.9), RasterConfig())
    assert {3, 5, 9} <= set(range(len(splat))) - set(rows.tolist())
    assert len(rows) > 0.8 * len(splat)


@pytest.mark.slow
def test_pruning_happens_when_it_is_due() -> None:
    start = seeds()
    start.opacities[:20] = 0.001
    one = optimizer(start=start, prune=PruneConfig(at=(0.5,), opacity=0.01, contribution=0.0, screen=0.0))
    counts = []
    for _ in range(40):
        one.advance()
        counts.append(len(one.parameters["means"]))
    assert counts[18] == len(start)
    assert counts[20] < len(start)
    assert all(len(moments["means"]) == counts[-1] for moments in (one.adam.averages, one.adam.squares))


@pytest.mark.usefixtures("no_jaxtyping")
@pytest.mark.slow
def test_nothing_becomes_infinite_from_the_worst_of_starts() -> None:
    """Opacities at the ends, splats behind and on the camera, needles and discs, black and saturated pictures."""
    made = np.random.default_rng(0)
    start = random_gaussians(400, center=(0, 0, 2.0))
    start.opacities[:100] = made.integers(0, 2, 100)
    start.means[100:140] = start.means[100:140] * (1, 1, -1)
    start.means[140:160] = 0
    start.scales[160:220] = (1e-6, 1e-6, 1)
    start.scales[220:280] = (1, 1, 1e-6)
    start.scales[280:290] = 1e-9
    start.scales[290:300] = 1e3
    views = wall_views()
    images = [np.array(image) for image in views.images or ()]
    images[0][:], images[1][:] = 0, 255
    photographs = Photographs(replace(views, images=images))
    config = OptimizeConfig(steps=240, sh_degree=3, shrinks=(3,), shares=(1.0,))
    one = Optimizer(adam_of(start, config), photographs, range(4), config, prune=PruneConfig(at=(0.5,)))
    for _ in range(240):
        one.advance()
    assert all(bool(torch.isfinite(value).all()) for value in one.parameters.values())
    assert len(one.gaussians()) > 0


def test_a_gradient_that_is_not_finite_stops_before_the_step() -> None:
    one = optimizer()
    one.photographs._images[one.view_at(0)] = torch.full((72, 96, 3), torch.nan)
    before = {name: value.clone() for name, value in one.parameters.items()}
    with pytest.raises(InputError, match=r"the loss l1 is not finite at step 0, photograph 'view_\d.png'"):
        one.advance()
    assert all(torch.equal(value, before[name]) for name, value in one.parameters.items())


def test_masked_pixels_do_not_count() -> None:
    views = wall_views()
    mask = np.ones((72, 96), bool)
    mask[:, :40] = False
    spoilt = [np.where(mask[..., None], image, 255).astype(np.uint8) for image in views.images or ()]
    raws = []
    for images in (views.images, spoilt):
        photographs = Photographs(replace(views, images=images, masks=[mask] * 4))
        config = replace(QUICK, shrinks=(1,), shares=(1.0,))
        one = Optimizer(adam_of(seeds(), config), photographs, range(4), config, prune=NEVER)
        for _ in range(4):
            one.advance()
        raws.append(one.parameters)
    for name, value in raws[0].items():
        torch.testing.assert_close(value, raws[1][name], rtol=1e-4, atol=1e-5)


def test_smaller_photographs_keep_their_rays() -> None:
    photographs = Photographs(wall_views(depth=True))
    whole, half = photographs.at_scale(1), photographs.at_scale(1, 2)
    assert (half.width, half.height) == (48, 36)
    torch.testing.assert_close(half.image[3, 4], whole.image[6:8, 8:10].mean(dim=(0, 1)))
    assert half.depth is not None
    assert whole.depth is not None
    torch.testing.assert_close(half.depth[3, 4], whole.depth[6:8, 8:10].mean(), rtol=1e-2, atol=0)
    ray = (5.0 - half.K[0, 2]) / half.K[0, 0]
    torch.testing.assert_close(ray, (10.0 - whole.K[0, 2]) / whole.K[0, 0])


def test_a_scene_without_photographs_is_refused() -> None:
    with pytest.raises(InputError, match="no photographs"):
        Photographs(replace(wall_views(), images=None))


@pytest.mark.parametrize(
    "changes",
    [
        {"steps": -1},
        {"sh_degree": 4},
        {"shrinks": (0,), "shares": (1.0,)},
        {"shares": (1.0,)},
        {"shrinks": (2, 1), "shares": (0.7, 0.7)},
        {"shares": (0.5, float("nan"))},
        {"empty_weight": float("nan")},
        {"anchor_sigmas": -1.0},
        {"seed": -1},
    ],
)
def test_settings_that_mean_nothing_are_refused(changes: dict[str, object]) -> None:
    with pytest.raises(InputError, match="expected"):
        OptimizeConfig(**changes)


def test_a_photograph_that_gets_too_small_is_named() -> None:
    with pytest.raises(InputError, match=r"'view_0.png' has 96×72 pixels, and 77 are needed at least.*shrinks=\[7\]"):
        optimizer(replace(QUICK, shrinks=(7,), shares=(1.0,)))


def test_a_splat_that_no_photograph_shows_is_refused_before_the_first_step() -> None:
    start = seeds()
    start.means[:, 2] *= -1
    with pytest.raises(InputError, match=r"none of \d+ Gaussians is in view of any of 3 photographs"):
        optimizer(start=start)


@pytest.mark.parametrize("name", ["opacity", "contribution"])
def test_pruning_that_leaves_nothing_stops_and_says_which_rule_took_how_many(name: str) -> None:
    one = optimizer(prune=PruneConfig(at=(0.05,), **{name: 1e9}))
    one.advance()
    with pytest.raises(InputError, match=rf"none of (\d+) Gaussians \(.*\1 by prune.{name}=1e\+09.*\); change"):
        one.advance()


def test_the_stages_follow_the_shares() -> None:
    config = OptimizeConfig(steps=100, shrinks=(4, 2, 1), shares=(0.15, 0.35, 0.5))
    assert [config.shrink_at(step) for step in (0, 14, 15, 49, 50, 99)] == [4, 4, 2, 2, 1, 1]
    assert [config.degree_at(step) for step in (0, 19, 20, 40, 99)] == [0, 0, 1, 2, 2]
    assert config.rates_at(100, 2.0)["means"] == pytest.approx(0.01 * config.rates_at(0, 2.0)["means"])


def test_a_camera_that_is_astray_does_not_make_steps_larger() -> None:
    views = wall_views(depth=True)
    poses = np.concatenate([views.cameras.cam_from_world] * 5)
    cameras = views.cameras.select([0, 1, 2, 3] * 5)
    astray = poses.copy()
    astray[2, :3, 3] += 1e5
    extents = []
    for some in (poses, astray):
        photographs = Photographs(replace(views, cameras=replace(cameras, cam_from_world=some), **_five_times(views)))
        extents.append(Optimizer(adam_of(seeds(), QUICK), photographs, range(20), QUICK, prune=NEVER).extent)
    assert extents[1] < 2 * extents[0]


def _five_times(views: Views) -> dict[str, object]:
    lists = {name: list(getattr(views, name) or ()) * 5 for name in ("images", "depths")}
    return {"names": tuple(f"{i}.png" for i in range(20)), **lists}
