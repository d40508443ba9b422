"""`gsencoder score PROTOCOL predictions=… truth=…`: files of any method's predictions against a benchmark's labels."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

from rich.markdown import Markdown
from rich.table import Table

from gsencoder.app.options import CommonConfig
from gsencoder.app.run import Run
from gsencoder.core.errors import InputError, counted
from gsencoder.core.files import csv_text, write_bytes
from gsencoder.core.settings import option
from gsencoder.evaluate.benchmarks import SCORES
from gsencoder.evaluate.benchmarks.files import ScoreOptions
from gsencoder.evaluate.tables import ScoreReport
from gsencoder.infer.page.report import HtmlReport

TABLE = "table.md"
MOST_COLUMNS = 10
"""Columns that are printed; more do not fit a terminal."""
MOST_NAMES = 15
"""Names with the lowest scores that are printed."""
DECIMALS = 6
"""Of figures in CSV files."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScoreConfig(ScoreOptions, CommonConfig):
    """Settings of `score`."""

    paths: tuple[str, ...] = option((), f"what is scored: {', '.join(SCORES)}", metavar="PROTOCOL", required=True)
    predictions: str = option("", "file or folder of the predictions, in the benchmark's format", required=True)
    truth: str = option(
        "",
        "file or folder of the labels, in the benchmark's format; of instances and semantics also a folder "
        "of scans of ScanNet or ScanNet++, with label_map=",
        required=True,
    )
    report: bool = option(False, "write report.html, a page with tables")

    def __post_init__(self) -> None:
        CommonConfig.__post_init__(self)
        if self.paths and (len(self.paths) > 1 or self.paths[0] not in SCORES):
            raise InputError(f"score: expected one protocol, {', '.join(SCORES)}; got {', '.join(self.paths)}")


def run(config: ScoreConfig, run: Run) -> None:
    """Scores the predictions, prints the table, and writes it with rows by scene and class."""
    (protocol,) = config.paths
    benchmark = import_module(f"gsencoder.evaluate.benchmarks.{protocol}")
    for name, field in ScoreOptions.__dataclass_fields__.items():
        if name not in ("method", *benchmark.OPTIONS) and getattr(config, name) != field.default:
            raise InputError(f"{name}: {protocol} has no such setting; it takes {', '.join(benchmark.OPTIONS)}")
    with run.step("score"):
        report = benchmark.score(Path(config.predictions), Path(config.truth), config)
    out = run.out("score", protocol)
    with run.folder(out) as folder:
        write_report(folder, report, run, page=config.report)
    print_report(out, report, run)


def write_report(folder: Path, report: ScoreReport, run: Run, *, page: bool) -> None:
    """Writes the table as Markdown and CSV, the other rows, and a page where it is asked for, and adds the results to
    the summary."""
    write_bytes(folder / TABLE, report.table.markdown().encode())
    # What is 0 but for rounding reads 0; the summary has all digits.
    tables = {"table": report.table.csv_rows(), **report.rows}
    for name, rows in tables.items():
        rounded = [
            {key: round(value, DECIMALS) if isinstance(value, float) else value for key, value in row.items()}
            for row in rows
        ]
        write_bytes(folder / f"{name}.csv", csv_text(rounded).encode())
    run.results.update(report.results)
    if page:
        write_page(folder, report, run)


def write_page(folder: Path, scores: ScoreReport, run: Run) -> None:
    """Writes the page of a benchmark: measured rows above those of papers, and the rows by scene and class."""

    def cell(value: Any) -> Any:
        return "–" if value is None or value != value else value

    table = scores.table.without_classes()
    page = HtmlReport(table.title, scores.line)
    figures = {name: value for name, value in scores.results.items() if isinstance(value, int | float)}
    page.facts({name: value for name, value in figures.items() if not isinstance(value, bool)})
    page.facts(run.costs())
    page.section("Percent", "Rows of papers are of other scenes.")
    rows = [(row.method, row.source, *(cell(row.values.get(name)) for name in table.columns)) for row in table.rows]
    page.table(("method", "source", *table.columns), rows)
    for note in table.notes:
        page.paragraph(note)
    for title, named in scores.rows.items():
        if named:
            page.section(title.capitalize())
            columns = list(dict.fromkeys(name for row in named for name in row))
            page.table(columns, [[cell(row.get(name)) for name in columns] for row in named])
    page.section("Seconds of each step")
    page.timings(run.timings)
    page.write(folder / "report.html")


def print_report(out: Path, report: ScoreReport, run: Run) -> None:
    """Prints the names with the lowest scores, the measured rows and the main figures."""
    if names := report.rows.get("names"):
        run.print(_names_table(names))
    table = report.table.without_classes()
    table = replace(table, rows=tuple(row for row in table.rows if row.source == "measured"))
    if report.table.by_class:
        run.print(f"The figures of {counted(len(report.table.by_class), 'class', 'classes')} are in {TABLE}.")
    if len(table.columns) > MOST_COLUMNS:
        table = replace(table, columns=table.columns[:MOST_COLUMNS])
        run.print(f"The first {MOST_COLUMNS} of {len(report.table.columns)} columns; all are in {TABLE}.")
    run.print(Markdown(table.markdown()), f"{out}: {report.line}")


def _names_table(names: Sequence[Mapping[str, Any]]) -> Table:
    table = Table(title="hardest names" if len(names) > MOST_NAMES else "names", title_justify="left")
    for title in names[0]:
        table.add_column(title, justify="left" if title == "name" else "right")
    for row in names[:MOST_NAMES]:
        table.add_row(*(f"{value:.3f}" if isinstance(value, float) else f"{value}" for value in row.values()))
    return table
