"""Reconstructions within a budget: its limits, and what became of them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from archives import header_of, rewrite
from command_runs import refusal
from PIL import Image
from reconstructions import cut_at

from gsencoder.core.errors import InputError
from gsencoder.data.seeding.seed import SeedConfig, seed
from gsencoder.data.splats.files import save_splat
from gsencoder.reconstruct import plan as planning
from gsencoder.reconstruct import reconstruct, sfm
from gsencoder.reconstruct.optimize import OptimizeConfig, Optimizer
from gsencoder.reconstruct.plan import Costs, ReconstructBudget
from gsencoder.reconstruct.run import CHECKPOINT_FILE, PLAN, ReconstructConfig
from gsencoder.types import Scene

SEEDS = SeedConfig(voxel=0.15)
STEPS = 8
"""In place of thousands."""


def limited(**limits: float) -> ReconstructConfig:
    """Settings with a budget."""
    return ReconstructConfig(holdout=3, validate_every=0, seeds=SEEDS, budget=ReconstructBudget(**limits))


def short(**limits: float) -> ReconstructConfig:
    """Settings with a budget that does not choose the steps."""
    return replace(limited(**limits), optimize=OptimizeConfig(steps=4, shrinks=(1,), shares=(1.0,)))


@pytest.mark.parametrize("share", [0.7, 0.1])
def test_the_file_is_no_larger_than_limited_and_as_large_as_predicted(scene, share, tmp_path):
    limit = share * len(seed(scene, SEEDS)) * 164 / 1e6
    result = reconstruct(scene, short(megabytes=limit))
    save_splat(tmp_path / "part.ply", result.gaussians)
    size = (tmp_path / "part.ply").stat().st_size / 1e6
    assert 0.5 * limit < size <= limit
    assert result.plan.megabytes == pytest.approx(size, rel=0.05, abs=0.002)
    assert result.gaussians.sh_degree == result.plan.sh_degree


def test_a_run_for_a_size_that_was_cut_ends_with_the_same_splat(scene: Scene, tmp_path: Path) -> None:
    config = short(megabytes=0.05)
    whole = reconstruct(scene, config)
    assert whole.plan.sh_degree < 2
    with cut_at(1):
        reconstruct(scene, config, work=tmp_path)
    header = header_of(tmp_path / CHECKPOINT_FILE)
    assert header["seconds"] > 0
    # What the first run took counts, however long ago that was.
    rewrite(tmp_path / CHECKPOINT_FILE, header={**header, "seconds": 1000.0})
    again = reconstruct(scene, config, work=tmp_path)
    assert again.elapsed > again.log[-1]["seconds"] > 1000 > whole.elapsed
    np.testing.assert_array_equal(again.gaussians.sh, whole.gaussians.sh)
    np.testing.assert_array_equal(again.gaussians.means, whole.gaussians.means)
    assert again.plan == replace(whole.plan, spent=again.plan.spent)


def test_what_reading_took_counts_to_limited_seconds(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planning, "MOST_STEPS", STEPS)
    result = reconstruct(scene, limited(seconds=100.0), spent=30.0)
    assert result.steps == STEPS
    assert 30 < result.plan.spent < result.elapsed < 90
    # What is done between planning and the first step, and after the last one, counts as well.
    assert result.elapsed > 30 + sum(seconds for name, seconds in result.seconds.items())
    with pytest.raises(InputError, match="budget.seconds=100: is over before the first step: 99 s"):
        reconstruct(scene, limited(seconds=100.0), spent=99.0)


@pytest.mark.parametrize(
    ("config", "problem"),
    [
        (lambda: replace(short(megabytes=1.0), optimize=OptimizeConfig(steps=0)), "optimize.steps=0 never prunes"),
        (lambda: short(seconds=9.0), "optimize.steps=4: is chosen by budget.seconds"),
        (lambda: limited(seconds=float("nan")), "seconds: expected a number above 0, got nan"),
    ],
)
def test_limits_that_mean_nothing_or_exclude_each_other_are_refused(config, problem):
    with pytest.raises(InputError, match=problem):
        config()


def test_a_size_that_no_gaussian_fits_into_is_refused_with_one_that_does(scene: Scene) -> None:
    with pytest.raises(InputError, match="budget.megabytes=0.0021: the smallest result takes 0.00212 MB"):
        reconstruct(scene, short(megabytes=0.0021))


def test_a_run_of_another_limit_and_one_of_impossible_colors_do_not_go_on(scene: Scene, tmp_path: Path) -> None:
    with cut_at(0):
        reconstruct(scene, short(), work=tmp_path)
    with pytest.raises(InputError, match=r"was made with .*budget"):
        reconstruct(scene, short(megabytes=1.0), work=tmp_path)

    header = header_of(tmp_path / CHECKPOINT_FILE)
    facts = header["facts"]
    impossible = {**header, "facts": {**facts, PLAN: {**facts[PLAN], "sh_degree": 3}}}
    rewrite(tmp_path / CHECKPOINT_FILE, header=impossible)
    with pytest.raises(InputError, match=r"colors of a degree that no run has \(3\)"):
        reconstruct(scene, short(), work=tmp_path)


def test_a_limit_with_an_option_that_it_chooses_is_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    problem = refusal(capsys, "reconstruct", str(folder), "budget.seconds=60", "preset=exact")
    assert "optimize.steps=3000: is chosen by budget.seconds; leave it (or the preset that sets it) out" in problem


class Wall:
    """A clock on which each step takes some seconds, and by trial steps 4."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, seconds: float) -> None:
        self.now = 1000.0
        advance = Optimizer.advance

        def timed(one: Optimizer) -> dict[str, float]:
            self.now += seconds
            return advance(one)

        monkeypatch.setattr(Optimizer, "advance", timed)
        costs = Costs(steps={1: 4.0, 2: 4.0}, pruning=0.0, validation=0.0, picture=0.0)
        monkeypatch.setattr(planning, "measured_costs", lambda *_: costs)

    def __call__(self) -> float:
        return self.now


