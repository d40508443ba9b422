"""The HTML report of `demo`: views, Gaussians, features, localized words, timings."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsencoder.app.output import Summary, peak_memory_mb
from gsencoder.core.arrays import even_indices
from gsencoder.evaluate.tables import ScoreReport
from gsencoder.fusion.fuse import Fusion
from gsencoder.infer.draw import color_bar, depth_picture, fit_pca_colors, pca_picture
from gsencoder.infer.page.report import HtmlReport
from gsencoder.infer.pictures import relevancy_pictures
from gsencoder.render import blend
from gsencoder.render.images import render_image
from gsencoder.types import GaussianFeatures, Localization, Scene
from gsencoder.types.orientation import upright_views

SHOWN_VIEWS = 4
MIN_CELL = 220
"""Smallest width of a view on the page, CSS pixels; all shown views fit in one row."""
PAIR_CELL = 560
"""Smallest width of a view with the relevancy beside it."""


def add_views(report: HtmlReport, scene: Scene, features: Mapping[str, GaussianFeatures]) -> None:
    """Adds some views of a scene: photographs where it has them, Gaussians, depth, and features as colors."""
    gaussians = scene.gaussians
    assert gaussians is not None
    assert scene.views is not None
    views = upright_views(scene.views)
    numbers = even_indices(len(views), SHOWN_VIEWS).tolist()
    colors = {title: fit_pca_colors(each.stored(each.seen)) for title, each in features.items()}
    rendered, depths = [], []
    stored = {title: torch.from_numpy(each.stored()) for title, each in features.items()}
    fields: dict[str, list[np.ndarray]] = {title: [] for title in features}
    for view in numbers:
        b = blend(gaussians, views.cameras, view)
        rendered.append(render_image(gaussians, views.cameras, view, blended=b))
        depths.append(depth_picture(b.depth_map()))
        alpha = b.alpha.reshape(b.shape).numpy()
        for title, rows in stored.items():
            values = b.render(rows).reshape(*b.shape, -1).numpy()
            fields[title].append(pca_picture(values, colors[title], alpha))
    captions = [f"view {view}" for view in numbers]
    if views.images is not None:
        report.section("Input", "Photographs with known poses.")
        report.pictures([views.images[view] for view in numbers], captions, cell=MIN_CELL)
    report.section("Gaussians")
    report.pictures(rendered, [f"{caption}, rendered" for caption in captions], cell=MIN_CELL)
    report.pictures(depths, [f"{caption}, depth, bright is near" for caption in captions], cell=MIN_CELL)
    report.section(
        "Features", "The first three principal components of each field as red, green and blue, the same in every view."
    )
    for title, pictures in fields.items():
        report.pictures(pictures, [f"{caption}, {title}" for caption in captions], cell=MIN_CELL)


def add_features(report: HtmlReport, features: Mapping[str, GaussianFeatures], truncation: Mapping[str, float]) -> None:
    """Adds a table of features.

    Args:
        truncation: what the basis costs, as a centered cosine error, by title.
    """
    columns = ("features", "channels", "rank of the basis", "energy kept", "centered cosine error", "Gaussians seen")
    rows = [
        (
            title,
            each.space.channels,
            each.features.shape[1],
            each.basis.energy_kept if each.basis is not None else 1.0,
            truncation[title],
            int(each.seen.sum()),
        )
        for title, each in features.items()
    ]
    report.table(columns, rows)


def add_words(
    report: HtmlReport, scene: Scene, localization: Localization, ious: Mapping[str, float] | None = None
) -> None:
    """Adds a picture of each word, with its relevancy and boxes, and a table of the words.

    Args:
        scene: Gaussians, and cameras if there are to be pictures.
        ious: of the first box of each word with the true one; None = the truth is not known.
    """
    words, boxes = localization.queries, {word: [] for word in localization.queries}  # type: ignore[var-annotated]
    for box in localization.boxes:
        boxes[box.query].append(box)
    if scene.views is not None:
        # Names begin with the number of the word.
        pictures = dict(relevancy_pictures(scene, localization, per_word=1))
        captions = [_caption(word, len(boxes[word]), None if ious is None else ious[word]) for word in words]
        report.pictures([np.asarray(pictures[name]) for name in sorted(pictures)], captions, cell=PAIR_CELL)
        marks = set(localization.thresholds.tolist())
        mark = marks.pop() if len(marks) == 1 else None
        report.pictures([color_bar(640, 0.0, 1.0, mark=mark)], ["relevancy, with the threshold"], lossless=True)
    rows = []
    for word, probability in zip(words, localization.probabilities.tolist(), strict=True):
        best = boxes[word][0] if boxes[word] else None
        center = "–" if best is None else ", ".join(f"{value:.2f}" for value in best.center)
        row: Sequence[object] = (word, len(boxes[word]), center, best.score if best is not None else 0.0, probability)
        rows.append(row if ious is None else (*row, ious[word]))
    columns = ("word", "boxes", "center of the first", "score", "probability")
    report.table(columns if ious is None else (*columns, "IoU with the truth"), rows)


def _caption(word: str, boxes: int, iou: float | None) -> str:
    if not boxes:
        return f"{word}: no box"
    return (
        f"{word}: {boxes} box{'es' if boxes > 1 else ''}" if iou is None else f"{word}: IoU {iou:.2f} with the true box"
    )


TEXTS = {
    "names": (
        "Where is each object?",
        "The labels teacher paints each pixel with the vector of its object's name. The vectors are "
        "lifted from all views onto the Gaussians; a word selects Gaussians by cosine, and DBSCAN clusters them to "
        "boxes.",
    ),
    "colors": (
        "Where is each color?",
        "The palette teacher looks at the photographs alone and names colors. A color on a wall or on the "
        "furniture is localized too: the best box is not always the small object that was meant.",
    ),
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TeacherResult:
    """The features of a teacher and the words that were localized in them.

    Attributes:
        title: names or colors.
        words: the queries.
        ious: IoU of the first box of each word with the true one; 0 without a box.
        fusion: the features and the seconds of each step.
        localization: relevancy and boxes.
    """

    title: str
    words: tuple[str, ...]
    ious: tuple[float, ...]
    fusion: Fusion
    localization: Localization

    @property
    def features(self) -> GaussianFeatures:
        return self.fusion.features

    @property
    def num_localized(self) -> int:
        """Number of words whose first box has an IoU of 0.5 or more."""
        return sum(iou >= 0.5 for iou in self.ious)

    @property
    def mean_iou(self) -> float:
        return float(np.mean(self.ious)) if self.ious else 0.0

    def to_dict(self) -> dict[str, Any]:
        """For summary.json."""
        return {
            "rank": self.features.features.shape[1],
            "channels": self.features.space.channels,
            "seen": int(self.features.seen.sum()),
            "mean_iou": self.mean_iou,
            "iou": dict(zip(self.words, self.ious, strict=True)),
        }


def write_report(
    path: Path, scene: Scene, results: Sequence[TeacherResult], summary: Summary, *, page: str = ""
) -> None:
    """Draws the pictures and writes the report, with a link to a page beside it if there is one."""
    assert scene.gaussians is not None
    assert scene.views is not None
    report = HtmlReport(
        "A room and the words in it",
        "Gaussians were seeded from posed pictures with depth, 2D features lifted onto them, and words localized.",
    )
    report.facts(
        {
            "Gaussians": len(scene.gaussians),
            "views": len(scene.views),
            "seconds before this page": sum(summary.timings.values()),
            "peak memory, MiB": peak_memory_mb(),
            **{f"{result.title} localized": f"{result.num_localized} of {len(result.words)}" for result in results},
        }
    )
    if page:
        report.section("In a browser")
        report.link("The room as a page: type a word, and see it", page)
    features = {result.title: result.features for result in results}
    add_views(report, scene, features)
    for result in results:
        report.section(*TEXTS[result.title])
        add_words(report, scene, result.localization, dict(zip(result.words, result.ious, strict=True)))
    report.section("Seconds of each step")
    report.timings(summary.timings)
    report.section("Features")
    add_features(report, features, {result.title: result.fusion.truncation for result in results})
    report.write(path)


REPORT = "report.html"


def report_fusion(
    folder: Path, scene: Scene, features: GaussianFeatures, truncation: float, teacher: str, summary: Summary
) -> None:
    """Writes the page of a fusion.

    Args:
        truncation: what their basis costs, as a centered cosine error.
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
        scene: Gaussians, and cameras if there are to be pictures.
    """
    report = HtmlReport(f"Words in {scene.name}", "Clusters of Gaussians whose features answer a word.")
    boxed = {box.query for box in localization.boxes}
    facts = {"words": len(localization.queries), "with a box": len(boxed), "boxes": len(localization.boxes)}
    _facts(report, facts, summary)
    report.section("Words")
    add_words(report, scene, localization)
    _timings(report, summary)
    report.write(folder / REPORT)


def report_benchmark(folder: Path, scores: ScoreReport, summary: Summary) -> None:
    """Writes the page of a benchmark: measured rows above those of papers, and the rows by scene and class."""
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
