"""Label images of photographs by color and place, to try `teacher=regions` on without a segmenter.

    python bench/regions.py PHOTOS OUT [COUNT]

Each photograph becomes about COUNT (60) regions: k-means of L*a*b* color and position from a regular grid, as in SLIC
(Achanta et al.), on every fourth pixel. Colors are those of the files.
"""

import sys
import time
from pathlib import Path

import numpy as np
from PIL import Image

from gsencoder.fusion.teachers.palette import lab_from_rgb

STEP, ITERATIONS, COMPACTNESS = 4, 6, 20.0


def superpixels(image: np.ndarray, count: int) -> np.ndarray:
    """Labels from 1, [H, W] uint16."""
    small = image[STEP // 2 :: STEP, STEP // 2 :: STEP]
    height, width = small.shape[:2]
    spacing = np.sqrt(height * width / count)
    rows, columns = max(1, round(height / spacing)), max(1, round(width / spacing))
    y, x = np.mgrid[:height, :width].astype(np.float32)
    place = np.stack([y, x], axis=-1) * np.float32(COMPACTNESS / spacing)
    points = np.concatenate([lab_from_rgb(small), place], axis=-1).reshape(-1, 5)
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


def main(photos: str, out: str, count: str = "60") -> None:
    folder, began, regions = Path(out), time.perf_counter(), 0
    folder.mkdir(parents=True, exist_ok=True)
    paths = sorted(path for path in Path(photos).iterdir() if path.suffix.lower() in (".jpg", ".jpeg", ".png"))
    for path in paths:
        labels = superpixels(np.asarray(Image.open(path).convert("RGB")), int(count))
        regions += len(np.unique(labels))
        Image.fromarray(labels).save(folder / f"{path.stem}.png")
    seconds = time.perf_counter() - began
    print(f"{len(paths)} label images, {regions / max(len(paths), 1):.0f} regions each, in {seconds:.1f} s")


if __name__ == "__main__":
    main(*sys.argv[1:])