@pytest.mark.parametrize(("seconds", "steps", "elapsed"), [(8.0, 13, 104), (2.5, 21, 52.5)])
def test_the_planned_steps_are_done_and_end_early_where_the_clock_runs_out(scene, monkeypatch, seconds, steps, elapsed):
    lines: list[str] = []
    result = reconstruct(scene, limited(seconds=100.0), now=Wall(monkeypatch, seconds), report=lines.append)
    assert (result.steps, result.plan.steps, result.elapsed) == (steps, 21, elapsed)
    assert result.log[-1]["step"] == steps
    assert ("the time is over after 13 of 21 steps (budget.seconds)" in lines) == (steps < 21)
    if steps == result.plan.steps:
        again = replace(limited(minutes=0.0), optimize=OptimizeConfig(steps=steps))
        np.testing.assert_array_equal(reconstruct(scene, again).gaussians.means, result.gaussians.means)


def test_a_run_that_was_cut_goes_on_by_the_clock_and_what_is_too_large_is_taken_out(scene, monkeypatch, tmp_path):
    clock, config = Wall(monkeypatch, 40.0), limited(seconds=100.0, megabytes=0.02)
    with cut_at(1):
        reconstruct(scene, config, now=clock, work=tmp_path)
    clock.now += 500
    result = reconstruct(scene, config, now=clock, work=tmp_path)
    # Before the first pruning.
    assert (result.steps, result.elapsed) == (3, 120)
    assert len(result.gaussians) == result.plan.max_gaussians


@pytest.mark.usefixtures("no_gpu")
def test_a_run_that_was_cut_goes_on_with_the_steps_that_it_planned(scene, tmp_path, monkeypatch):
    """Also on a machine that would have planned other ones."""
    monkeypatch.setattr(planning, "LEAST_STEPS", 20)
    with cut_at(7):
        reconstruct(scene, limited(minutes=0.01), work=tmp_path)
    monkeypatch.setattr(planning, "LEAST_STEPS", 900)
    lines: list[str] = []
    result = reconstruct(scene, limited(minutes=0.01), work=tmp_path, report=lines.append)
    assert result.steps == 20
    assert "13 more of 20 steps instead of 1,500 (budget.minutes)" in lines[0]


def test_a_limit_that_registering_alone_exceeds_is_refused_in_the_midst_of_it(tmp_path, monkeypatch, capsys):
    for name in "abc":
        Image.new("RGB", (64, 48)).save(tmp_path / f"{name}.jpg")
    monkeypatch.setattr(sfm, "_map", lambda *arguments: arguments[-2]())
    problem = refusal(capsys, "reconstruct", str(tmp_path), "budget.seconds=0.001", f"out={tmp_path / 'out'}")
    assert "budget.seconds=0.001: is over before the first step: " in problem
    assert "s went into registering the photographs; give more seconds, fewer photographs" in problem
