"""What runs of `bench/run.py` come to: a row for each figure, beside what is recorded, and the report."""

import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from figure_registry import REPEATABLE, Entry, Figure, Registry

ENOUGH_FOR_A_SPREAD = 3
"""Runs whose range is recorded as the spread of a figure."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """One run of an entry.

    Attributes:
        state: "ok", or what went wrong.
        cpu: processor seconds of the command and all that it started.
        load: load average before it.
        figures: numbers by name.
    """

    entry: str
    round: int
    state: str
    seconds: float
    cpu: float
    load: float
    figures: Mapping[str, float]


def spread_of(values: Sequence[float]) -> float:
    """Half the range."""
    return (max(values) - min(values)) / 2


def has_moved(figure: Figure, values: Sequence[float]) -> bool:
    """Whether all values lie beyond what is recorded, plus or minus the spread, on one side."""
    # What YAML reads and a script writes may differ in the last bit.
    most = figure.spread + 1e-9 * abs(figure.recorded)
    return min(values) > figure.recorded + most or max(values) < figure.recorded - most


def table(entries: Iterable[Entry], runs: Sequence[Run], shared: Path) -> list[dict[str, Any]]:
    """A row for each figure."""
    rows = []
    for entry in entries:
        own = [run for run in runs if run.entry == entry.name]
        good = [run for run in own if run.state == "ok"]
        # A failure that a later call made good is none any more.
        bad = [run for run in own if run.state != "ok" and run.round not in {each.round for each in good}]
        for figure in entry.figures:
            values = [run.figures[figure.name] for run in good]
            row = {
                "entry": entry.name, "section": entry.section, "figure": figure.name, "kind": figure.kind,
                "recorded": figure.recorded, "spread": figure.spread, "values": values,
            }  # fmt: skip
            if values:
                row |= {"now": statistics.median(values), "now_spread": spread_of(values)}
            if missing := entry.missing(shared):
                state = f"skipped: {missing}"
            elif bad:
                state = bad[-1].state
            elif not values:
                state = "not run"
            elif not figure.judged:
                state = "not judged"
            else:
                state = "moved" if has_moved(figure, values) else "as recorded"
            rows.append({**row, "state": state})
    return rows


def markdown(machine: Mapping[str, str], rows: Sequence[Mapping[str, Any]]) -> str:
    """The report."""
    moved = [row for row in rows if row["state"] == "moved"]
    lines = [f"# Figures remade on {machine['date']}", ""]
    measured = [row for row in rows if row["values"]]
    lines += [f"{len(moved)} of {len(measured)} figures moved by more than their spread; {len(rows)} were asked for."]
    lines += ["Seconds are shown and not judged, as machines differ.", ""]
    lines += [f"- {name}: {value}" for name, value in machine.items()]
    lines += ["", "| entry | figure | recorded | now | |", "|---|---|---|---|---|"]
    for row in rows:
        now = f"{row['now']:.6g} ± {row['now_spread']:.2g} ({len(row['values'])})" if row["values"] else ""
        state = row["state"].replace("|", "\\|")
        state = f"**{state}**" if row["state"] == "moved" else state
        what = f"{row['figure']} ({row['kind']})"
        lines.append(f"| {row['entry']} | {what} | {row['recorded']:.6g} ± {row['spread']:.2g} | {now} | {state} |")
    return "\n".join(lines) + "\n"


def listing(registry: Registry, shared: Path) -> str:
    """All entries, and what is not remade."""
    lines = []
    for entry in registry.entries:
        runs = f" × {entry.repeats}" if entry.repeats > 1 else ""
        missing = f"; skipped: {entry.missing(shared)}" if entry.missing(shared) else ""
        kind = "" if entry.deterministic else ", depends on load"
        lines.append(f"{entry.name}: {entry.minutes:g} min{runs}, {len(entry.figures)} figures{kind}{missing}")
    total = sum(entry.minutes_of_all_runs for entry in registry.entries)
    lines.append(f"{len(registry.entries)} entries, {total:.0f} minutes\n\nNot remade here:")
    lines += [f"{each.section}: {each.figures}: {each.why}" for each in registry.not_remade]
    return "\n".join(lines)


def recorded_values(rows: Sequence[Mapping[str, Any]]) -> dict[tuple[str, str], tuple[float, float]]:
    """What `record` writes: medians, and spreads of figures with enough runs. Of figures that do not depend on load
    only those that moved are written, with the spread that they have, half of the last digit that is stated."""
    recorded = {}
    for row in rows:
        repeatable = row["kind"] in REPEATABLE
        if row["values"] and (row["state"] == "moved" or not repeatable):
            several = len(row["values"]) >= ENOUGH_FOR_A_SPREAD and not repeatable
            recorded[row["entry"], row["figure"]] = row["now"], row["now_spread"] if several else row["spread"]
    return recorded
