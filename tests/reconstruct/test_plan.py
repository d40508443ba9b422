"""Promises of a reconstruction: sizes, seconds and errors, and the plans that keep them."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from archives import header_of, rewrite
from reconstructions import refusal, summary_of

from gsencoder.app import cli
from gsencoder.core.errors import InputError
from gsencoder.data.photographs import Photographs
from gsencoder.data.scenes import load_scene
from gsencoder.data.seeding.seed import SeedConfig, seed
from gsencoder.data.splats import save_splat
from gsencoder.data.synthetic.room import make_room
from gsencoder.data.synthetic.write import write_room
from gsencoder.reconstruct import plan as planning
from gsencoder.reconstruct import reconstruct
from gsencoder.reconstruct.budget import BudgetConfig
from gsencoder.reconstruct.checkpoint import CHECKPOINT_FILE, PLANNED_DEGREE
from gsencoder.reconstruct.config import ReconstructConfig
from gsencoder.reconstruct.expected_time import ExpectedSeconds
from gsencoder.reconstruct.optimize import Optimizer
from gsencoder.reconstruct.optimize_config import OptimizeConfig
from gsencoder.reconstruct.parameters import parameters_from
from gsencoder.reconstruct.plan import Plan, error_of, follow, make_plan
from gsencoder.reconstruct.prune import PruneConfig
from gsencoder.reconstruct.row_adam import RowAdam
from gsencoder.reconstruct.score import split
from gsencoder.types import Scene

SEEDS = SeedConfig(voxel=0.15)
STEPS = (2, 4, 8)
"""In place of hundreds."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rooms") / "room"
    write_room(make_room(0, objects=4, views=6, width=60, height=45), folder)
    return folder


@pytest.fixture(scope="module")
def scene(folder: Path) -> Scene:
    return load_scene(folder)


@pytest.fixture
def optimizer(scene: Scene) -> Optimizer:
    assert scene.views is not None
    training, _ = split(len(scene.views), 3)
    adam = RowAdam(parameters_from(seed(scene, SEEDS), 2))
    return Optimizer(adam, Photographs(scene.views), training, OptimizeConfig(), prune=PruneConfig())


def planned(optimizer: Optimizer, budget: BudgetConfig, *, spent: float = 0.0, double: bool = False) -> Plan:
    return make_plan(optimizer, budget, [0, 3], lambda steps: steps, double_means=double, spent=lambda: spent)


def promising(**promises: float) -> ReconstructConfig:
    """Settings with a budget."""
    return ReconstructConfig(holdout=3, validate_every=0, seeds=SEEDS, budget=BudgetConfig(**promises))


def short(**promises: float) -> ReconstructConfig:
    """Settings with a budget that does not choose the steps."""
    return replace(promising(**promises), optimize=OptimizeConfig(steps=4, shrinks=(1,), shares=(1.0,)))


def test_less_room_first_costs_degrees_of_color_and_then_gaussians(optimizer: Optimizer) -> None:
    contributing = len(optimizer.contributing())
    plans = [
        planned(optimizer, BudgetConfig(megabytes=(2048 + contributing * row) / 1e6 + 1e-9))
        for row in (164, 163, 104, 103, 68, 34)
    ]
    assert [plan.sh_degree for plan in plans] == [2, 1, 1, 0, 0, 0]
    assert [plan.most is not None and plan.most >= contributing for plan in plans] == [True] * 5 + [False]
    assert plans[-1].most == contributing // 2
    # Positions as doubles take 12 bytes more.
    follow(optimizer, Plan(steps=9, sh_degree=0))
    wide = BudgetConfig(megabytes=(2048 + contributing * 68) / 1e6)
    assert planned(optimizer, wide, double=True).most == (contributing * 68) // 80


def test_a_size_that_one_gaussian_fits_into_is_planned_with_that_one_in_a_single_color(optimizer: Optimizer) -> None:
    plan = planned(optimizer, BudgetConfig(megabytes=(2048 + 68.5) / 1e6))
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
        plan = planned(optimizer, BudgetConfig(megabytes=size))
        assert plan.sh_degree == degree
        assert plan.megabytes == pytest.approx((2048 + count * (164, 104, 68)[2 - degree]) / 1e6)
        optimizer.adam = RowAdam(dict(optimizer.parameters, shN=torch.zeros(count, 8, 3)))


