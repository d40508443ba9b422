"""Numeric routines with their bounds, and the error of each at each extreme."""

import csv
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from stability.extremes import EXTREMES, Case, Extreme

DOCUMENT = Path(__file__).parents[2] / "docs" / "numerics.md"
TABLE = Path(__file__).with_name("errors.csv")
"""Measured errors of all cells; `python bench/numerics.py` remakes it."""
FACTOR = 8
"""How many times its error in the table a cell may have: other processors, libraries and numbers of threads round
otherwise."""
NEGLIGIBLE = 0.02
"""Share of its bound below which a cell's error is not compared with the table."""


@dataclass(frozen=True)
class Routine:
    """A numeric routine.

    Attributes:
        name: in the table of docs/numerics.md, which says what it takes, and how its error is meant.
        reads: the parts of a case that it reads.
        bound: largest error there.
        error: of a case.
        exempt: extremes outside the domain, or that say nothing about the routine, with the reason.
        limits: of fields of `random_cases.Recipe`, where the domain is narrower than what searches draw from.
    """

    name: str
    reads: frozenset[str]
    bound: float
    error: Callable[[Case], float]
    exempt: dict[str, str]
    limits: dict[str, tuple[float, float]]

    def why_not(self, extreme: Extreme) -> str | None:
        """Why a cell does not apply; None where it does."""
        if extreme.name in self.exempt:
            return self.exempt[extreme.name]
        if self.reads & extreme.changes:
            return None
        return f"reads {_words(self.reads)}; the extreme changes {_words(extreme.changes)}"


def _words(parts: frozenset[str]) -> str:
    names = {"splat": "Gaussians", "camera": "the camera", "vectors": "features", "logits": "attention scores"}
    return " and ".join(names[part] for part in names if part in parts)


ROUTINES: dict[str, Routine] = {}


def table_rows() -> dict[str, list[str]]:
    """The cells of the table of docs/numerics.md by routine: domain, bound, and how its error is meant."""
    rows = [line.strip("| ").split(" | ") for line in DOCUMENT.read_text().splitlines() if line.startswith("| ")]
    return {row[0]: row[1:] for row in rows if len(row) > 3}


PROMISES = {name: float(cells[1]) for name, cells in table_rows().items() if name != "routine"}


def routine(
    name: str, *reads: str, exempt: dict[str, str] | None = None, limits: dict[str, tuple[float, float]] | None = None
) -> Callable[[Callable[[Case], float]], Callable[[Case], float]]:
    """Enters a function from a case to an error into the registry."""

    def enter(error: Callable[[Case], float]) -> Callable[[Case], float]:
        assert name not in ROUTINES, name
        ROUTINES[name] = Routine(name, frozenset(reads), PROMISES[name], error, exempt or {}, limits or {})
        return error

    return enter


@cache
def case_of(name: str) -> Case:
    return next(extreme for extreme in EXTREMES if extreme.name == name).make()


def error_of(routine: Routine, extreme: Extreme) -> float:
    """The error of a cell; infinite where anything is not finite."""
    error = float(routine.error(case_of(extreme.name)))
    return error if math.isfinite(error) else math.inf


def worst(got: object, want: np.ndarray, scale: np.ndarray | float | None = None) -> float:
    """The largest |got − want| / scale, whose scale is the largest |want| unless given; infinite where got is not
    finite."""
    values, want = np.asarray(got), np.asarray(want)
    assert values.shape == want.shape, (values.shape, want.shape)
    if not values.size:
        return 0.0
    if not np.isfinite(values).all():
        return math.inf
    if scale is None:
        scale = np.abs(want).max()
    return float((np.abs(values - want) / np.maximum(scale, np.finfo(np.float64).tiny)).max())


def committed() -> dict[tuple[str, str], float | None]:
    """The errors of the table, by routine and extreme; None where the cell does not apply."""
    with TABLE.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {(row["routine"], row["extreme"]): float(row["error"]) if row["error"] else None for row in rows}


def write_table(errors: dict[tuple[str, str], float]) -> None:
    """Writes the errors of cells; those that do not apply get the reason."""
    with TABLE.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["routine", "extreme", "error", "does not apply"])
        for each in ROUTINES.values():
            for extreme in EXTREMES:
                error, reason = errors.get((each.name, extreme.name)), each.why_not(extreme)
                writer.writerow([each.name, extreme.name, "" if error is None else f"{error:.1e}", reason or ""])


def most(routine: Routine, error: float) -> float:
    """The largest error that a cell may have, given the one in the table."""
    return min(routine.bound, max(FACTOR * error, NEGLIGIBLE * routine.bound))
