"""Parts of pages that several commands write: views of a scene, its features, and words in it."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch

from gsencoder.core.arrays import even_indices
from gsencoder.infer.draw import color_bar, depth_picture, fit_pca_colors, pca_picture
from gsencoder.infer.page.report import HtmlReport
from gsencoder.infer.pictures import relevancy_pictures
from gsencoder.render import blend
from gsencoder.render.images import depth_image, render_image
from gsencoder.types import GaussianFeatures, Localization, Scene
from gsencoder.types.orientation import upright_views

SHOWN_VIEWS = 4
MIN_CELL = 220
"""Smallest width of a view on the page, CSS pixels; all shown views fit in one row."""
PAIR_CELL = 560
"""Smallest width of a view with the relevancy beside it."""


def add_views(report: HtmlReport, scene: Scene, features: Mapping[str, GaussianFeatures]) -> None:
    """Adds some views of a scene: photographs where it has them, Gaussians, depth, and features as colors.

    Args:
        report: of the page.
        scene: Gaussians and cameras.
        features: of the Gaussians, by title.
    """
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
        depths.append(depth_picture(depth_image(b)))
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
        report: of the page.
        features: by title.
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
        report: of the page.
        scene: Gaussians, and cameras if there are to be pictures.
        localization: of the words.
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
