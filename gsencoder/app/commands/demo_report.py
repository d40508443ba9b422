"""The HTML report of `demo`: views, Gaussians, features, localized words, timings."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsencoder.app.runs.summary import Summary, peak_memory_mb
from gsencoder.core.even_indices import even_indices
from gsencoder.fusion.fuse import Fusion
from gsencoder.infer.draw.pictures import PcaColors, color_bar, depth_picture, fit_pca_colors, pca_picture
from gsencoder.infer.draw.relevancy_views import relevancy_pictures
from gsencoder.infer.draw.report import HtmlReport
from gsencoder.render import blend
from gsencoder.render.images import depth_image, render_image
from gsencoder.types import GaussianFeatures, Gaussians, Localization, Scene, Views

SHOWN_VIEWS = 4
MIN_CELL = 220
"""Smallest width of a view on the page, CSS pixels; all shown views fit in one row."""
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


def write_report(path: Path, scene: Scene, results: Sequence[TeacherResult], summary: Summary) -> None:
    """Draws the pictures and writes the report."""
    gaussians, views = scene.gaussians, scene.views
    assert gaussians is not None
    assert views is not None
    report = HtmlReport(
        "A room and the words in it",
        "Gaussians were seeded from posed pictures with depth, 2D features lifted onto them, and words localized.",
    )
    report.facts(
        {
            "Gaussians": len(gaussians),
            "views": len(views),
            "seconds before this page": sum(summary.timings.values()),
            "peak memory, MiB": peak_memory_mb(),
            **{f"{one.title} localized": f"{one.num_localized} of {len(one.words)}" for one in results},
        }
    )
    shown = even_indices(len(views), SHOWN_VIEWS).tolist()
    _views(report, gaussians, views, results, shown)
    for one in results:
        _answers(report, scene, one)
    report.section("Seconds of each step")
    report.timings(summary.timings)
    report.section("Features")
    report.table(
        ("features", "channels", "rank of the basis", "energy kept", "centered cosine error", "Gaussians seen"),
        [
            (
                one.title,
                one.features.space.channels,
                one.features.features.shape[1],
                one.features.basis.energy_kept if one.features.basis is not None else 1.0,
                one.fusion.truncation,
                int(one.features.seen.sum()),
            )
            for one in results
        ],
    )
    report.write(path)


def _views(
    report: HtmlReport, gaussians: Gaussians, views: Views, results: Sequence[TeacherResult], shown: list[int]
) -> None:
    colors = [_colors_of(one.features) for one in results]
    rendered, depths, fields = [], [], [[] for _ in results]  # type: ignore[var-annotated]
    for view in shown:
        b = blend(gaussians, views.cameras, view)
        rendered.append(render_image(gaussians, views.cameras, view, blended=b))
        depths.append(depth_picture(depth_image(b)))
        alpha = b.alpha.reshape(b.shape).numpy()
        for one, scale, pictures in zip(results, colors, fields, strict=True):
            values = b.render(torch.from_numpy(one.features.stored())).reshape(*b.shape, -1).numpy()
            pictures.append(pca_picture(values, scale, alpha))
    captions = [f"view {view}" for view in shown]
    if views.images is not None:
        report.section("Input", "Pictures with known poses and depth, written to disk and read back.")
        report.pictures([views.images[view] for view in shown], captions, cell=MIN_CELL)
    report.section("Gaussians", "Seeds from the depth maps: flat along the surface, colored by the pictures.")
    report.pictures(rendered, [f"{caption}, rendered" for caption in captions], cell=MIN_CELL)
    report.pictures(depths, [f"{caption}, depth, bright is near" for caption in captions], cell=MIN_CELL)
    report.section(
        "Features", "The first three principal components of each field as red, green and blue, the same in every view."
    )
    for one, pictures in zip(results, fields, strict=True):
        report.pictures(pictures, [f"{caption}, {one.title}" for caption in captions], cell=MIN_CELL)


def _colors_of(features: GaussianFeatures) -> PcaColors:
    return fit_pca_colors(features.stored(features.seen))


def _answers(report: HtmlReport, scene: Scene, one: TeacherResult) -> None:
    report.section(*TEXTS[one.title])
    # Names begin with the number of the word.
    named = dict(relevancy_pictures(scene, one.localization, per_word=1))
    pictures = [np.asarray(named[name]) for name in sorted(named)]
    boxed = {box.query for box in one.localization.boxes}
    captions = [
        f"{word}: IoU {iou:.2f} with the true box" if word in boxed else f"{word}: no box"
        for word, iou in zip(one.words, one.ious, strict=True)
    ]
    report.pictures(pictures, captions)
    threshold = float(one.localization.thresholds[0]) if len(one.localization.thresholds) else None
    report.pictures([color_bar(640, 0.0, 1.0, mark=threshold)], ["relevancy, with the threshold"], lossless=True)
    rows = []
    for word, iou in zip(one.words, one.ious, strict=True):
        boxes = [box for box in one.localization.boxes if box.query == word]
        best = boxes[0] if boxes else None
        center = ", ".join(f"{value:.2f}" for value in best.center) if best is not None else "–"
        rows.append((word, len(boxes), center, best.score if best is not None else 0.0, iou))
    report.table(("word", "boxes", "center of the first, m", "score", "IoU with the truth"), rows)
