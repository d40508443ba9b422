"""Promises: what can be promised, in which order they win, and what is said of them."""

from dataclasses import dataclass, field, replace

import pytest

from gsencoder.core.errors import InputError
from gsencoder.core.settings import PLANNED, Budget, best_setting, check_governed, within_seconds


@dataclass(frozen=True, slots=True, kw_only=True)
class SmallBudget(Budget):
    megabytes: float | None = None
    error: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class SampledBudget(SmallBudget):
    seed: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class TimedBudget(Budget):
    error: float | None = None
    seconds: float | None = None


@dataclass(frozen=True, slots=True)
class Predicted:
    error: float
    bound: float
    cost: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Inner:
    rank: int = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class Outer:
    views: int = 0
    inner: Inner = field(default_factory=Inner)


@pytest.mark.parametrize(
    ("name", "value"),
    [("error", 0.0), ("error", 1.0), ("error", -0.1), ("megabytes", 0.0), ("megabytes", float("inf"))],
)
def test_a_promise_that_means_nothing_is_refused(name: str, value: float) -> None:
    with pytest.raises(InputError, match=f"^{name}: expected a number"):
        SmallBudget(**{name: value})


def test_a_negative_seed_is_refused_with_a_promise_and_without() -> None:
    for promised in ({}, {"error": 0.1}):
        with pytest.raises(InputError, match="^seed: expected 0 or more, got -1$"):
            SampledBudget(seed=-1, **promised)


def test_the_order_of_promises_is_that_of_all_commands_and_not_that_of_the_fields() -> None:
    assert SmallBudget(megabytes=1, error=0.1).promised == ("error", "megabytes")
    assert SmallBudget(megabytes=1).promised == ("megabytes",)
    assert SmallBudget().promised == ()


def test_a_conflict_names_both_promises_what_is_needed_and_which_one_wins() -> None:
    message = SmallBudget(error=0.01, megabytes=2).conflict("error", "megabytes", 3.25)
    assert message == "budget.error=0.01 takes about 3.25 MB, more than budget.megabytes=2; budget.error comes first"


def test_options_that_a_budget_chooses_are_refused_where_they_are_set_and_only_with_a_budget() -> None:
    keys = ("views", "inner.rank")
    for settings, named in ((Outer(views=3), "s.views=3"), (replace(Outer(), inner=Inner(rank=8)), "s.inner.rank=8")):
        with pytest.raises(InputError, match=f"^{named}: is chosen by budget.error and budget.megabytes"):
            check_governed(SmallBudget(error=0.1, megabytes=1), settings, Outer(), keys, "s")
        check_governed(SmallBudget(), settings, Outer(), keys, "s")
    check_governed(SmallBudget(error=0.1), Outer(), Outer(), keys, "s")


def test_a_promised_error_is_kept_by_what_it_stays_below_and_not_by_what_is_predicted() -> None:
    risky, at_the_limit, dear = Predicted(0.05, 0.2, 1.0), Predicted(0.06, 0.1, 2.0), Predicted(0.0, 0.0, 3.0)
    assert best_setting([risky, dear, at_the_limit], 0.1) == at_the_limit
    assert best_setting([risky, dear, at_the_limit], 0.05) == dear


def test_of_equally_cheap_settings_the_most_exact_is_chosen_and_of_equally_exact_ones_the_cheapest() -> None:
    settings = [Predicted(0.02, 0.02, 1.0), Predicted(0.01, 0.01, 1.0), Predicted(0.01, 0.01, 0.5)]
    assert best_setting(settings[:2], 0.1) == settings[1]
    assert best_setting(settings) == settings[2]


def test_promised_seconds_are_planned_with_a_share_of_them_and_a_promised_error_comes_first() -> None:
    exact, cheap, cheaper = Predicted(0.0, 0.0, 1.0), Predicted(0.1, 0.1, PLANNED), Predicted(0.2, 0.2, PLANNED)
    settings = [cheaper, exact, cheap]
    assert within_seconds(settings, exact, TimedBudget(seconds=1.0), lambda each: each.cost) == (cheap, ())
    setting, notes = within_seconds(settings, exact, TimedBudget(seconds=0.5), lambda each: each.cost)
    assert setting == cheap
    assert notes == ("budget.seconds=0.5: the fastest setting takes about 0.85 s; it is used",)
    both = TimedBudget(seconds=1.0, error=0.05)
    assert within_seconds(settings, exact, both, lambda each: each.cost) == (exact, ())
    setting, notes = within_seconds(settings, exact, both, lambda each: 2 * each.cost)
    assert setting == exact
    assert notes == ("budget.error=0.05 takes about 2 s, more than budget.seconds=1; budget.error comes first",)
