"""A limit of seconds: the clock changes the number of steps, and options that say how reproduce the splat."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from reconstructions import cut_at, refusal

from gsencoder.core.errors import InputError
from gsencoder.data.seeding.seed import SeedConfig
from gsencoder.reconstruct import Reconstruction, reconstruct, sfm
from gsencoder.reconstruct.optimize import OptimizeConfig, Optimizer, PruneConfig
from gsencoder.reconstruct.plan import Costs, ReconstructBudget
from gsencoder.reconstruct.run import ReconstructConfig
from gsencoder.types import Scene

LIMITED = ReconstructConfig(
    holdout=3, validate_every=0, seeds=SeedConfig(voxel=0.15), budget=ReconstructBudget(seconds=100.0)
)
"""By trial steps of 4 s there is time for 24 steps."""


class Wall:
    """A clock on which each step takes what a function of its number says."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, seconds: Callable[[int], float]) -> None:
        self.now = 1000.0
        advance = Optimizer.advance

        def timed(one: Optimizer) -> dict[str, float]:
            self.now += seconds(one.step)
            return advance(one)

        monkeypatch.setattr(Optimizer, "advance", timed)
        costs = Costs(steps={1: 4.0, 2: 4.0}, pruning=0.0, validation=0.0, picture=0.0)
        monkeypatch.setattr("gsencoder.reconstruct.plan.measured_costs", lambda *_: costs)

    def __call__(self) -> float:
        return self.now


def with_options_of(result: Reconstruction) -> ReconstructConfig:
    """Settings without a limit, and the steps that were taken."""
    steps = OptimizeConfig(steps=result.steps, earlier=result.plan.earlier)
    return replace(LIMITED, budget=ReconstructBudget(minutes=0.0), optimize=steps)


def check_equal(one: Reconstruction, other: Reconstruction) -> None:
    for name in ("means", "quats", "scales", "opacities", "sh"):
        np.testing.assert_array_equal(getattr(one.gaussians, name), getattr(other.gaussians, name))


@pytest.mark.parametrize(
    ("seconds", "fewest", "most"),
    [
        (lambda _: 8.0, 11, 13),
        (lambda _: 2.5, 36, 40),
        (lambda step: 2.0 if step < 10 else 6.0, 20, 24),
    ],
)
def test_the_clock_is_kept_and_the_steps_that_were_taken_reproduce_the_splat(
    scene: Scene,
    monkeypatch: pytest.MonkeyPatch,
    seconds: Callable[[int], float],
    fewest: int,
    most: int,
) -> None:
    clock = Wall(monkeypatch, seconds)
    result = reconstruct(scene, LIMITED, now=clock)
    assert fewest <= result.steps <= most
    assert 94 <= result.elapsed <= 105
    assert result.plan.earlier[0] == 24
    check_equal(reconstruct(scene, with_options_of(result)), result)


def test_a_run_that_was_cut_goes_on_by_the_clock_and_is_reproduced_too(
    scene: Scene, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    clock = Wall(monkeypatch, lambda _: 8.0)
    with cut_at(7):
        reconstruct(scene, LIMITED, now=clock, work=tmp_path)
    clock.now += 500
    result = reconstruct(scene, LIMITED, now=clock, work=tmp_path)
    assert 94 <= result.elapsed <= 105
    assert result.plan.earlier[0] == 24
    check_equal(reconstruct(scene, with_options_of(result)), result)


def test_a_schedule_does_not_depend_on_what_is_planned_later_and_is_always_completed() -> None:
    draw = np.random.default_rng(0)
    for _ in range(20):
        first, second, until = (int(draw.integers(*limits)) for limits in ((40, 90), (40, 120), (5, 30)))
        again = until + int(draw.integers(1, 9))
        plain = OptimizeConfig(steps=first)
        once = OptimizeConfig(steps=second, earlier=(first, until))
        twice = OptimizeConfig(steps=again + 3, earlier=(first, until, second, again))
        for shorter, longer, end in ((plain, once, until), (once, twice, again)):
            for step in range(end):
                assert longer.rates_at(step, 1.0) == shorter.rates_at(step, 1.0)
                assert longer.shrink_at(step) == shorter.shrink_at(step)
                assert longer.degree_at(step) == shorter.degree_at(step)
                assert PruneConfig().due(step + 1, longer) == PruneConfig().due(step + 1, shorter)
        for config in (once, twice):
            rates = [config.rates_at(step, 1.0)["means"] for step in range(config.steps + 1)]
            assert sorted(rates, reverse=True) == rates
            assert rates[-1] == pytest.approx(0.01 * config.rates_at(0, 1.0)["means"])
            for share in PruneConfig().at:
                assert any(config.completes(share, step) for step in range(1, config.steps + 1))


@pytest.mark.parametrize("earlier", [(9,), (9, 9), (9, 3, 8, 3), (20, 12)])
def test_plans_that_no_clock_makes_are_refused(earlier: tuple[int, ...]) -> None:
    with pytest.raises(InputError, match="earlier: expected"):
        OptimizeConfig(steps=12, earlier=earlier)


def test_a_limit_that_registering_alone_exceeds_is_refused_in_the_midst_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in "abc":
        Image.new("RGB", (64, 48)).save(tmp_path / f"{name}.jpg")
    monkeypatch.setattr(sfm, "_find_features", lambda *_: None)
    problem = refusal(capsys, str(tmp_path), "budget.seconds=0.001", f"out={tmp_path / 'out'}")
    assert "budget.seconds=0.001: is over before the first step: " in problem
    assert "s went into registering the photographs; give more seconds, fewer photographs" in problem
