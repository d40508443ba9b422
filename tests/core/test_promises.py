"""Promises: what can be promised, in which order they win, and what is said of them."""

from dataclasses import dataclass, field, replace

import pytest

from gsencoder.core.errors import InputError
from gsencoder.core.promises import Budget, check_governed


@dataclass(frozen=True, slots=True, kw_only=True)
class SmallBudget(Budget):
    megabytes: float | None = None
    error: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class SampledBudget(SmallBudget):
    seed: int = 0


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
    said = SmallBudget(error=0.01, megabytes=2).conflict("error", "megabytes", 3.25)
    assert said == "budget.error=0.01 takes about 3.25 MB, more than budget.megabytes=2; budget.error comes first"


def test_options_that_a_budget_chooses_are_refused_where_they_are_set_and_only_with_a_budget() -> None:
    keys = ("views", "inner.rank")
    for settings, named in ((Outer(views=3), "s.views=3"), (replace(Outer(), inner=Inner(rank=8)), "s.inner.rank=8")):
        with pytest.raises(InputError, match=f"^{named}: is chosen by budget.error and budget.megabytes"):
            check_governed(SmallBudget(error=0.1, megabytes=1), settings, Outer(), keys, "s")
        check_governed(SmallBudget(), settings, Outer(), keys, "s")
    check_governed(SmallBudget(error=0.1), Outer(), Outer(), keys, "s")
