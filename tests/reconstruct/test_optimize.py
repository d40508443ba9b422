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
from walls import NEVER, wall_optimizer, wall_views

from gsencoder.core.errors import InputError
from gsencoder.data.photographs import Photographs, ScaledPhotograph
from gsencoder.data.seeding.depth import seed_from_depth
from gsencoder.reconstruct.optimize import (
    BETAS,
    EPS,
    RATES,
    Anchor,
    OptimizeConfig,
    Optimizer,
    PruneConfig,
    RowAdam,
    anchor_at,
    camera_of,
    gaussians_of,
    parameters_from,
    rows_in_view,
    rows_to_keep,
)
from gsencoder.reconstruct.run import State, load_state, save_state
from gsencoder.reconstruct.score import score
from gsencoder.render import blend
from gsencoder.render.rasterize import RasterConfig
from gsencoder.types import Cameras, Gaussians

QUICK = OptimizeConfig(steps=40, sh_degree=1, shrinks=(2, 1), shares=(0.5, 0.5))


def seeds() -> Gaussians:
    return seed_from_depth(wall_views(depth=True), voxel=0.06)


def optimizer(config: OptimizeConfig = QUICK, **changes: Any) -> Optimizer:
    return wall_optimizer(config, **{"start": 0.06, **changes})


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
    assert set(blend(splat, camera).transposed[0].tolist()) <= rows
    assert len(rows) < 600


@pytest.mark.slow
def test_a_splat_gets_nearer_to_photographs_that_it_was_not_fitted_to() -> None:
    one = optimizer(replace(QUICK, steps=40))
    assert sorted(one.view_at(3 + step) for step in range(3)) == [0, 1, 3]
    before = score(one, [2])
    terms = [one.advance() for _ in range(40)]
    after = score(one, [2])
    assert after.psnr > before.psnr + 1
    assert after.ssim > before.ssim
    assert set(terms[0]) == {"l1", "ssim", "depth"}
    assert len(gaussians_of(one.parameters)) == len(seeds())


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
    for _ in range(12):
        whole.advance()
    for _ in range(8):
        cut.advance()
    maps = cut.exposures.maps
    assert not torch.equal(maps[0], maps[1])
    state = State(adam=cut.adam, anchor=None, exposures=maps, step=cut.step, seconds=1.5, facts={"seeds": 7})
    save_state(tmp_path / "state", state, {"run": 1})
    read_state = load_state(tmp_path / "state", {"run": 1}, sh_degree=QUICK.sh_degree)
    assert (read_state.step, read_state.seconds, read_state.facts) == (8, 1.5, {"seeds": 7})
    carried_on = {"exposures": read_state.exposures, "step": read_state.step}
    again = Optimizer(read_state.adam, cut.photographs, cut.training, QUICK, prune=NEVER, **carried_on)
    for _ in range(4):
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
    config = OptimizeConfig(steps=60, sh_degree=3, shrinks=(3,), shares=(1.0,))
    one = wall_optimizer(config, start, replace(views, images=images), (0, 1, 2, 3), prune=PruneConfig(at=(0.5,)))
    for _ in range(60):
        one.advance()
    assert all(bool(torch.isfinite(value).all()) for value in one.parameters.values())
    assert len(gaussians_of(one.parameters)) > 0


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
        masked = replace(views, images=images, masks=[mask] * 4)
        one = optimizer(replace(QUICK, shrinks=(1,), shares=(1.0,)), views=masked)
        for _ in range(4):
            one.advance()
        raws.append(one.parameters)
    for name, value in raws[0].items():
        torch.testing.assert_close(value, raws[1][name], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    "changes", [{"shares": (1.0,)}, {"shrinks": (2, 1), "shares": (0.7, 0.7)}, {"shares": (0.5, float("nan"))}]
)
def test_stages_that_mean_nothing_are_refused(changes: dict[str, Any]) -> None:
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
    with pytest.raises(InputError, match=rf"none of (\d+) Gaussians \(.*\1 by {name} 1e\+09.*\)"):
        one.advance()


def test_the_stages_follow_the_shares() -> None:
    config = OptimizeConfig(steps=100, shrinks=(4, 2, 1), shares=(0.15, 0.35, 0.5))
    assert [config.shrink_at(step) for step in (0, 14, 15, 49, 50, 99)] == [4, 4, 2, 2, 1, 1]
    assert [config.degree_at(step) for step in (0, 19, 20, 40, 99)] == [0, 0, 1, 2, 2]
    assert config.rates_at(100, 2.0)["means"] == pytest.approx(0.01 * config.rates_at(0, 2.0)["means"])


