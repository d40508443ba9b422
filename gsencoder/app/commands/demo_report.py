"""The report of `demo`: what went in, what was made of it, what was found."""

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
SMALL = 220
"""Least width of a view on the page, CSS pixels, so that all shown views fit in one row."""
TEXTS = {
    "names": (
        "Where is each object?",
        "The labels teacher paints each pixel with the vector of its object's name. Lifted from all views onto the "
        "Gaussians, a word finds them by cosine; DBSCAN makes boxes of what passes the threshold.",
    ),
    "colors": (
        "Where is each color?",
        "The palette teacher looks at the photographs alone and names colors. A color on a wall or on the "
        "furniture is found too: the best box is not always the small object that was meant.",
    ),
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Asked:
    """One teacher's features, and what words found in them.

    Attributes:
        title: names or colors.
        words: that were asked.
        ious: of each word's first box with the true one; 0 without a box.
        fusion: the features, and what they cost.
        found: relevancy and boxes.
    """

    title: str
    words: tuple[str, ...]
    ious: tuple[float, ...]
    fusion: Fusion
    found: Localization

    @property
    def features(self) -> GaussianFeatures:
        return self.fusion.features

    @property
    def found_count(self) -> int:
        """Words whose first box has an IoU of 0.5 or more."""
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


def write_report(path: Path, scene: Scene, asked: Sequence[Asked], summary: Summary) -> None:
    """Draws and writes the page."""
    gaussians, views = scene.gaussians, scene.views
    assert gaussians is not None
    assert views is not None
    report = HtmlReport(
        "A room that answers to words",
        "Posed pictures with depth became Gaussians, 2D features were lifted onto them, and words became boxes.",
    )
    report.facts(
        {
            "Gaussians": len(gaussians),
            "views": len(views),
            "seconds before this page": sum(summary.timings.values()),
            "peak memory, MiB": peak_memory_mb(),
            **{f"{one.title} found": f"{one.found_count} of {len(one.words)}" for one in asked},
        }
    )
    shown = even_indices(len(views), SHOWN_VIEWS).tolist()
    _views(report, gaussians, views, asked, shown)
    for one in asked:
        _answers(report, scene, one)
    report.section("Where the time went")
    report.timings(summary.timings)
    report.section("What was chosen, and what it cost")
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
            for one in asked
        ],
    )
    report.write(path)


def _views(report: HtmlReport, gaussians: Gaussians, views: Views, asked: Sequence[Asked], shown: list[int]) -> None:
    colors = [_colors_of(one.features) for one in asked]
    rendered, depths, fields = [], [], [[] for _ in asked]  # type: ignore[var-annotated]
    for view in shown:
        b = blend(gaussians, views.cameras, view)
        rendered.append(render_image(gaussians, views.cameras, view, blended=b))
        depths.append(depth_picture(depth_image(b)))
        alpha = b.alpha.reshape(b.shape).numpy()
        for one, scale, pictures in zip(asked, colors, fields, strict=True):
            values = b.render(torch.from_numpy(one.features.features)).reshape(*b.shape, -1).numpy()
            pictures.append(pca_picture(values, scale, alpha))
    captions = [f"view {view}" for view in shown]
    if views.images is not None:
        report.section("What went in", "Pictures with known poses and depth, written to disk and read back.")
        report.pictures([views.images[view] for view in shown], captions, cell=SMALL)
    report.section("Gaussians", "Seeds from the depth maps: flat along the surface, colored by the pictures.")
    report.pictures(rendered, [f"{caption}, rendered" for caption in captions], cell=SMALL)
    report.pictures(depths, [f"{caption}, depth, bright is near" for caption in captions], cell=SMALL)
    report.section(
        "Features", "The three strongest directions of each field as red, green and blue, the same in every view."
    )
    for one, pictures in zip(asked, fields, strict=True):
        report.pictures(pictures, [f"{caption}, {one.title}" for caption in captions], cell=SMALL)


def _colors_of(features: GaussianFeatures) -> PcaColors:
    return fit_pca_colors(features.features[features.seen])


def _answers(report: HtmlReport, scene: Scene, one: Asked) -> None:
    report.section(*TEXTS[one.title])
    pictures = [np.asarray(picture) for _, picture in relevancy_pictures(scene, one.found, per_word=1)]
    boxed = {box.query for box in one.found.boxes}
    captions = [
        f"{word}: IoU {iou:.2f} with the true box" if word in boxed else f"{word}: no box"
        for word, iou in zip(one.words, one.ious, strict=True)
    ]
    report.pictures(pictures, captions)
    threshold = float(one.found.thresholds[0]) if len(one.found.thresholds) else None
    report.pictures([color_bar(640, 0.0, 1.0, mark=threshold)], ["relevancy, with the threshold"], lossless=True)
    rows = []
    for word, iou in zip(one.words, one.ious, strict=True):
        boxes = [box for box in one.found.boxes if box.query == word]
        best = boxes[0] if boxes else None
        center = ", ".join(f"{value:.2f}" for value in best.center) if best is not None else "–"
        rows.append((word, len(boxes), center, best.score if best is not None else 0.0, iou))
    report.table(("word", "boxes", "center of the first, m", "score", "IoU with the truth"), rows)
