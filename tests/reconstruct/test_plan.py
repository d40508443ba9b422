"""Plans: sizes of photographs, steps, colors and Gaussians that fit a time or a size."""

from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from splats import random_gaussians
from walls import cameras, wall_optimizer, wall_views

from gsencoder.core.budget import PLANNED
from gsencoder.core.errors import InputError
from gsencoder.data.seeding.depth import seed_from_depth
from gsencoder.data.seeding.seed import seed
from gsencoder.reconstruct import plan as planning
from gsencoder.reconstruct.optimize import OptimizeConfig, Optimizer, PhotographGradients, PruneConfig, RowAdam
from gsencoder.reconstruct.plan import (
    LEAST_STEPS,
    STEPS_IN_SECONDS,
    Costs,
    Plan,
    ReconstructBudget,
    affordable_steps,
    apply_plan,
    choose_scale,
    make_plan,
    measured_costs,
    step_seconds,
    steps_for_minutes,
)
from gsencoder.reconstruct.run import SeedConfig
from gsencoder.reconstruct.score import MAX_COMPARISONS, Score, score
from gsencoder.types import Cameras, Scene

CPU, USUAL = torch.device("cpu"), OptimizeConfig()


def pictures(width: int, height: int) -> Cameras:
    return cameras(3, width=width, height=height)


@pytest.fixture
def _two_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.get_num_threads", lambda: 2)
    monkeypatch.setattr("os.cpu_count", lambda: 2)


@pytest.mark.usefixtures("_two_cores")
def test_small_photographs_stay_and_phone_photographs_are_made_smaller() -> None:
    ten = ReconstructBudget()
    assert choose_scale(pictures(320, 240), ten, CPU, USUAL) == 1
    phone = choose_scale(pictures(4000, 3000), ten, CPU, USUAL)
    assert 0.05 < phone < 0.2
    assert choose_scale(pictures(4000, 3000), ReconstructBudget(minutes=0.0), CPU, USUAL) == 1
    # More time gives larger pictures, whatever they are; a GPU needs less.
    longer = [ReconstructBudget(minutes=float(minutes)) for minutes in (3, 10, 30, 100)]
    scales = [choose_scale(pictures(4000, 3000), each, CPU, USUAL) for each in longer]
    assert scales == sorted(scales)
    assert scales[0] < scales[-1]
    assert choose_scale(pictures(4000, 3000), ten, torch.device("cuda"), USUAL) > phone
    # What is chosen costs no more than there is time for.
    pixels = 4000 * 3000 * phone**2
    assert steps_for_minutes(10.0, USUAL) * step_seconds(pixels, 60_000.0, CPU, USUAL) <= 600 * 0.81
    # The median photograph decides.
    widths, heights = np.int32([4000, 4000, 12000]), np.int32([3000, 3000, 9000])
    other = replace(pictures(4000, 3000), widths=widths, heights=heights)
    assert choose_scale(other, ten, CPU, USUAL) == phone


@pytest.mark.usefixtures("_two_cores")
def test_for_a_limit_of_seconds_photographs_are_made_smaller_only_where_there_is_no_time_for_some_steps() -> None:
    needed = STEPS_IN_SECONDS * step_seconds(640.0 * 480.0, 60_000.0, CPU, USUAL) / (PLANNED * 0.8)

    def scale(seconds: float, *, width: int = 640, height: int = 480, spent: float = 0.0) -> float:
        budget = ReconstructBudget(minutes=3.0, seconds=seconds)
        return choose_scale(pictures(width, height), budget, CPU, USUAL, spent=spent)

    assert scale(1.01 * needed) == 1
    assert 0.6 < scale(0.75 * needed) < 1
    # What reading took is missing then.
    assert scale(1.01 * needed, spent=0.26 * needed * PLANNED) == pytest.approx(scale(0.75 * needed), abs=1e-3)
    # A reduction by less than a twentieth is none.
    assert scale(0.97 * needed) == 1
    # Where reading took more than all of it, as little as possible is left.
    assert scale(needed, width=4000, height=3000, spent=2 * needed) == scale(1.0, width=4000, height=3000)
    # Small photographs stay: what they cost is little next to the Gaussians.
    assert scale(1.0, width=320, height=240) == 1
    assert scale(1.0, width=4000, height=3000) == pytest.approx((97_000 / 12e6) ** 0.5, rel=0.02)


def test_on_two_cores_a_step_takes_the_seconds_that_were_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    full = replace(USUAL, shrinks=(1,), shares=(1.0,))
    measured = 1.2 * (0.03 + 0.07 + 0.075)
    for threads, cores, factor in ((2, 2, 1.0), (8, 2, 1.0), (2, 16, 1.0), (4, 4, 2**-0.8), (1, None, 2**0.8)):
        monkeypatch.setattr("torch.get_num_threads", lambda threads=threads: threads)
        monkeypatch.setattr("os.cpu_count", lambda cores=cores: cores)
        seconds = step_seconds(100_000.0, 60_000.0, CPU, full)
        assert seconds == pytest.approx(factor * measured)
        assert step_seconds(100_000.0, 60_000.0, torch.device("cuda"), full) == pytest.approx(measured / 30)
        assert step_seconds(100_000.0, 60_000.0, CPU, USUAL) < seconds