def test_an_error_is_that_of_surfaces_that_a_fitted_photograph_shows_where_these_are_known() -> None:
    assert error_of({"ssim": 0.5, "seen_ssim": 0.75}) == 0.25
    assert error_of({"ssim": 0.5}) == 0.5


@pytest.mark.parametrize("promises", [{}, {"error": 0.5}, {"megabytes": 1.0}])
def test_a_plan_holds_the_seconds_before_its_first_step_whatever_is_promised(
    optimizer: Optimizer, promises: dict[str, float]
) -> None:
    assert planned(optimizer, BudgetConfig(**promises), spent=7.0).spent == 7


def test_the_colors_of_a_plan_are_those_that_were_there_without_the_higher_coefficients(optimizer: Optimizer) -> None:
    optimizer.parameters["shN"].normal_()
    before = {name: value.clone() for name, value in optimizer.parameters.items()}
    follow(optimizer, Plan(steps=7, sh_degree=1, most=9))
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


@pytest.mark.parametrize("share", [0.7, 0.1])
def test_the_file_is_no_larger_than_promised_and_as_large_as_predicted(
    scene: Scene, share: float, tmp_path: Path
) -> None:
    promise = share * len(seed(scene, SEEDS)) * 164 / 1e6
    result = reconstruct(scene, short(megabytes=promise))
    save_splat(tmp_path / "part.ply", result.gaussians)
    size = (tmp_path / "part.ply").stat().st_size / 1e6
    assert 0.5 * promise < size <= promise
    assert result.plan.megabytes == pytest.approx(size, rel=0.05, abs=0.002)
    assert result.gaussians.sh_degree == result.plan.sh_degree


