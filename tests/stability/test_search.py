"""Searches for cases that break a promise: several extremes at once.

`make stability` searches longer. What it breaks is shrunk, mended, and entered into `random_cases.FAILED`.
"""

import os
from dataclasses import fields

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from stability import routines
from stability.random_cases import FAILED, HIGH, LOW, Recipe
from stability.registry import ROUTINES, Routine

assert routines
EXAMPLES = int(os.environ.get("GSENCODER_STABILITY_EXAMPLES", "3"))
SEARCH = settings(
    max_examples=EXAMPLES,
    deadline=None,
    derandomize=EXAMPLES < 100,
    database=None,
    phases=(Phase.generate, Phase.target, Phase.shrink),
    suppress_health_check=list(HealthCheck),
)


def recipes(routine: Routine) -> st.SearchStrategy[Recipe]:
    """Cases within the domain of a routine."""
    made: dict[str, st.SearchStrategy[float]] = {}
    for each in fields(Recipe):
        low, high = routine.limits.get(each.name, (getattr(LOW, each.name), getattr(HIGH, each.name)))
        if isinstance(each.default, int):
            made[each.name] = st.integers(int(low), int(high))
        else:
            made[each.name] = st.sampled_from([low, high]) | st.floats(low, high) | st.just(max(low, each.default))
    return st.builds(Recipe, **made)


def allows(routine: Routine, recipe: Recipe) -> bool:
    return all(low <= getattr(recipe, name) <= high for name, (low, high) in routine.limits.items())


@pytest.mark.parametrize("name", ROUTINES)
def test_no_case_within_its_domain_breaks_a_promise(name: str) -> None:
    routine = ROUTINES[name]

    @SEARCH
    @given(recipe=recipes(routine))
    def search(recipe: Recipe) -> None:
        assert routine.error(recipe.make()) <= routine.promise

    search()


@pytest.mark.parametrize("name", ROUTINES)
def test_what_once_broke_a_promise_no_longer_does(name: str) -> None:
    routine = ROUTINES[name]
    for recipe in FAILED:
        if allows(routine, recipe):
            assert routine.error(recipe.make()) <= routine.promise, recipe