def test_a_camera_that_is_astray_does_not_make_steps_larger() -> None:
    views = wall_views(20, depth=True)
    astray = views.cameras.cam_from_world.copy()
    astray[2, :3, 3] += 1e5
    far = replace(views, cameras=replace(views.cameras, cam_from_world=astray))
    extents = [wall_optimizer(QUICK, 0.3, some).extent for some in (views, far)]
    assert extents[1] < 2 * extents[0]
    distances = np.linalg.norm(views.cameras.centers - np.median(views.cameras.centers, axis=0), axis=1)
    assert extents[0] == pytest.approx(1.1 * np.quantile(distances, 0.9))


NOTHING = PruneConfig(opacity=0.0, screen=0.0, contribution=0.0)


def two_cameras() -> Cameras:
    """One looks along +z, the other stands two units to its left."""
    made = front_camera(64, 48, 50.0).select([0, 0])
    made.cam_from_world[1, 0, 3] = 2
    return made


def photos(cameras: Cameras, shrink: int) -> list[tuple[int, ScaledPhotograph]]:
    scale, black = torch.diag(torch.tensor([1 / shrink, 1 / shrink, 1])), torch.zeros(48 // shrink, 64 // shrink, 3)
    Ks = [scale @ torch.from_numpy(K) for K in cameras.Ks]
    return [(view, ScaledPhotograph(image=black, mask=None, depth=None, K=K)) for view, K in enumerate(Ks)]


@pytest.mark.parametrize("shrink", [1, 2])
def test_a_contribution_is_counted_in_pixels_of_the_photograph_whatever_size_it_is_looked_at(shrink: int) -> None:
    splat, cameras = random_gaussians(150, log_scale=-1.5), two_cameras()
    columns = [torch.bincount(b.col.long(), b.weight, 150) for b in (blend(splat, cameras, view) for view in range(2))]
    pixels = torch.maximum(*columns).numpy()
    least = float(np.median(pixels))
    config = replace(NOTHING, contribution=least)
    rows = rows_to_keep(parameters_from(splat, 0), cameras, photos(cameras, shrink), config, RasterConfig()).numpy()
    # Coarser pixels round.
    slack = 1.02 if shrink == 1 else 1.5
    clear = (pixels > slack * least) | (pixels < least / slack)
    assert clear.mean() > 0.6
    np.testing.assert_array_equal(np.isin(np.arange(150), rows)[clear], pixels[clear] > least)


@pytest.mark.parametrize("shrink", [1, 2])
def test_what_is_wider_than_a_share_of_some_picture_is_taken_out(shrink: int) -> None:
    """Spheres whose radius of three standard deviations (3.3 are drawn) is so many widths of the first picture."""
    radii = np.array([0.05, 0.2, 0.8, 1.1, 3.0])
    means, opacities = np.tile(np.float32([0, 0, 100]), (5, 1)), np.full(5, 0.99, np.float32)
    scales = np.repeat(radii[:, None] * 64 / 50 * 100 / 3, 3, axis=1).astype(np.float32)
    splat = replace(random_gaussians(5), means=means, scales=scales, opacities=opacities)
    cameras = two_cameras()
    raw, some = parameters_from(splat, 0), photos(cameras, shrink)
    everything = rows_to_keep(raw, cameras, some, NOTHING, RasterConfig())
    assert everything.tolist() == list(range(5))
    for screen, count in ((0.5, 2), (1.0, 3), (4.0, 5)):
        rows = rows_to_keep(raw, cameras, some, replace(NOTHING, screen=screen), RasterConfig())
        assert rows.tolist() == list(range(count))


def test_pruning_is_due_once_for_each_share_of_the_steps() -> None:
    config = PruneConfig(at=(0.25, 0.5, 1.0))
    assert [step for step in range(41) if config.due(step, OptimizeConfig(steps=40))] == [10, 20, 40]
    # A share of less than a step is due after the first.
    assert [step for step in range(41) if PruneConfig(at=(0.01,)).due(step, OptimizeConfig(steps=40))] == [1]


ALL = OptimizeConfig(steps=30, sh_degree=0, shrinks=(2, 1), shares=(0.5, 0.5))
PRUNED = PruneConfig(at=(0.3,))


def held(length: float) -> Optimizer:
    one = wall_optimizer(ALL, 0.1, prune=PRUNED)
    one.parameters["logit_opacities"][::7] = -9
    one.anchor = anchor_at(one.parameters, length)
    return one


@pytest.mark.usefixtures("no_jaxtyping")
@pytest.mark.parametrize("rate", [1e-3, 1e-2, 10.0])
@pytest.mark.parametrize("reach", [1e-6, 0.3])
@pytest.mark.slow
def test_what_pulls_forever_moves_no_further_than_the_reach(rate: float, reach: float) -> None:
    means = torch.zeros(3, 3)
    adam = RowAdam({"means": means})
    anchor = Anchor(means=torch.zeros(3, 3), reach=torch.full((3,), reach))
    rows = torch.tensor([0, 2])
    grads = {"means": torch.tensor([[1.0, 0, 0], [0, -1e6, 0]])}
    # Four times the steps that a pull takes to come within 1/e of its end.
    for _ in range(int(4 * max(5.0, reach / rate))):
        adam.step(rows, grads, {"means": rate})
        anchor.pull(means, rows, rate)
    assert (means[rows].norm(dim=1) <= 1.001 * reach).all()
    if rate < reach:
        assert means[0, 0] < -0.9 * reach
        assert means[2, 1] > 0.9 * reach
    assert not means[1].any()


@pytest.mark.slow
def test_an_anchor_holds_positions_and_is_pruned_with_its_gaussians_and_taken_up_with_them(tmp_path, monkeypatch):
    monkeypatch.setitem(RATES, "means", 0.03)
    whole, cut = held(0.3), held(0.3)
    for _ in range(16):
        whole.advance()
    for _ in range(12):
        cut.advance()
    assert len(cut.parameters["means"]) == len(cut.anchor.means) < len(held(0.3).parameters["means"])
    assert all(len(moments["means"]) == len(cut.anchor.means) for moments in (cut.adam.averages, cut.adam.squares))
    strayed = (cut.parameters["means"] - cut.anchor.means).norm(dim=1) / cut.anchor.reach
    # Adam's first steps on a row may be a little longer than the rate, and three coordinates each have their own.
    assert 0.1 < strayed.max() < 3**0.5
    exposures = None if cut.exposures is None else cut.exposures.maps
    state = State(adam=cut.adam, anchor=cut.anchor, exposures=exposures, step=12, seconds=0.0, facts={})
    save_state(tmp_path / "state", state, {})
    read_state = load_state(tmp_path / "state", {}, sh_degree=0)
    held_back = {"anchor": read_state.anchor, "exposures": read_state.exposures}
    again = Optimizer(read_state.adam, cut.photographs, cut.training, ALL, prune=PRUNED, step=12, **held_back)
    for _ in range(4):
        again.advance()
    for name, value in whole.parameters.items():
        assert torch.equal(value, again.parameters[name]), name


RATE = {"means": 0.1, "logits": 0.1, "sh": 0.1}


def parameters() -> dict[str, torch.Tensor]:
    torch.manual_seed(0)
    return {"means": torch.randn(50, 3), "logits": torch.randn(50), "sh": torch.randn(50, 4, 3)}


def test_with_all_rows_it_is_adam() -> None:
    ours = RowAdam({name: value.clone() for name, value in parameters().items()})
    theirs = {name: value.clone().requires_grad_() for name, value in parameters().items()}
    rates = {"means": 1e-2, "logits": 1e-1, "sh": 1e-3}
    groups = [{"params": [value], "lr": rates[name]} for name, value in theirs.items()]
    adam = torch.optim.Adam(groups, betas=BETAS, eps=EPS)
    for _ in range(20):
        grads = {name: torch.randn_like(value) for name, value in theirs.items()}
        ours.step(torch.arange(50), grads, rates)
        for name, value in theirs.items():
            value.grad = grads[name].clone()
        adam.step()
    for name, value in theirs.items():
        torch.testing.assert_close(ours.parameters[name], value.detach(), rtol=1e-5, atol=1e-6)


def test_kept_rows_keep_their_moments() -> None:
    adam = RowAdam(parameters())
    adam.step(torch.arange(50), {name: torch.randn_like(value) for name, value in adam.parameters.items()}, RATE)
    before = {name: value.clone() for name, value in adam.averages.items()}
    adam.keep(torch.tensor([1, 4]))
    for name, value in adam.averages.items():
        assert len(adam.parameters[name]) == len(value) == 2
        assert torch.equal(value, before[name][[1, 4]])


def test_kernel_and_plain_twin_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    fast, plain = RowAdam(parameters()), RowAdam(parameters())
    made = np.random.default_rng(0)
    for _ in range(10):
        rows = torch.from_numpy(np.sort(made.permutation(50)[:20]))
        grads = {name: torch.randn_like(value[rows]) for name, value in fast.parameters.items()}
        rates = dict.fromkeys(grads, 1e-2)
        fast.step(rows, grads, rates)
        with monkeypatch.context() as patched:
            patched.setattr(RowAdam, "_on_cpu", staticmethod(RowAdam._plain))
            plain.step(rows, grads, rates)
    for name, value in fast.parameters.items():
        torch.testing.assert_close(value, plain.parameters[name], rtol=1e-5, atol=1e-6)
