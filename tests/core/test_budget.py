"""The engine of budgets on a fake stage with known costs, and what a run reports of its limits."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from gsencoder.app.options import CommonConfig
from gsencoder.app.run import Run
from gsencoder.core.budget import (
    PLANNED,
    Budget,
    Estimate,
    check_any_limit,
    choose,
    error_bound,
    reject_options_set_by_budget,
)
from gsencoder.core.errors import InputError, SceneWarning


@dataclass(frozen=True, slots=True, kw_only=True)
class FullBudget(Budget):
    megabytes: float | None = None
    seconds: float | None = None
    error: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Inner:
    rank: int = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class Outer:
    views: int = 0
    inner: Inner = field(default_factory=Inner)


class Stage:
    """A setting is a number of views of ten: each takes a second and two megabytes and shows a tenth."""

    def __init__(self) -> None:
        self.measured: list[int] = []

    def __call__(self, views: int) -> Estimate:
        self.measured.append(views)
        error = 1 - views / 10
        return Estimate(error=error, bound=min(1.1 * error, 1), seconds=float(views), megabytes=2.0 * views)

    def chosen(self, **limits: float) -> int:
        return choose(range(1, 11), self, FullBudget(**limits)).setting


def test_the_cheapest_setting_whose_bound_keeps_the_error_is_chosen_and_few_are_measured() -> None:
    stage = Stage()
    # Of 8 views the error is 0.2 and may be 0.22.
    assert [stage.chosen(error=error) for error in (1e-9, 0.2, 0.22 + 1e-9, 0.999)] == [10, 9, 8, 1]
    assert len(stage.measured) <= 4 * 5
    limits = np.linspace(0.01, 0.99, 40)
    chosen = [stage.chosen(error=float(limit)) for limit in limits]
    assert chosen == sorted(chosen, reverse=True)


def test_the_most_exact_setting_within_seconds_and_megabytes_is_chosen() -> None:
    stage = Stage()
    assert stage.chosen(seconds=6 / PLANNED + 1e-9) == 6
    assert stage.chosen(seconds=100) == 10
    assert stage.chosen(megabytes=7.9) == 3
    assert stage.chosen(seconds=100, megabytes=7.9) == stage.chosen(seconds=3.9, megabytes=100) == 3
    fastest = choose(range(2, 11), stage, FullBudget(seconds=1))
    assert (fastest.setting, fastest.estimate.seconds) == (2, 2)
    assert fastest.notes == ("budget.seconds=1: the fastest setting takes about 2 s; it is used",)
    with pytest.raises(InputError, match=r"^budget.megabytes=1.5: the smallest result takes 2 MB; give more$"):
        stage.chosen(megabytes=1.5)


def test_an_error_comes_before_seconds_and_megabytes_which_are_named() -> None:
    choice = choose(range(1, 11), Stage(), FullBudget(error=0.5, seconds=5, megabytes=100))
    assert choice.setting == 6
    assert choice.notes == ("budget.error=0.5 takes about 6 s, more than budget.seconds=5; budget.error comes first",)
    both = choose(range(1, 11), Stage(), FullBudget(error=0.5, seconds=1, megabytes=3))
    assert ["budget.seconds" in both.notes[0], "12 MB" in both.notes[1]] == [True, True]
    assert choose(range(1, 11), Stage(), FullBudget(error=0.5, seconds=6)).notes == ()


def test_an_error_is_bounded_by_the_scatter_of_the_sample() -> None:
    assert error_bound([0.1, 0.1, 0.1], 2.0) == pytest.approx(0.2)
    parts = np.array([0.1, 0.3, 0.2, 0.4])
    assert error_bound(parts, 1.0) == pytest.approx(0.25 + 2 * parts.std(ddof=1) / 2)
    assert error_bound([0.9, 0.1], 1.0) == 1


@pytest.mark.parametrize(("name", "value"), [("error", 1.0), ("seconds", 0.0), ("megabytes", float("inf"))])
def test_a_limit_that_means_nothing_is_refused(name: str, value: float) -> None:
    with pytest.raises(InputError, match=f"^{name}: expected a number"):
        FullBudget(**{name: value})
    with pytest.raises(InputError, match="^budget: expected budget.error="):
        check_any_limit(FullBudget())


def test_options_that_a_budget_chooses_are_refused_where_they_are_set_and_only_with_a_budget() -> None:
    keys = ("views", "inner.rank")
    for settings, named in ((Outer(views=3), "s.views=3"), (replace(Outer(), inner=Inner(rank=8)), "s.inner.rank=8")):
        with pytest.raises(InputError, match=f"^{named}: is chosen by budget.error and budget.megabytes"):
            reject_options_set_by_budget(FullBudget(error=0.1, megabytes=1), settings, Outer(), keys, "s")
        reject_options_set_by_budget(FullBudget(), settings, Outer(), keys, "s")
    reject_options_set_by_budget(FullBudget(error=0.1), Outer(), Outer(), keys, "s")


def test_a_limit_that_is_kept_has_a_line_one_that_is_broken_a_warning_and_one_that_is_not_measured_says_so() -> None:
    summary = Run("encode", CommonConfig())
    predicted = {"error": float("nan"), "seconds": 1.9}
    with pytest.warns(SceneWarning, match="^error first$"):
        summary.report_choice("room", {"rank": 4}, predicted=predicted, notes=["error first"])
    assert summary.results["budget"] == {"chosen": {"rank": 4}, "predicted": {"seconds": 1.9}, "notes": ["error first"]}
    budget = FullBudget(error=0.25, seconds=2.0, megabytes=1.0)
    with pytest.warns(SceneWarning, match="^budget.seconds: the limit is 2, and it became 2.001$") as caught:
        lines = summary.report_budget(budget, {"seconds": 2.001, "megabytes": 1.0})
    assert len(caught) == 1
    assert lines == [
        "budget.error: limit 0.25, not measured (budget.check=false)",
        "budget.megabytes: limit 1, measured 1",
    ]
    assert summary.results["budget"]["limits"] == {"error": 0.25, "seconds": 2.0, "megabytes": 1.0}
    assert summary.results["budget"]["measured"] == {"seconds": 2.001, "megabytes": 1.0}
