"""Tables of results: measured rows, and below them what papers print, marked as such."""

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64

PUBLISHED = Path(__file__).parent / "published"


@dataclass(frozen=True, slots=True, kw_only=True)
class ResultRow:
    """The figures of one method, percent by column, "measured" by this program or "published" in a paper, which may
    head the methods of a kind with a group. A column that is missing or NaN was not measured or not printed."""

    source: Literal["measured", "published"]
    method: str
    group: str = ""
    values: Mapping[str, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class ResultTable:
    """Rows under the same columns, and notes, a sentence each; columns `by_class` are of one class each, and are rows
    of a second table in Markdown."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[ResultRow, ...]
    notes: tuple[str, ...] = ()
    by_class: tuple[str, ...] = ()

    def csv_rows(self) -> list[dict[str, object]]:
        """One mapping a row, with None for what is missing."""
        return [
            {"source": row.source, "group": row.group, "method": row.method}
            | {column: _finite(row.values.get(column)) for column in self.columns}
            for row in self.rows
        ]

    def without_classes(self) -> "ResultTable":
        """The table without the columns that are of one class each."""
        return replace(self, columns=tuple(each for each in self.columns if each not in self.by_class), by_class=())

    def markdown(self) -> str:
        """The table in Markdown, with notes below it, and the table of classes, if there are any, below these."""
        columns = self.without_classes().columns
        labeled = [(row.method if row.source == "measured" else f"{row.method} (published)", row) for row in self.rows]
        lines = _lines(
            f"**{self.title}** (percent)",
            ["method", *columns],
            [[method, *(_figure(row, column) for column in columns)] for method, row in labeled],
        )
        lines += [f"\n{note}" for note in self.notes]
        if self.by_class:
            with_classes = [
                (method, row) for method, row in labeled if any(_figure(row, each) for each in self.by_class)
            ]
            lines += _lines(
                f"\n**{self.title}, by class** (percent)",
                ["class", *(method for method, _ in with_classes)],
                [[each, *(_figure(row, each) for _, row in with_classes)] for each in self.by_class],
            )
        return "\n".join(lines) + "\n"


def table_of(
    title: str,
    measured: Mapping[str, Mapping[str, float]],
    *,
    published: str = "",
    columns: Iterable[str] = (),
    notes: Iterable[str] = (),
    by_class: Iterable[str] = (),
) -> ResultTable:
    """A table of measured shares, by method and column, with a paper's rows below.

    Args:
        published: name of a file of `published/`, without its ending; empty = none.
        columns: in order; empty = those of the measured rows, in order of first appearance.
    """
    rows = [
        ResultRow(source="measured", method=method, values={name: 100 * value for name, value in values.items()})
        for method, values in measured.items()
    ]
    names = tuple(columns) or tuple(dict.fromkeys(name for row in rows for name in row.values))
    below = published_rows(published) if published else ()
    return ResultTable(title=title, columns=names, rows=(*rows, *below), notes=tuple(notes), by_class=tuple(by_class))


def published_rows(name: str) -> tuple[ResultRow, ...]:
    """The rows of a paper's table, in percent, as printed."""
    with (PUBLISHED / f"{name}.csv").open(newline="", encoding="utf-8") as stream:
        return tuple(
            ResultRow(
                source="published",
                method=row["method"],
                group=row["group"],
                values={key: float(value) for key, value in row.items() if key not in ("group", "method") and value},
            )
            for row in csv.DictReader(stream)
        )


def _finite(value: float | None) -> float | None:
    return None if value is None or math.isnan(value) else value


def _figure(row: ResultRow, column: str) -> str:
    figure = _finite(row.values.get(column))
    return "" if figure is None else f"{figure:.1f}"


def _lines(title: str, head: list[str], rows: Iterable[list[str]]) -> list[str]:
    return [title, "", _line(head), _line(["---", *("---:" for _ in head[1:])]), *map(_line, rows)]


def _line(cells: Iterable[str]) -> str:
    # A bar ends a cell also where a name holds one.
    return "| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in cells) + " |"


def grouped(rows: Iterable[Any], *names: str) -> dict[Any, list[Any]]:
    """Rows, mappings or objects, by one or several of their values, in order of first appearance."""
    groups: dict[Any, list[Any]] = {}
    for row in rows:
        values = tuple(row[name] if isinstance(row, Mapping) else getattr(row, name) for name in names)
        groups.setdefault(values if len(names) > 1 else values[0], []).append(row)
    return groups


def mean_of(values: Sequence[float] | Float64[np.ndarray, " n"]) -> float:
    """The mean of the values that are numbers; NaN if none is."""
    array = np.asarray(values, np.float64)
    numbers = array[~np.isnan(array)]
    return float(numbers.mean()) if len(numbers) else math.nan


@dataclass(frozen=True, slots=True, kw_only=True)
class ScoreReport:
    """The scores of one protocol: figures as shares, the table with those that papers print, rows of CSV files by their
    stem, such as "scenes" and "classes", and the main figures in one line."""

    results: Mapping[str, Any]
    table: ResultTable
    rows: Mapping[str, Sequence[Mapping[str, Any]]] = field(default_factory=dict)
    line: str


def spread(rows: Sequence[Mapping[str, Any]], columns: Sequence[str]) -> dict[str, dict[str, float | int]]:
    """Mean and standard deviation over scenes, the rows, of columns, and the number of scenes that have a value."""
    figures: dict[str, dict[str, float | int]] = {}
    for column in columns:
        values = [value for row in rows if (value := _finite(row.get(column))) is not None]
        deviation = float(np.std(values, ddof=1)) if len(values) > 1 else math.nan
        figures[column] = {"scenes": len(values), "mean": mean_of(values), "std": deviation}
    return figures
