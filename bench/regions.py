"""Regions with captions beside labels, and label images of photographs to try `teacher=regions` on.

    python bench/regions.py captions $S/scenes/house/train_04[0-3]
    python bench/regions.py masks PHOTOS OUT

The first fuses instance maps of labeled rooms as regions, with the names of all objects as captions, and with those of
the placed ones alone, and finds the placed ones. The second divides each photograph into about 60 regions by color and
place: k-means of L*a*b* color and position from a regular grid, as in SLIC (Achanta et al.), on every fourth pixel.
"""

import argparse
import os
import time
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
from json_option import add_json_option, write_figures
from PIL import Image

from gsencoder.core.errors import SceneWarning
from gsencoder.evaluate.protocols.localization import evaluate_localization
from gsencoder.evaluate.sources import fusion_source, load_scenes
from gsencoder.teachers.build import LabelsConfig, words_of
from gsencoder.teachers.labels import lab_from_rgb
from gsencoder.teachers.masks import RegionsConfig
from gsencoder.text.models import OnnxTextConfig
from gsencoder.types import GaussianFeatures, Scene

STEP, ITERATIONS, COMPACTNESS = 4, 6, 20.0


def superpixels(image: np.ndarray, count: int) -> np.ndarray:
    """Labels from 1, [H, W] uint16."""
    small = image[STEP // 2 :: STEP, STEP // 2 :: STEP]
    height, width = small.shape[:2]
    spacing = np.sqrt(height * width / count)
    rows, columns = max(1, round(height / spacing)), max(1, round(width / spacing))
    y, x = np.mgrid[:height, :width].astype(np.float32)
    position = np.stack([y, x], axis=-1) * np.float32(COMPACTNESS / spacing)
    points = np.concatenate([lab_from_rgb(small), position], axis=-1).reshape(-1, 5)
    at = np.add.outer(
        ((np.arange(rows) + 0.5) * height / rows).astype(int) * width,
        ((np.arange(columns) + 0.5) * width / columns).astype(int),
    )
    centers = points[at.ravel()]
    for _ in range(ITERATIONS):
        nearest = ((centers**2).sum(1) - 2 * points @ centers.T).argmin(axis=1)
        sizes = np.bincount(nearest, minlength=len(centers))
        sums = np.stack([np.bincount(nearest, points[:, c], len(centers)) for c in range(5)], axis=1)
        centers = np.where(sizes[:, None] > 0, sums / np.maximum(sizes, 1)[:, None], centers).astype(np.float32)
    labels = (nearest + 1).astype(np.uint16).reshape(height, width)
    line = np.minimum(np.arange(image.shape[0]) // STEP, height - 1)
    column = np.minimum(np.arange(image.shape[1]) // STEP, width - 1)
    return labels[line][:, column]


def write_masks(photos: str, out: str, count: int) -> None:
    folder, began, regions = Path(out), time.perf_counter(), 0
    folder.mkdir(parents=True, exist_ok=True)
    paths = sorted(path for path in Path(photos).iterdir() if path.suffix.lower() in (".jpg", ".jpeg", ".png"))
    for path in paths:
        labels = superpixels(np.asarray(Image.open(path).convert("RGB")), count)
        regions += len(np.unique(labels))
        Image.fromarray(labels).save(folder / f"{path.stem}.png")
    seconds = time.perf_counter() - began
    print(f"{len(paths)} label images, {regions / max(len(paths), 1):.0f} regions each, in {seconds:.1f} s")


def compare_captions(paths: list[str]) -> dict[str, dict[str, float]]:
    warnings.simplefilter("ignore", SceneWarning)
    os.environ.setdefault("GSENCODER_MODELS", str(Path(paths[0]).parents[2] / "models"))
    text, figures = OnnxTextConfig(model="minilm_l6", pooling="mean"), {}
    none, mean = (RegionsConfig(masks="instances", rest=rest) for rest in ("none", "mean"))
    for label, teacher, all_names in (
        ("labels", LabelsConfig(), True),
        ("regions, all names, rest=mean", mean, True),
        ("regions, all names, rest=none", none, True),
        ("regions, placed ones, rest=mean", mean, False),
        ("regions, placed ones, rest=none", none, False),
    ):
        words = words_of(teacher, text)
        assert words is not None
        fused = fusion_source(teacher, words)

        def source(scene: Scene, fused=fused, all_names=all_names) -> tuple[GaussianFeatures, dict[str, float]]:
            named = [replace(each, name=each.name if each.placed or all_names else None) for each in scene.objects]
            return fused(replace(scene, objects=tuple(named)))

        outcomes = evaluate_localization(load_scenes(paths), source, words)
        ious = np.array([hit.iou for outcome in outcomes for hit in outcome.hits])
        seconds = sum(sum(outcome.seconds.values()) for outcome in outcomes)
        found = {"Acc@0.25": (ious >= 0.25).mean(), "Acc@0.5": (ious >= 0.5).mean(), "mean IoU": ious.mean()}
        told = ", ".join(f"{name} {value:.3f}" for name, value in found.items())
        print(f"{label}: {len(ious)} objects, {told}, {seconds:.0f} s")
        figures[label] = found
    return figures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    captions = commands.add_parser("captions")
    captions.add_argument("scenes", nargs="+")
    add_json_option(captions)
    masks = commands.add_parser("masks")
    masks.add_argument("photos")
    masks.add_argument("out")
    masks.add_argument("--count", type=int, default=60)
    options = parser.parse_args()
    if options.command == "masks":
        write_masks(options.photos, options.out, options.count)
    else:
        write_figures(options.json, compare_captions(options.scenes))


if __name__ == "__main__":
    main()
