"""The HTML page of a fusion, whose parts the page of `demo` has, too."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch

from gsencoder.app.run import Run
from gsencoder.core.arrays import even_indices
from gsencoder.infer.draw import depth_picture, fit_pca_colors, pca_picture
from gsencoder.infer.page.report import HtmlReport
from gsencoder.render import blend
from gsencoder.render.images import render_image
from gsencoder.types import GaussianFeatures, Scene
from gsencoder.types.orientation import upright_views

REPORT = "report.html"
SHOWN_VIEWS = 4
MIN_CELL = 220
"""Smallest width of a view on the page, CSS pixels; all views fit in one row."""


def add_views(report: HtmlReport, scene: Scene, features: Mapping[str, GaussianFeatures]) -> None:
    """Adds some views of a scene: photographs where it has them, Gaussians, depth, and features as colors."""
    assert scene.gaussians is not None
    assert scene.views is not None
    views = upright_views(scene.views)
    numbers = even_indices(len(views), SHOWN_VIEWS).tolist()
    rendered, depths = [], []
    colors = {title: fit_pca_colors(each.stored(each.seen)) for title, each in features.items()}
    stored = {title: torch.from_numpy(each.stored()) for title, each in features.items()}
    fields: dict[str, list[np.ndarray]] = {title: [] for title in features}
    for view in numbers:
        b = blend(scene.gaussians, views.cameras, view)
        rendered.append(render_image(scene.gaussians, views.cameras, view, blended=b))
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
    """Adds a table of features; `truncation` is what the basis costs, as a centered cosine error, by title."""
    columns = ("features", "channels", "rank of the basis", "energy kept", "centered cosine error", "Gaussians seen")
    rows = []
    for title, each in features.items():
        kept = each.basis.energy_kept if each.basis is not None else 1.0
        shape = each.space.channels, each.features.shape[1]
        rows.append((title, *shape, kept, truncation[title], int(each.seen.sum())))
    report.table(columns, rows)


def report_fusion(
    folder: Path, scene: Scene, features: GaussianFeatures, truncation: float, teacher: str, run: Run
) -> None:
    """Writes the page of a fusion; `truncation` is what the basis costs, as a centered cosine error."""
    report = HtmlReport(f"Features of {scene.name}", f"Maps of the teacher {teacher}, lifted from all views.")
    assert scene.views is not None
    counts = {"Gaussians": len(features), "with features": int(features.seen.sum()), "views": len(scene.views)}
    report.facts({**counts, **run.costs()})
    add_views(report, scene, {teacher: features})
    add_features(report, {teacher: features}, {teacher: truncation})
    report.section("Seconds of each step")
    report.timings(run.timings)
    report.write(folder / REPORT)
