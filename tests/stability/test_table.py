"""Every numeric routine at every extreme: within its promise, and not worse than the table says.

`python bench/numerics.py` remakes the table, and docs/numerics.md with it.
"""

from pathlib import Path

import numpy as np
import pytest
from stability import oracles, routines
from stability.extremes import EXTREMES, PARTS
from stability.registry import ROUTINES, committed, error_of, most
from stability.registry import case_of as case_named

from gsencoder.render import BlendConfig, blend

assert routines
DOCUMENT = Path(__file__).parents[2] / "docs" / "numerics.md"


@pytest.mark.parametrize("name", ROUTINES)
def test_a_routine_keeps_its_promise_at_every_extreme(name: str) -> None:
    routine, table, broken = ROUTINES[name], committed(), []
    for extreme in EXTREMES:
        if routine.why_not(extreme) is None:
            error, before = error_of(routine, extreme), table[name, extreme.name]
            assert before is not None, f"{extreme.name} applies, and has no error in the table"
            if not error <= most(routine, before):
                broken.append(f"{extreme.name}: {error:.2e}, was {before:.1e}, promised {routine.promise:g}")
    assert not broken


def test_the_table_has_every_cell_with_an_error_or_a_reason() -> None:
    table = committed()
    assert set(table) == {(name, extreme.name) for name in ROUTINES for extreme in EXTREMES}
    for routine in ROUTINES.values():
        for extreme in EXTREMES:
            assert (table[routine.name, extreme.name] is None) == (routine.why_not(extreme) is not None)
    assert len(ROUTINES) >= 15
    assert len(EXTREMES) >= 12
    assert all(error is None or error <= ROUTINES[name].promise for (name, _), error in table.items())


def test_every_part_and_extreme_is_read_by_several_routines() -> None:
    for part in PARTS:
        assert sum(part in routine.reads for routine in ROUTINES.values()) >= 4
    for extreme in EXTREMES:
        assert sum(routine.why_not(extreme) is None for routine in ROUTINES.values()) >= 4
    names = {extreme.name for extreme in EXTREMES}
    assert all(set(routine.exempt) <= names for routine in ROUTINES.values())


def test_the_document_states_every_domain_and_promise() -> None:
    lines = DOCUMENT.read_text().splitlines()
    for routine in ROUTINES.values():
        (line,) = [line for line in lines if line.startswith(f"| {routine.name} |")]
        assert f"| {routine.domain} | {routine.promise:.1g} | {routine.measure} |" in line


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
