"""The time that is announced, by a few trial steps, and the clock that changes the number of steps."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from walls import wall_views

from gsencoder.data.photographs import Photographs
from gsencoder.data.seeding.seed import seed_from_depth
from gsencoder.reconstruct import plan as expected_time
from gsencoder.reconstruct.optimize import OptimizeConfig, Optimizer, PhotographGradients, PruneConfig
from gsencoder.reconstruct.parameters import RowAdam, parameters_from
from gsencoder.reconstruct.plan import Costs, ExpectedSeconds, Pace, measured_costs
from gsencoder.reconstruct.run import ReconstructConfig
from gsencoder.reconstruct.score import Score, score
from gsencoder.types import Gaussians

CONFIG = OptimizeConfig(steps=20, sh_degree=0)
TRAINING, HELD_OUT = [0, 1, 3, 4, 5], [2]


def expected_seconds(one: Optimizer, held_out: list[int], validations: int) -> ExpectedSeconds:
    """Of all that is left."""
    return measured_costs(one, held_out).expected(one.config, one.pruning, one.step, one.config.steps, validations)


def splat() -> Gaussians:
    """A wall, and as many Gaussians again behind it."""
    wall = seed_from_depth(wall_views(6, depth=True), voxel=0.2)
    wall = replace(wall, opacities=np.full(len(wall), 0.99, np.float32), scales=2 * wall.scales)
    behind = replace(wall, means=wall.means * np.float32(1.3))
    fields = ("means", "quats", "scales", "opacities", "sh")
    return Gaussians(**{name: np.concatenate([getattr(wall, name), getattr(behind, name)]) for name in fields})


def optimizer(gaussians: Gaussians, at: tuple[float, ...] = (0.3, 0.6, 0.9)) -> Optimizer:
    photographs = Photographs(wall_views(6, depth=True))
    adam = RowAdam(parameters_from(gaussians, 0))
    return Optimizer(adam, photographs, TRAINING, CONFIG, prune=PruneConfig(at=at))


class Work:
    """A clock that counts work instead of seconds."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 0.0
        gradients = Optimizer.gradients

        def timed_gradients(one: Optimizer, view: int, shrink: int) -> PhotographGradients:
            slopes = gradients(one, view, shrink)
            self.now += len(slopes.rows) / shrink**2
            return slopes

        def timed_score(one: Optimizer, views: list[int]) -> Score:
            self.now += 500 * len(views)
            return score(one, views)

        monkeypatch.setattr(Optimizer, "gradients", timed_gradients)
        monkeypatch.setattr(expected_time, "score", timed_score)
        monkeypatch.setattr(expected_time.time, "perf_counter", lambda: self.now)


def test_a_trial_is_short_and_announces_the_work_that_is_done(monkeypatch: pytest.MonkeyPatch) -> None:
    work, one = Work(monkeypatch), optimizer(splat(), at=())
    announced = sum(expected_seconds(one, HELD_OUT, 3))
    trial, begun = work.now, work.now
    while one.step < CONFIG.steps:
        one.advance()
    assert announced == pytest.approx(work.now - begun + 3 * 500, rel=0.15)
    # Of each kind of step and of a picture three looks.
    rows = max(len(one.gradients(view, 1).rows) for view in TRAINING)
    assert trial <= 3 * (rows + rows / 4 + 500)


def test_every_pruning_is_announced_as_a_step_of_half_the_size_for_each_photograph() -> None:
    work = measured_costs(optimizer(splat()), [])
    assert work.pruning == len(TRAINING) * min(work.steps.values()) > 0
    assert work.steps.keys() == {1, 2}


def test_each_kind_of_work_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    work = Work(monkeypatch)
    one = optimizer(splat(), at=())
    steps = expected_seconds(one, [], 0).steps
    rows = [len(one.gradients(view, 1).rows) for view in (TRAINING[0], TRAINING[-1])]
    # Two stages: 6 steps of photographs of half the size, and 14 of the full size.
    assert steps == pytest.approx(np.mean(rows) * (6 / 4 + 14), rel=0.1)
    assert expected_seconds(one, HELD_OUT, 2) == pytest.approx((steps, 2 * 500))
    assert expected_seconds(one, HELD_OUT, 0) == pytest.approx((steps, 0))
    one.step = 10
    assert expected_seconds(one, [], 0).steps == pytest.approx(np.mean(rows) * 10, rel=0.1)
    one.step = 20
    assert expected_seconds(one, HELD_OUT, 0) == (0, 0)
    assert work.now > 0


def seconds_of_steps() -> Costs:
    """A second each, and of a pruning 5."""
    return Costs(steps={1: 1.0, 2: 1.0}, pruning=5.0, validation=0.0, picture=0.0)


def test_prunings_before_the_steps_that_are_asked_for_do_not_count() -> None:
    config, prune = replace(CONFIG, steps=20), PruneConfig(at=(0.25, 0.75))
    assert seconds_of_steps().expected(config, prune, 0, 20, 0) == (20, 10)
    assert seconds_of_steps().expected(config, prune, 10, 20, 0) == (10, 5)


def test_the_clock_is_looked_at_after_a_quarter_of_what_is_left_and_changes_the_steps_by_the_pace_since_then(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(expected_time, "MOST_STEPS", 70)
    one, now = optimizer(splat(), at=()), 0.0
    pace = Pace(seconds_of_steps(), one.step, 100.0, lambda: now)
    # Second and step, the steps that were planned, and those that there is time for, 70 at most.
    for second, step, planned, steps in (
        (24.0, 10, 100, 100),
        (40.0, 20, 100, 50),
        (54.0, 22, 50, 50),
        (56.0, 36, 50, 70),
        (75.0, 54, 68, 70),
        (90.0, 60, 70, 64),
        (120.0, 62, 70, 63),
    ):
        now, one.step, one.config = second, step, replace(CONFIG, steps=planned)
        assert pace.steps(one, lambda step, of: False) == steps
    # A fiftieth is changed as well.
    monkeypatch.undo()
    now, one.step = 0.0, 0
    pace = Pace(seconds_of_steps(), one.step, 100.0, lambda: now)
    one.config, one.step, now = replace(CONFIG, steps=100), 50, 52.0
    assert pace.steps(one, lambda step, of: False) == 96


def test_the_trial_changes_nothing() -> None:
    one, other = optimizer(splat()), optimizer(splat())
    assert expected_seconds(one, HELD_OUT, 2).steps > 0
    for _ in range(3):
        one.advance()
        other.advance()
    for name, value in one.parameters.items():
        assert torch.equal(value, other.parameters[name]), name
    assert one.exposures is not None
    assert other.exposures is not None
    assert torch.equal(one.exposures.maps, other.exposures.maps)


def test_validations_are_at_the_ends_and_in_between() -> None:
    every, ends = ReconstructConfig(validate_every=4), ReconstructConfig(validate_every=0)
    assert [step for step in range(11) if every.validates_at(step, 10)] == [0, 4, 8, 10]
    assert [step for step in range(11) if ends.validates_at(step, 10)] == [0, 10]
