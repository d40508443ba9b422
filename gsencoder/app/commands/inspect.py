"""`gsencoder inspect PATH…`: what splats and scenes hold, and what is wrong with them, without changing them."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.table import Table

from gsencoder.app.runs.output_folder import output_folder
from gsencoder.app.runs.progress import Progress, console
from gsencoder.app.runs.summary import Summary
from gsencoder.app.settings.config import CommonConfig
from gsencoder.core.errors import InputError
from gsencoder.data.readers.layouts import find_splat
from gsencoder.data.scenes import DistinctPaths, SceneConfig, find_scenes, has_views, load_scene, read_posed, scene_name
from gsencoder.data.splats.files import READABLE, read_raw
from gsencoder.data.splats.repair import SplatReport, inspect_splat
from gsencoder.data.video import refuse_video


@dataclass(frozen=True, slots=True, kw_only=True)
class InspectConfig(CommonConfig):
    """Settings of `inspect`."""

    paths: tuple[str, ...] = field(
        default=(),
        metadata={"help": f"scenes with posed views, or splats: {READABLE}", "metavar": "PATH", "required": True},
    )
    out: Path | None = field(
        default=None,
        metadata={
            "help": "folder for a summary.json with the same facts, and a picture of each scene's check",
            "metavar": "FOLDER",
        },
    )
    check: bool = field(
        default=True, metadata={"help": "hold the views of a scene against each other, which takes seconds"}
    )
    views: int = field(
        default=0, metadata={"help": "largest number of views to hold against each other; 0 = 32 with depth, else 24"}
    )
    data: SceneConfig = field(default_factory=SceneConfig)

    def __post_init__(self) -> None:
        if self.views < 0 or self.views == 1:
            raise InputError(f"views: expected 0 or at least 2, got {self.views}")


def run(config: InspectConfig, summary: Summary) -> None:
    """Reads each splat or scene, prints one table for each, and writes the summary if asked to."""
    screen = console(config.quiet)

    def show(lines: list[Table | str]) -> None:
        for line in lines:
            screen.print(line, highlight=False)

    if config.out is None:
        for path in _paths(config.paths):
            show(_inspect(path, config, summary, None))
        return
    with output_folder(config.out, overwrite=config.overwrite, summary=summary) as folder:
        reports = [_inspect(path, config, summary, folder) for path in _paths(config.paths)]
    # What was written stays, also if nobody reads what is printed.
    for lines in reports:
        show(lines)


def _paths(words: tuple[str, ...]) -> tuple[Path, ...]:
    """Splat files and scenes; a folder of scenes stands for all of them."""
    chosen = DistinctPaths()
    for path in map(Path, words):
        if not path.exists():
            # Not after all that stand before it were looked at.
            raise InputError(f"{path}: no such file")
        chosen.add(find_scenes([path]) if path.is_dir() and not (path / "meta.json").is_file() else [path])
    return chosen.paths


def _inspect(path: Path, config: InspectConfig, summary: Summary, folder: Path | None) -> list[Table | str]:
    """What there is to say about a splat or a scene."""
    if path.exists() and has_views(path):
        return _inspect_scene(path, config, summary, folder)
    refuse_video(path)
    source = find_splat(path) if path.is_dir() else path
    with summary.step("read"):
        raw = read_raw(source)
    with summary.step("inspect"):
        report = inspect_splat(raw)
    summary.results.setdefault("splats", []).append({"path": str(path), **report.to_dict()})
    return [report_table(str(path), report)]


def _inspect_scene(path: Path, config: InspectConfig, summary: Summary, folder: Path | None) -> list[Table | str]:
    # Only scenes need Pillow and, for some depth sensors, torch.
    from gsencoder.app.commands.inspect_scene import (
        check_lines,
        check_results,
        finding_line,
        save_check_picture,
        scene_table,
    )
    from gsencoder.data.check.scene_check import check_scene, findings_of, is_decided
    from gsencoder.data.facts import scene_facts

    with summary.step("read"):
        scene = load_scene(path, options=config.data)
        posed, _, layout = read_posed(path.absolute(), config.data)
        assert scene.views is not None
        assert posed is not None
    with summary.step("facts"):
        facts = scene_facts(scene, posed, layout)
    lines: list[Table | str] = [str(path), scene_table(facts)]
    results: dict[str, Any] = {"path": str(path), **facts.to_dict()}
    if config.check:
        with summary.step("check"):
            depth, matches = check_scene(scene.views, limit=config.views, track=Progress(quiet=config.quiet))
        findings = findings_of(scene.views, depth, matches)
        lines += check_lines(facts, depth, matches)
        lines += [f"wrong: {finding_line(finding)}" for finding in findings]
        if not findings and (depth is not None or matches is not None):
            lines.append("nothing wrong was seen" if is_decided(depth, matches) else "too little to tell")
        results["check"] = check_results(depth, matches)
        results["findings"] = [
            {"cause": each.cause, "view": each.view, "factor": each.factor, "message": each.message}
            for each in findings
        ]
        if folder is not None:
            picture = f"{scene_name(path)}.png"
            if save_check_picture(folder / picture, scene.views, depth, matches):
                results["picture"] = picture
    summary.results.setdefault("scenes", []).append(results)
    return lines


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
            table.add_row(name, " to ".join(_corners(low, high)))
    if report.median_scale is not None:
        table.add_row("median scale", f"{report.median_scale:.4g}")
    if report.opacity_quantiles:
        table.add_row("opacity", ", ".join(f"{float(q):.0%} {v:.3f}" for q, v in report.opacity_quantiles.items()))
    for defect in report.defects:
        first = ", ".join(map(str, defect.first_rows)) + (", …" if defect.count > len(defect.first_rows) else "")
        stops = "; stops loading" if defect.stops_loading else ""
        table.add_row(defect.name, f"{defect.count:,} rows ({first}){stops}")
    if report.unused:
        table.add_row("not used", ", ".join(report.unused))
    for finding in report.findings:
        table.add_row("wrong", finding)
    table.add_row("loads", "yes" if report.loadable else "no; see gsencoder repair")
    return table


def _corners(low: tuple[float, ...], high: tuple[float, ...]) -> tuple[str, str]:
    """The corners of a box, with four digits of its size also where it lies far from the origin."""
    digits = []
    for least, most in zip(low, high, strict=True):
        largest, size = max(abs(least), abs(most)), most - least
        # No float32 has more than nine.
        digits.append(4 + min(max(math.ceil(math.log10(largest / size)), 0), 5) if 0 < size < largest else 4)
    first, second = (
        ", ".join(f"{value:.{count}g}" for value, count in zip(corner, digits, strict=True)) for corner in (low, high)
    )
    return f"({first})", f"({second})"
