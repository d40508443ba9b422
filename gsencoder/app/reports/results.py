"""Pages about the results of `fuse`, `localize`, `evaluate` and `score` (report=true)."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gsencoder.app.reports.parts import add_features, add_views, add_words
from gsencoder.app.runs.summary import Summary, peak_memory_mb
from gsencoder.evaluate.tables import ScoreReport
from gsencoder.infer.page.report import HtmlReport
from gsencoder.types import GaussianFeatures, Localization, Scene

REPORT = "report.html"


def report_fusion(
    folder: Path, scene: Scene, features: GaussianFeatures, truncation: float, teacher: str, summary: Summary
) -> None:
    """Writes the page of a fusion.

    Args:
        folder: of the results.
        scene: Gaussians and views.
        features: that were fused.
        truncation: what their basis costs, as a centered cosine error.
        teacher: its name.
        summary: of the command.
    """
    report = HtmlReport(f"Features of {scene.name}", f"Maps of the teacher {teacher}, lifted from all views.")
    assert scene.views is not None
    with_features = int(features.seen.sum())
    _facts(report, {"Gaussians": len(features), "with features": with_features, "views": len(scene.views)}, summary)
    add_views(report, scene, {teacher: features})
    add_features(report, {teacher: features}, {teacher: truncation})
    _timings(report, summary)
    report.write(folder / REPORT)


def report_words(folder: Path, scene: Scene, localization: Localization, summary: Summary) -> None:
    """Writes the page of words in a scene.

    Args:
        folder: of the results.
        scene: Gaussians, and cameras if there are to be pictures.
        localization: of the words.
        summary: of the command.
    """
    report = HtmlReport(f"Words in {scene.name}", "Clusters of Gaussians whose features answer a word.")
    boxed = {box.query for box in localization.boxes}
    facts = {"words": len(localization.queries), "with a box": len(boxed), "boxes": len(localization.boxes)}
    _facts(report, facts, summary)
    report.section("Words")
    add_words(report, scene, localization)
    _timings(report, summary)
    report.write(folder / REPORT)


def report_scores(folder: Path, summary: Summary) -> None:
    """Writes the page of an evaluation: its scores, of all scenes and names, and of each.

    Args:
        folder: of the results.
        summary: of the command, with the results of a protocol.
    """
    results = summary.results
    report = HtmlReport(f"Evaluation: {results['protocol']}")
    _facts(report, {name: value for name, value in results.items() if _is_figure(value)}, summary)
    names = results["names"]
    if names:
        report.section("Names", "The hardest first.")
        columns = _columns(next(iter(names.values())))
        report.table(("name", *columns), [(name, *(row[column] for column in columns)) for name, row in names.items()])
    scenes = [scene for scene in results["scenes"] if isinstance(scene, Mapping)]
    if scenes:
        report.section("Scenes")
        columns = _columns(scenes[0])
        rows = [(scene["scene"], *(scene.get(column, "–") for column in columns)) for scene in scenes]
        report.table(("scene", *columns), rows)
    _timings(report, summary)
    report.write(folder / REPORT)


def report_benchmark(folder: Path, scores: ScoreReport, summary: Summary) -> None:
    """Writes the page of a benchmark: measured rows above those of papers, and the rows by scene and class.

    Args:
        folder: of the results.
        scores: of one protocol.
        summary: of the command.
    """
    table = scores.table.without_classes()
    report = HtmlReport(table.title, scores.line)
    _facts(report, {name: value for name, value in scores.results.items() if _is_figure(value)}, summary)
    report.section("Percent", "Rows of papers are of other scenes.")
    report.table(
        ("method", "source", *table.columns),
        [(row.method, row.source, *(_cell(row.values.get(name)) for name in table.columns)) for row in table.rows],
    )
    for note in table.notes:
        report.paragraph(note)
    for title, rows in scores.rows.items():
        if rows:
            report.section(title.capitalize())
            columns = list(dict.fromkeys(name for row in rows for name in row))
            report.table(columns, [[_cell(row.get(name)) for name in columns] for row in rows])
    _timings(report, summary)
    report.write(folder / REPORT)


def _cell(value: Any) -> Any:
    return "–" if value is None or value != value else value


def _facts(report: HtmlReport, facts: Mapping[str, object], summary: Summary) -> None:
    report.facts(facts)
    report.facts({"seconds": sum(summary.timings.values()), "peak memory, MiB": peak_memory_mb()})


def _timings(report: HtmlReport, summary: Summary) -> None:
    report.section("Seconds of each step")
    report.timings(summary.timings)


def _is_figure(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _columns(row: Mapping[str, Any]) -> list[str]:
    return [name for name, value in row.items() if _is_figure(value)]