def test_steps_that_were_asked_for_are_taken_and_the_default_fits_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    splat = replace(random_gaussians(50), means=np.float32([[0, 0, 3]]).repeat(50, axis=0))
    usual = wall_optimizer(USUAL, splat)
    assert affordable_steps(wall_optimizer(OptimizeConfig(steps=5000), splat), 0.1) == 5000
    assert affordable_steps(usual, 0.0) == USUAL.steps
    assert affordable_steps(usual, 10.0) == USUAL.steps
    assert affordable_steps(usual, 0.01) == LEAST_STEPS
    assert affordable_steps(usual, 80.0) == 2 * USUAL.steps
    # Between these, a fifth of the time is left for reading and seeds.
    monkeypatch.setattr("gsencoder.reconstruct.plan.step_seconds", lambda *_: 1.0)
    assert affordable_steps(usual, 10.0) == 480


@pytest.fixture
def optimizer(scene: Scene) -> Optimizer:
    start = seed(scene, SeedConfig(voxel=0.15))
    return wall_optimizer(OptimizeConfig(), start, scene.views, (1, 2, 4, 5), prune=PruneConfig())


@pytest.fixture(autouse=True)
def costs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a step 3 s, of each of three prunings 4 s."""
    made = Costs(steps={1: 3.0, 2: 3.0}, pruning=4.0, validation=0.0, picture=0.0)
    monkeypatch.setattr(planning, "measured_costs", lambda *_: made)


def planned(
    optimizer: Optimizer, budget: ReconstructBudget, *, spent=0.0, double=False, validations=lambda steps: 2
) -> Plan:
    return make_plan(optimizer, [0, 3], budget, validations, double_means=double, began=0.0, now=lambda: spent)


def test_less_room_first_costs_degrees_of_color_and_then_gaussians(optimizer: Optimizer) -> None:
    contributing = len(optimizer.contributing())
    plans = [
        planned(optimizer, ReconstructBudget(megabytes=(2048 + contributing * row) / 1e6 + 1e-9), spent=7.0)
        for row in (164, 163, 104, 103, 68, 34)
    ]
    assert [plan.sh_degree for plan in plans] == [2, 1, 1, 0, 0, 0]
    assert [plan.max_gaussians is not None and plan.max_gaussians >= contributing for plan in plans] == [True] * 5 + [
        False
    ]
    assert plans[-1].max_gaussians == contributing // 2
    assert {plan.spent for plan in plans} == {7.0}
    one = planned(optimizer, ReconstructBudget(megabytes=(2048 + 68.5) / 1e6))
    assert (one.sh_degree, one.max_gaussians) == (0, 1)
    # Positions as doubles take 12 bytes more.
    apply_plan(optimizer, Plan(steps=9, sh_degree=0))
    wide = ReconstructBudget(megabytes=(2048 + contributing * 68) / 1e6)
    assert planned(optimizer, wide, double=True).max_gaussians == (contributing * 68) // 80


def test_where_nothing_contributes_yet_all_gaussians_are_to_fit(optimizer, monkeypatch):
    monkeypatch.setattr(Optimizer, "contributing", Mock(side_effect=InputError("pruning would leave none")))
    count = len(optimizer.parameters["means"])
    for row, degree in ((164, 2), (163, 1), (103, 0)):
        size = (2048 + count * row) / 1e6 + 1e-9
        plan = planned(optimizer, ReconstructBudget(megabytes=size))
        assert plan.sh_degree == degree
        assert plan.megabytes == pytest.approx((2048 + count * (164, 104, 68)[2 - degree]) / 1e6)
        optimizer.adam = RowAdam(dict(optimizer.parameters, shN=torch.zeros(count, 8, 3)))


def test_the_colors_of_a_plan_are_those_that_were_there_without_the_higher_coefficients(optimizer: Optimizer) -> None:
    optimizer.parameters["shN"].normal_()
    before = {name: value.clone() for name, value in optimizer.parameters.items()}
    apply_plan(optimizer, Plan(steps=7, sh_degree=1, max_gaussians=9))
    assert (optimizer.config.steps, optimizer.config.sh_degree, optimizer.max_gaussians) == (7, 1, 9)
    for name, value in optimizer.parameters.items():
        np.testing.assert_array_equal(value, before[name][:, :3] if name == "shN" else before[name])


def test_a_full_pruning_leaves_those_that_contribute_most_in_their_order(optimizer: Optimizer) -> None:
    every = optimizer.contributing()
    optimizer.max_gaussians = len(every) - 1
    fewer = optimizer.contributing()
    (missing,) = set(every.tolist()) - set(fewer.tolist())
    assert fewer.tolist() == [row for row in every.tolist() if row != missing]
    optimizer.max_gaussians = 1
    (best,) = optimizer.contributing().tolist()
    assert best != missing
    # The one that is left is left by any threshold that leaves one.
    optimizer.max_gaussians = None
    for threshold in np.geomspace(1, 1e5, 12):
        optimizer.pruning = PruneConfig(contribution=float(threshold))
        try:
            rows = optimizer.contributing().tolist()
        except InputError:
            break
        assert best in rows
        assert len(rows) == len(every) or missing not in rows


@pytest.mark.parametrize(
    ("seconds", "steps", "total"), [(100.0, 17, 83.0), (1000.0, 100, 332.0), (60.0, 6, 50.0), (45.0, 2, 38.0)]
)
def test_seconds_buy_steps_by_what_trial_steps_take(optimizer, monkeypatch, seconds, steps, total):
    """A step takes 3 s, all else 12 s, and 20 s are spent; at most 100 steps."""
    monkeypatch.setattr(planning, "MOST_STEPS", 100)
    monkeypatch.setattr(planning, "FEW_STEPS", 5)
    plan = planned(optimizer, ReconstructBudget(seconds=seconds), spent=20.0)
    assert (plan.steps, plan.seconds, plan.spent) == (steps, pytest.approx(total), 20.0)
    assert plan.until == pytest.approx(0.98 * seconds)
    few = ("budget.seconds=45: has time for 2 steps; budget.seconds=56 has for 5",)
    assert plan.notes == (few if steps < 5 else ())


def test_seconds_are_kept_for_as_many_validations_as_the_steps_have_and_for_the_pictures(optimizer, monkeypatch):
    """Of the 1,500 steps of the settings there would be five times as many validations."""
    measured = Costs(steps={1: 3.0, 2: 3.0}, pruning=4.0, validation=6.0, picture=4.0)
    monkeypatch.setattr(planning, "measured_costs", lambda *_: measured)
    budget = ReconstructBudget(seconds=500.0)
    plan = planned(optimizer, budget, spent=20.0, validations=lambda steps: 2 + steps // 50)
    needed = 20 + 12 + 6.0 * (2 + plan.steps // 50) + 4.0 * MAX_COMPARISONS + 3.0 * plan.steps
    # The validations are those of nearly as many steps.
    assert PLANNED * 500 - 15 < needed <= PLANNED * 500 + 6
    assert plan.seconds == pytest.approx(needed, abs=6)
    assert plan.until == pytest.approx(0.98 * 500 - 6 - 4 * MAX_COMPARISONS)


def test_seconds_that_are_over_before_the_first_step_are_refused(optimizer: Optimizer) -> None:
    problem = "budget.seconds=20: is over before the first step: 20 s went into reading photographs and seeding; "
    with pytest.raises(InputError, match=problem + "give more seconds, a smaller data.image_scale"):
        planned(optimizer, ReconstructBudget(seconds=20.0), spent=19.7)
    with pytest.raises(InputError, match="budget.seconds=35: has time for 0 steps; budget.seconds=215 has for 50"):
        planned(optimizer, ReconstructBudget(seconds=35.0), spent=20.0)
    with pytest.raises(InputError, match="minutes: expected 0 or more"):
        ReconstructBudget(minutes=-1.0)


TRIED = OptimizeConfig(steps=20, sh_degree=0)


def test_a_trial_is_short_announces_the_work_that_is_done_and_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """By a clock that counts work instead of seconds."""
    views, training, now = wall_views(6, depth=True), (0, 1, 3, 4, 5), 0.0
    gradients = Optimizer.gradients

    def timed_gradients(one: Optimizer, view: int, shrink: int) -> PhotographGradients:
        nonlocal now
        slopes = gradients(one, view, shrink)
        now += len(slopes.rows) / shrink**2
        return slopes

    def timed_score(one: Optimizer, views: list[int]) -> Score:
        nonlocal now
        now += 500 * len(views)
        return score(one, views)

    monkeypatch.setattr(Optimizer, "gradients", timed_gradients)
    monkeypatch.setattr(planning, "score", timed_score)
    monkeypatch.setattr(planning.time, "perf_counter", lambda: now)
    start = seed_from_depth(views, voxel=0.2)
    one, other = (wall_optimizer(TRIED, start, views, training) for _ in range(2))
    costs = measured_costs(one, [2])
    trial, begun = now, now
    assert costs.steps.keys() == {1, 2}
    assert costs.pruning == 5 * min(costs.steps.values()) > 0
    assert (costs.validation, costs.picture) == (500, 500)
    for _ in range(TRIED.steps):
        one.advance()
    announced = sum(costs.steps[TRIED.shrink_at(step)] for step in range(TRIED.steps))
    assert announced == pytest.approx(now - begun, rel=0.15)
    # Of each kind of step and of a picture three looks.
    rows = max(len(one.gradients(view, 1).rows) for view in training)
    assert trial <= 3 * (rows + rows / 4 + 500)
    for _ in range(TRIED.steps):
        other.advance()
    for name, value in one.parameters.items():
        assert torch.equal(value, other.parameters[name]), name
