"""Picture sizes and steps that fit a time."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from reconstructions import cut_at
from splats import random_gaussians
from walls import cameras, wall_views

from gsencoder.core.budget import PLANNED
from gsencoder.core.errors import InputError
from gsencoder.data.photographs import Photographs
from gsencoder.data.seeding.seed import SeedConfig
from gsencoder.reconstruct.optimize import OptimizeConfig, Optimizer, PruneConfig
from gsencoder.reconstruct.parameters import RowAdam, parameters_from
from gsencoder.reconstruct.plan import (
    LEAST_STEPS,
    STEPS_IN_SECONDS,
    ReconstructBudget,
    affordable_steps,
    choose_scale,
    spread_views,
    step_seconds,
    steps_for_minutes,
)
from gsencoder.reconstruct.run import ReconstructConfig, reconstruct
from gsencoder.types import Cameras, Scene

CPU, USUAL = torch.device("cpu"), OptimizeConfig()


def pictures(width: int, height: int) -> Cameras:
    return cameras(3, width=width, height=height)


def test_small_photographs_stay_and_phone_photographs_are_made_smaller(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.get_num_threads", lambda: 2)
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    ten = ReconstructBudget()
    assert choose_scale(pictures(320, 240), ten, CPU, USUAL) == 1
    phone = choose_scale(pictures(4000, 3000), ten, CPU, USUAL)
    assert 0.05 < phone < 0.2
    assert choose_scale(pictures(4000, 3000), ReconstructBudget(minutes=0.0), CPU, USUAL) == 1
    # More time gives larger pictures, whatever they are; a GPU needs less.
    scales = [
        choose_scale(pictures(4000, 3000), ReconstructBudget(minutes=float(m)), CPU, USUAL) for m in (3, 10, 30, 100)
    ]
    assert scales == sorted(scales)
    assert scales[0] < scales[-1]
    assert choose_scale(pictures(4000, 3000), ten, torch.device("cuda"), USUAL) > phone
    # What is chosen costs no more than there is time for.
    pixels = 4000 * 3000 * phone**2
    assert steps_for_minutes(10.0, USUAL) * step_seconds(pixels, 60_000.0, CPU, USUAL) <= 600 * 0.81


def test_for_a_limit_of_seconds_photographs_are_made_smaller_only_where_there_is_no_time_for_some_steps(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("torch.get_num_threads", lambda: 2)
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    needed = STEPS_IN_SECONDS * step_seconds(640.0 * 480.0, 60_000.0, CPU, USUAL) / (PLANNED * 0.8)

    def scale(seconds: float, *, width: int = 640, height: int = 480, spent: float = 0.0) -> float:
        return choose_scale(pictures(width, height), ReconstructBudget(seconds=seconds), CPU, USUAL, spent=spent)

    assert scale(1.01 * needed) == 1
    assert 0.6 < scale(0.75 * needed) < 1
    # What reading took is missing then.
    assert scale(1.01 * needed, spent=0.26 * needed * PLANNED) == pytest.approx(scale(0.75 * needed), abs=1e-3)
    # A reduction by less than a twentieth is none.
    assert scale(0.97 * needed) == 1
    # Where reading took more than all of it, as little as possible is left.
    assert scale(needed, width=4000, height=3000, spent=2 * needed) == scale(1.0, width=4000, height=3000)
    # Small photographs stay, since what they cost is small beside the Gaussians.
    assert scale(1.0, width=320, height=240) == 1
    assert scale(1.0, width=4000, height=3000) == pytest.approx((97_000 / 12e6) ** 0.5, rel=0.02)


def test_the_usual_photograph_decides_by_how_much_all_are_made_smaller() -> None:
    usual = pictures(4000, 3000)
    widths, heights = np.int32([4000, 4000, 12000]), np.int32([3000, 3000, 9000])
    other = replace(usual, widths=widths, heights=heights)
    assert choose_scale(other, ReconstructBudget(), CPU, USUAL) == choose_scale(usual, ReconstructBudget(), CPU, USUAL)


def test_limited_seconds_come_before_the_aim_in_minutes_and_leave_a_second_at_least() -> None:
    assert ReconstructBudget(minutes=3.0).minutes_left(1e6) == 3
    limited = ReconstructBudget(minutes=3.0, seconds=600.0)
    assert limited.minutes_left() == pytest.approx(PLANNED * 10)
    assert limited.minutes_left(60.0) == pytest.approx(PLANNED * 10 - 1)
    assert limited.minutes_left(600.0) == pytest.approx(1 / 60)


def test_cores_and_stages_count(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.cpu_count", lambda: 16)
    seconds = []
    for threads in (1, 2, 8):
        monkeypatch.setattr("torch.get_num_threads", lambda threads=threads: threads)
        seconds.append(step_seconds(300_000.0, 60_000.0, CPU, USUAL))
    assert seconds[0] > seconds[1] > seconds[2]
    whole = replace(USUAL, shrinks=(1,), shares=(1.0,))
    assert step_seconds(300_000.0, 60_000.0, CPU, whole) > step_seconds(300_000.0, 60_000.0, CPU, USUAL)


def test_on_two_cores_a_step_takes_the_seconds_that_were_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    full = replace(USUAL, shrinks=(1,), shares=(1.0,))
    measured = 1.2 * (0.03 + 0.07 + 0.075)
    for threads, cores, factor in ((2, 2, 1.0), (8, 2, 1.0), (2, 16, 1.0), (4, 4, 2**-0.8), (1, None, 2**0.8)):
        monkeypatch.setattr("torch.get_num_threads", lambda threads=threads: threads)
        monkeypatch.setattr("os.cpu_count", lambda cores=cores: cores)
        assert step_seconds(100_000.0, 60_000.0, CPU, full) == pytest.approx(factor * measured)
        assert step_seconds(100_000.0, 60_000.0, torch.device("cuda"), full) == pytest.approx(measured / 30)


def optimizer(config: OptimizeConfig) -> Optimizer:
    photographs = Photographs(wall_views(depth=True))
    made = np.random.default_rng(0)

    splat = random_gaussians(50)
    means = np.column_stack((made.uniform(-1, 1, 50), made.uniform(-1, 1, 50), np.full(50, 3.0)))
    adam = RowAdam(parameters_from(replace(splat, means=means.astype(np.float32)), config.sh_degree))
    return Optimizer(adam, photographs, range(len(photographs)), config, prune=PruneConfig())


def test_four_views_from_the_first_to_the_last_stand_for_all() -> None:
    assert spread_views(range(100, 110), 4) == [100, 103, 106, 109]
    assert spread_views([2, 3, 5, 8, 13], 4) == [2, 3, 8, 13]
    assert spread_views([7, 4], 4) == [7, 4]
    assert spread_views([7], 4) == [7]


def test_steps_that_were_asked_for_are_taken_and_the_default_fits_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    assert affordable_steps(optimizer(OptimizeConfig(steps=5000)), 0.1) == 5000
    usual = optimizer(USUAL)
    assert affordable_steps(usual, 0.0) == USUAL.steps
    assert affordable_steps(usual, 10.0) == USUAL.steps
    assert affordable_steps(usual, 0.01) == LEAST_STEPS
    assert affordable_steps(usual, 80.0) == 2 * USUAL.steps
    # Between these, a fifth of the time is left for reading and seeds.
    monkeypatch.setattr("gsencoder.reconstruct.plan.step_seconds", lambda *_: 1.0)
    assert affordable_steps(usual, 10.0) == 480


@pytest.mark.usefixtures("no_gpu")
def test_a_run_that_was_cut_goes_on_with_the_steps_that_it_planned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also on a machine that would have planned other ones."""
    scene = Scene(name="wall", views=wall_views(6, depth=True), metres_per_unit=1.0)
    config = ReconstructConfig(holdout=0, seeds=SeedConfig(voxel=0.15), budget=ReconstructBudget(minutes=0.01))
    monkeypatch.setattr("gsencoder.reconstruct.plan.LEAST_STEPS", 20)
    with cut_at(7):
        reconstruct(scene, config, work=tmp_path)
    monkeypatch.setattr("gsencoder.reconstruct.plan.LEAST_STEPS", 900)
    lines: list[str] = []
    result = reconstruct(scene, config, work=tmp_path, report=lines.append)
    assert result.steps == 20
    assert "13 more of 20 steps instead of 1,500 (budget.minutes)" in lines[0]
    assert result.seeding["steps_planned"] == 20


@pytest.mark.parametrize("minutes", [-1.0, float("inf")])
def test_a_time_that_cannot_be_is_refused(minutes: float) -> None:
    with pytest.raises(InputError, match="minutes: expected 0"):
        ReconstructBudget(minutes=minutes)
