"""The HTML report of `demo`: views, Gaussians, features, localized words, timings."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gsencoder.app.reports.parts import add_features, add_views, add_words
from gsencoder.app.runs.summary import Summary, peak_memory_mb
from gsencoder.fusion.fuse import Fusion
from gsencoder.infer.page.report import HtmlReport
from gsencoder.types import GaussianFeatures, Localization, Scene

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
