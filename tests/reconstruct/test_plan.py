"""Plans of a reconstruction that keep sizes, seconds and errors."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gsencoder.core.errors import InputError
from gsencoder.data.photographs import Photographs
from gsencoder.data.seeding.seed import SeedConfig, seed
from gsencoder.reconstruct import plan as planning
from gsencoder.reconstruct.optimize import OptimizeConfig, Optimizer, PruneConfig
from gsencoder.reconstruct.parameters import RowAdam, parameters_from
from gsencoder.reconstruct.plan import (
    Costs,
    Plan,
    ReconstructBudget,
    apply_plan,
    make_plan,
)
from gsencoder.reconstruct.score import MAX_COMPARISONS, split
from gsencoder.types import Scene

SEEDS = SeedConfig(voxel=0.15)


@pytest.fixture
def optimizer(scene: Scene) -> Optimizer:
    assert scene.views is not None
    photographs = Photographs(scene.views)
    adam = RowAdam(parameters_from(seed(scene, SEEDS), 2))
    return Optimizer(adam, photographs, split(photographs, 3)[0], OptimizeConfig(), prune=PruneConfig())


def costs() -> Costs:
    """Of a step 3 s, of each of three prunings 4 s."""
    return Costs(steps={1: 3.0, 2: 3.0}, pruning=4.0, validation=0.0, picture=0.0)


def planned(optimizer: Optimizer, budget: ReconstructBudget, *, spent: float = 0.0, double: bool = False) -> Plan:
    return make_plan(
        optimizer,
        budget,
        costs,
        lambda steps: 2,
        double_means=double,
        spent=lambda: spent,
    )


def test_less_room_first_costs_degrees_of_color_and_then_gaussians(optimizer: Optimizer) -> None:
    contributing = len(optimizer.contributing())
    plans = [
        planned(optimizer, ReconstructBudget(megabytes=(2048 + contributing * row) / 1e6 + 1e-9))
        for row in (164, 163, 104, 103, 68, 34)
    ]
    assert [plan.sh_degree for plan in plans] == [2, 1, 1, 0, 0, 0]
    assert [plan.most is not None and plan.most >= contributing for plan in plans] == [True] * 5 + [False]
    assert plans[-1].most == contributing // 2
    # Positions as doubles take 12 bytes more.
    apply_plan(optimizer, Plan(steps=9, sh_degree=0))
    wide = ReconstructBudget(megabytes=(2048 + contributing * 68) / 1e6)
    assert planned(optimizer, wide, double=True).most == (contributing * 68) // 80


def test_a_size_that_one_gaussian_fits_into_is_planned_with_that_one_in_a_single_color(optimizer: Optimizer) -> None:
    plan = planned(optimizer, ReconstructBudget(megabytes=(2048 + 68.5) / 1e6))
    assert (plan.sh_degree, plan.most) == (0, 1)


def test_where_nothing_contributes_yet_all_gaussians_are_to_fit(
    optimizer: Optimizer, monkeypatch: pytest.MonkeyPatch
) -> None:
    def none_left(_: Optimizer) -> None:
        raise InputError("reconstruct: pruning would leave none")

    monkeypatch.setattr(Optimizer, "contributing", none_left)
    count = len(optimizer.parameters["means"])
    for row, degree in ((164, 2), (163, 1), (103, 0)):
        size = (2048 + count * row) / 1e6 + 1e-9
        plan = planned(optimizer, ReconstructBudget(megabytes=size))
        assert plan.sh_degree == degree
        assert plan.megabytes == pytest.approx((2048 + count * (164, 104, 68)[2 - degree]) / 1e6)
        optimizer.adam = RowAdam(dict(optimizer.parameters, shN=torch.zeros(count, 8, 3)))


@pytest.mark.parametrize("limits", [{}, {"megabytes": 1.0}])
def test_a_plan_holds_the_seconds_before_its_first_step_whatever_is_limited(
    optimizer: Optimizer, limits: dict[str, float]
) -> None:
    assert planned(optimizer, ReconstructBudget(**limits), spent=7.0).spent == 7


def test_the_colors_of_a_plan_are_those_that_were_there_without_the_higher_coefficients(optimizer: Optimizer) -> None:
    optimizer.parameters["shN"].normal_()
    before = {name: value.clone() for name, value in optimizer.parameters.items()}
    apply_plan(optimizer, Plan(steps=7, sh_degree=1, most=9))
    assert (optimizer.config.steps, optimizer.config.sh_degree, optimizer.most) == (7, 1, 9)
    for name, value in optimizer.parameters.items():
        np.testing.assert_array_equal(value, before[name][:, :3] if name == "shN" else before[name])


def test_a_full_pruning_leaves_those_that_contribute_most_in_their_order(optimizer: Optimizer) -> None:
    every = optimizer.contributing()
    optimizer.most = len(every) - 1
    fewer = optimizer.contributing()
    (missing,) = set(every.tolist()) - set(fewer.tolist())
    assert fewer.tolist() == [row for row in every.tolist() if row != missing]
    optimizer.most = 1
    (best,) = optimizer.contributing().tolist()
    assert best != missing
    # The one that is left is left by any threshold that leaves one.
    optimizer.most = None
    for threshold in np.geomspace(1, 1e5, 30):
        optimizer.pruning = PruneConfig(contribution=float(threshold))
        try:
            rows = optimizer.contributing().tolist()
        except InputError:
            break
        assert best in rows
        assert len(rows) == len(every) or missing not in rows


@pytest.mark.parametrize(
    ("seconds", "steps", "total"), [(100.0, 22, 98.0), (1000.0, 100, 332.0), (50.0, 5, 47.0), (40.0, 2, 38.0)]
)
def test_seconds_buy_steps_by_what_trial_steps_take(
    optimizer: Optimizer, monkeypatch: pytest.MonkeyPatch, seconds: float, steps: int, total: float
) -> None:
    """A step takes 3 s, all else 12 s, and 20 s are spent; at most 100 steps."""
    monkeypatch.setattr(planning, "MOST_STEPS", 100)
    monkeypatch.setattr(planning, "FEW_STEPS", 5)
    plan = planned(optimizer, ReconstructBudget(seconds=seconds), spent=20.0)
    assert (plan.steps, plan.seconds, plan.spent) == (steps, pytest.approx(total), 20.0)
    few = ("budget.seconds=40: has time for 2 steps; budget.seconds=48 has for 5",)
    assert plan.notes == (few if steps < 5 else ())


def test_seconds_are_kept_for_as_many_validations_as_the_steps_have_and_for_the_pictures(optimizer: Optimizer) -> None:
    """Of the 1,500 steps that were planned there would be five times as many validations."""
    measured = replace(costs(), validation=6.0, picture=4.0)
    plan = make_plan(
        optimizer,
        ReconstructBudget(seconds=500.0),
        lambda: measured,
        lambda steps: 2 + steps // 50,
        double_means=False,
        spent=lambda: 20.0,
    )
    needed = 20 + 12 + 6.0 * (2 + plan.steps // 50) + 4.0 * MAX_COMPARISONS + 3.0 * plan.steps
    assert 485 < needed <= 500
    assert plan.seconds == pytest.approx(needed, abs=6)


def test_seconds_that_are_over_before_the_first_step_are_refused(optimizer: Optimizer) -> None:
    problem = "budget.seconds=20: is over before the first step: 20 s went into reading photographs and seeding; "
    with pytest.raises(InputError, match=problem + "give more seconds, a smaller data.image_scale"):
        planned(optimizer, ReconstructBudget(seconds=20.0), spent=19.7)
    with pytest.raises(InputError, match="budget.seconds=35: has time for 0 steps; budget.seconds=186 has for 50"):
        planned(optimizer, ReconstructBudget(seconds=35.0), spent=20.0)
