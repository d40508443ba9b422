"""`gsencoder inspect SPLAT…`: counts, extent and every defect of splat files, without changing them."""

from dataclasses import dataclass, field
from pathlib import Path

from rich.table import Table

from gsencoder.app.runs.output_folder import output_folder
from gsencoder.app.runs.progress import Progress, console
from gsencoder.app.runs.summary import Summary
from gsencoder.app.settings.config import CommonConfig
from gsencoder.data.splat_formats.repair import SplatReport, inspect_splat
from gsencoder.data.splats import READABLE, read_raw


@dataclass(frozen=True, slots=True, kw_only=True)
class InspectConfig(CommonConfig):
    """Settings of `inspect`."""

    paths: tuple[str, ...] = field(
        default=(), metadata={"help": f"splat files: {READABLE}", "metavar": "SPLAT", "required": True}
    )
    out: Path | None = field(
        default=None, metadata={"help": "folder for a summary.json with the same facts", "metavar": "FOLDER"}
    )


def run(config: InspectConfig, summary: Summary) -> None:
    """Reads each file, prints one table, and writes the summary if asked to."""
    reports = {}
    for path in Progress(quiet=config.quiet)(config.paths, "reading"):
        with summary.step("read"):
            raw = read_raw(path)
        with summary.step("inspect"):
            reports[path] = inspect_splat(raw)
    summary.results["splats"] = [{"path": path, **report.to_dict()} for path, report in reports.items()]
    if config.out is not None:
        with output_folder(config.out, overwrite=config.overwrite, summary=summary):
            pass
    screen = console(config.quiet)
    for path, report in reports.items():
        screen.print(report_table(path, report))


def report_table(path: str, report: SplatReport) -> Table:
    """A report as a table of two columns; defects say how many rows, and where the first of them are."""
    table = Table(title=path, title_justify="left", show_header=False)
    table.add_row("Gaussians", f"{report.count:,}")
    table.add_row("format", report.format)
    table.add_row("SH degree", str(report.sh_degree))
    for name, low, high in (
        ("extent", report.extent_min, report.extent_max),
        ("1st to 99th percentile", report.robust_min, report.robust_max),
    ):
        if low is not None and high is not None:
            table.add_row(name, f"{_numbers(low)} to {_numbers(high)}")
    if report.median_scale is not None:
        table.add_row("median scale", f"{report.median_scale:.4g}")
    if report.opacity_quantiles:
        table.add_row("opacity", ", ".join(f"{float(q):.0%} {v:.3f}" for q, v in report.opacity_quantiles.items()))
    for defect in report.defects:
        first = ", ".join(map(str, defect.first_rows)) + (", …" if defect.count > len(defect.first_rows) else "")
        stops = "; stops loading" if defect.stops_loading else ""
        table.add_row(defect.name, f"{defect.count:,} rows ({first}){stops}")
    table.add_row("loads", "yes" if report.loadable else "no; see gsencoder repair")
    return table


def _numbers(values: tuple[float, ...]) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in values) + ")"