@pytest.fixture(scope="module")
def errors(scene: Scene) -> list[float]:
    """After each of `STEPS`."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(planning, "STEPS", STEPS)
        unreachable = reconstruct(scene, promising(error=1e-6))
    assert [row["step"] for row in unreachable.log] == [0, *STEPS]
    return [error_of(row) for row in unreachable.log[1:]]


@pytest.mark.parametrize("number", range(len(STEPS)))
def test_a_promised_error_takes_the_fewest_steps_that_reach_it(
    scene: Scene, errors: list[float], number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(planning, "STEPS", STEPS)
    result = reconstruct(scene, promising(error=errors[number]))
    first = next(index for index, error in enumerate(errors) if error <= errors[number])
    assert result.steps == STEPS[first]
    assert error_of(result.log[-1]) == errors[first]
    assert result.seeding["steps_planned"] == STEPS[first]


@pytest.mark.parametrize(
    ("errors", "steps"),
    [
        ([0.9, 0.8], 150),
        ([0.9, 0.8, 0.85], 200),
        ([0.9, 0.8, 0.85, 0.79], 300),
        ([0.9, 0.8, 0.85, 0.8], 200),
        ([0.9, 0.9, 0.9], 150),
        ([0.9, 0.4], 100),
    ],
)
def test_an_error_that_two_looks_did_not_make_smaller_is_given_up(errors: list[float], steps: int) -> None:
    rows = [{"step": 0, "ssim": 0.0, "psnr": 9.0}]
    rows += [{"step": step, "ssim": 1 - error} for step, error in zip(planning.STEPS, errors, strict=False)]
    # Validations between two looks say nothing.
    rows.insert(1, {"step": 30, "ssim": 0.55})
    plan = Plan(steps=int(rows[-1]["step"]), sh_degree=2)
    longer = planning.extended(plan, BudgetConfig(error=0.5), rows)
    assert longer.steps == steps
    given_up = errors[-2:] == [0.85, 0.8] or errors == [0.9, 0.9, 0.9]
    assert bool(longer.notes) == given_up
    if errors[-1] == 0.8 and given_up:
        assert longer.notes == (
            "budget.error=0.5: it has not fallen since step 100 (0.8000), so no more steps are done",
        )


@pytest.mark.parametrize("cut", [4, 5])
def test_a_run_for_an_error_that_was_cut_ends_with_the_same_splat(
    scene: Scene, errors: list[float], cut: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(planning, "STEPS", STEPS)
    config = promising(error=errors[-1])
    whole, advance = reconstruct(scene, config), Optimizer.advance

    def stop(self: Optimizer) -> dict[str, float]:
        if self.step == cut:
            raise KeyboardInterrupt
        return advance(self)

    with monkeypatch.context() as patched:
        patched.setattr(Optimizer, "advance", stop)
        with pytest.raises(KeyboardInterrupt):
            reconstruct(scene, config, work=tmp_path)
    assert header_of(tmp_path / CHECKPOINT_FILE)["facts"]["steps_planned"] == STEPS[-1]
    again = reconstruct(scene, config, work=tmp_path)
    assert again.steps == whole.steps
    assert [row["step"] for row in again.log] == [row["step"] for row in whole.log]
    for name in ("means", "quats", "scales", "opacities", "sh"):
        np.testing.assert_array_equal(getattr(again.gaussians, name), getattr(whole.gaussians, name))


def test_a_run_for_a_size_that_was_cut_ends_with_the_same_splat(
    scene: Scene, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    config, advance = short(megabytes=0.05), Optimizer.advance
    whole = reconstruct(scene, config)
    assert whole.plan.sh_degree < 2

    def stop(self: Optimizer) -> dict[str, float]:
        if self.step == 1:
            raise KeyboardInterrupt
        return advance(self)

    with monkeypatch.context() as patched:
        patched.setattr(Optimizer, "advance", stop)
        with pytest.raises(KeyboardInterrupt):
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


@pytest.mark.parametrize(
    ("seconds", "steps", "total", "broken"),
    [(100.0, 17, 83.0, False), (1000.0, 100, 332.0, False), (50.0, 5, 47.0, False), (20.0, 5, 47.0, True)],
)
def test_seconds_buy_steps_by_what_trial_steps_take(
    optimizer: Optimizer, monkeypatch: pytest.MonkeyPatch, seconds: float, steps: int, total: float, broken: bool
) -> None:
    """A step takes 3 s, all else 12 s, and 20 s are spent; 0.85 of what is promised is planned with, between 5 and
    100 steps. Those that are tried are as many as there may be time for."""
    tried = []

    def expected(one: Optimizer, _: object, validations: int) -> ExpectedSeconds:
        tried.append((one.config.steps, validations))
        return ExpectedSeconds(3.0 * one.config.steps, 12.0)

    monkeypatch.setattr(planning, "expected_seconds", expected)
    monkeypatch.setattr(planning, "affordable_steps", lambda _, minutes: round(60 * minutes))
    monkeypatch.setattr(planning, "STEPS", (5, 100))
    plan = planned(optimizer, BudgetConfig(seconds=seconds), spent=20.0)
    assert (plan.steps, plan.seconds, plan.spent) == (steps, pytest.approx(total), 20.0)
    assert tried == [(min(100, max(1, round(0.85 * seconds - 20))),) * 2]
    assert bool(plan.notes) == broken
    if broken:
        assert plan.notes == ("budget.seconds=20: the fewest steps, 5, take about 47 s in all; they are done",)


def test_what_reading_took_counts_to_promised_seconds(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planning, "STEPS", STEPS)
    result = reconstruct(scene, promising(seconds=100.0), spent=30.0)
    assert result.steps == STEPS[-1]
    assert 30 < result.plan.spent < result.elapsed < 90
    # What is done between planning and the first step, and after the last one, counts as well.
    assert result.elapsed > 30 + sum(seconds for name, seconds in result.seconds.items())
    late = reconstruct(scene, promising(seconds=100.0), spent=99.0)
    assert late.steps == STEPS[0]


@pytest.mark.parametrize(
    ("config", "problem"),
    [
        (lambda: replace(promising(error=0.1), holdout=0), "held-out photographs, and holdout=0 holds out none"),
        (lambda: replace(short(megabytes=1.0), prune=PruneConfig(at=())), "prune.at=.. never prunes"),
        (lambda: replace(short(megabytes=1.0), optimize=OptimizeConfig(steps=0)), "optimize.steps=0 never prunes"),
        (lambda: short(seconds=9.0), "optimize.steps=4: is chosen by budget.seconds"),
        (lambda: short(error=0.1), "optimize.steps=4: is chosen by budget.error"),
        (lambda: promising(error=1.0), "error: expected a number between 0 and 1, got 1.0"),
        (lambda: promising(seconds=float("nan")), "seconds: expected a number above 0, got nan"),
    ],
)
def test_promises_that_mean_nothing_or_exclude_each_other_are_refused(
    config: Callable[[], ReconstructConfig], problem: str
) -> None:
    with pytest.raises(InputError, match=problem):
        config()


def test_a_size_that_no_gaussian_fits_into_is_refused_with_one_that_does(scene: Scene) -> None:
    with pytest.raises(
        InputError, match="budget.megabytes=0.0021: not one Gaussian fits; a splat of one takes 0.002116"
    ):
        reconstruct(scene, short(megabytes=0.0021))


def test_a_run_of_an_earlier_version_goes_on_and_one_of_another_promise_does_not(
    scene: Scene, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def stop(_: Optimizer) -> dict[str, float]:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(Optimizer, "advance", stop)
        with pytest.raises(KeyboardInterrupt):
            reconstruct(scene, short(), work=tmp_path)
    with pytest.raises(InputError, match=r"was made with .*budget"):
        reconstruct(scene, short(megabytes=1.0), work=tmp_path)

    header = header_of(tmp_path / CHECKPOINT_FILE)
    impossible = {**header, "facts": {**header["facts"], PLANNED_DEGREE: 3}}
    rewrite(tmp_path / CHECKPOINT_FILE, header=impossible)
    with pytest.raises(InputError, match=r"colors of a degree that no run has \(3\)"):
        reconstruct(scene, short(), work=tmp_path)
    header["settings"]["budget"] = {"minutes": 10.0}
    header["facts"] = {name: header["facts"][name] for name in ("seeds", "source", "steps_planned")}
    rewrite(tmp_path / CHECKPOINT_FILE, header=header)
    assert reconstruct(scene, short(), work=tmp_path).steps == 4


def test_promises_and_what_became_of_them_are_printed_and_recorded(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(planning, "STEPS", STEPS)
    words = ["reconstruct", str(folder), f"out={tmp_path / 'out'}", "seeds.voxel=0.15", "holdout=3"]
    words += ["data.image_scale=0.5"]
    assert cli.main([*words, "budget.error=1e-4", "budget.seconds=500", "budget.megabytes=0.04"]) == 0
    printed = capsys.readouterr()
    results = summary_of(tmp_path / "out")["results"]
    budget = results["budget"]
    assert budget["promised"] == {"error": 1e-4, "seconds": 500.0, "megabytes": 0.04}
    assert budget["chosen"]["steps"] == STEPS[-1]
    assert budget["chosen"]["image_scale"] == 0.5
    assert 0 < results["gaussians"] <= budget["chosen"]["gaussians"] < 0.04e6 / 68
    assert budget["realised"]["megabytes"] == (tmp_path / "out" / "splat.ply").stat().st_size / 1e6 <= 0.04
    assert 0.001 < budget["realised"]["error"] < 1
    assert "budget.megabytes: promised 0.04, realised 0.0" in printed.out
    assert "budget.seconds: promised 500, realised" in printed.out
    assert f"budget.error: promised 0.0001, and it became {budget['realised']['error']:.4g}" in printed.err


def test_a_promise_beside_an_option_that_it_chooses_is_refused(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    problem = refusal(capsys, str(folder), "budget.seconds=60", "preset=exact")
    assert "optimize.steps=3000: is chosen by budget.seconds; leave it (or the preset that sets it) out" in problem
