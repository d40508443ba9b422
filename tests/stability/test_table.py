"""Every numeric routine at every extreme: within its bound, and not worse than the table says.

`python bench/numerics.py` remakes the table, and docs/numerics.md with it.
"""

import os
from dataclasses import fields

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from stability import oracles, routines
from stability.extremes import EXTREMES
from stability.random_cases import FAILED, HIGH, LOW, Recipe
from stability.registry import PROMISES, ROUTINES, Routine, committed, error_of, most
from stability.registry import case_of as case_named

from gsencoder.render import BlendConfig, blend

assert routines


@pytest.mark.parametrize("name", ROUTINES)
def test_a_routine_stays_within_its_bound_at_every_extreme(name: str) -> None:
    routine, table, broken = ROUTINES[name], committed(), []
    for extreme in EXTREMES:
        if routine.why_not(extreme) is None:
            error, before = error_of(routine, extreme), table[name, extreme.name]
            assert before is not None, f"{extreme.name} applies, and has no error in the table"
            if not error <= most(routine, before):
                broken.append(f"{extreme.name}: {error:.2e}, was {before:.1e}, bound {routine.bound:g}")
    assert not broken


def test_the_table_has_every_cell_with_an_error_or_a_reason() -> None:
    table = committed()
    assert set(table) == {(name, extreme.name) for name in ROUTINES for extreme in EXTREMES}
    for routine in ROUTINES.values():
        for extreme in EXTREMES:
            assert (table[routine.name, extreme.name] is None) == (routine.why_not(extreme) is not None)
    assert set(ROUTINES) == set(PROMISES)
    assert all(error is None or error <= ROUTINES[name].bound for (name, _), error in table.items())


def test_the_oracle_of_compositing_agrees_with_the_plain_twin_in_float64() -> None:
    """Two programs that share no code: what the table is measured against is not one program's opinion."""
    import torch
    from stability.of_rendering import dense

    for name in ("ordinary", "needles", "opacity 0 and 1", "fov 170°"):
        case = case_named(name)
        b = blend(case.gaussians, case.cameras, config=BlendConfig(backend="reference"), dtype=torch.float64)
        np.testing.assert_allclose(dense(b), oracles.blend(case.gaussians, case.cameras)[0].astype(float), atol=1e-12)


def test_an_error_that_is_not_finite_is_infinite() -> None:
    from dataclasses import replace

    routine = next(iter(ROUTINES.values()))
    assert error_of(replace(routine, error=lambda case: float("nan")), EXTREMES[0]) == float("inf")
    assert not error_of(replace(routine, error=lambda case: float("nan")), EXTREMES[0]) <= most(routine, float("inf"))


EXAMPLES = int(os.environ.get("GSENCODER_STABILITY_EXAMPLES", "3"))
SEARCH = settings(
    max_examples=EXAMPLES, deadline=None, derandomize=EXAMPLES < 100, database=None,
    phases=(Phase.generate, Phase.target, Phase.shrink), suppress_health_check=list(HealthCheck),
)  # fmt: skip


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
def test_no_case_within_its_domain_exceeds_a_bound(name: str) -> None:
    routine = ROUTINES[name]

    @SEARCH
    @given(recipe=recipes(routine))
    def search(recipe: Recipe) -> None:
        assert routine.error(recipe.make()) <= routine.bound

    search()


@pytest.mark.parametrize("name", ROUTINES)
def test_what_once_exceeded_a_bound_no_longer_does(name: str) -> None:
    routine = ROUTINES[name]
    for recipe in FAILED:
        if allows(routine, recipe):
            assert routine.error(recipe.make()) <= routine.bound, recipe
