"""Phrases that are no names of the table: whether the first box of each is a right object, and whether it is known
where there is none.

    python bench/phrases.py $S/scenes/house [--first 40 --count 8 --every 1] [--text minilm_l6]

The phrases of `bench/house_phrases.csv` were written before the first run. Labels are fused in the space of the text
tower, and every phrase is asked in every room. It is present where a right object is seen in five views and with 60
pixels, and absent where no right object is listed at all. What the names of the right objects reach, asked one by one,
bounds what a phrase can.
"""

import argparse
import csv
import os
import warnings
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np
from json_option import add_json_option, write_figures
from sklearn.metrics import roc_auc_score

from gsencoder.core.errors import SceneWarning
from gsencoder.data.scenes import find_scenes, load_scene
from gsencoder.data.seeding.seed import seed
from gsencoder.evaluate.benchmarks.localization import aabb_iou
from gsencoder.fusion.fuse import fuse
from gsencoder.infer.localize import LocalizeConfig, localize
from gsencoder.teachers.labels import LabelsConfig
from gsencoder.text.vocabulary import OnnxTextConfig, vocabulary_of
from gsencoder.types import SceneObject

LEAST_IOU = 0.25
BINS = 10


def overlap(corners: tuple[np.ndarray, np.ndarray] | None, right: list[SceneObject]) -> float:
    """The largest IoU of a box with a right object; 0 without a box."""
    return 0.0 if corners is None else max(aabb_iou(*corners, o.aabb_min, o.aabb_max) for o in right)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--count", type=int, default=48)
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--text", default="minilm_l6")
    add_json_option(parser)
    options = parser.parse_args()
    warnings.simplefilter("ignore", SceneWarning)
    os.environ.setdefault("GSENCODER_MODELS", str(Path(options.scenes).parents[1] / "models"))
    words = vocabulary_of(OnnxTextConfig(model=options.text, pooling="mean"))
    with Path(__file__).with_name("house_phrases.csv").open(encoding="utf-8") as stream:
        names = {row["phrase"]: set(row["right"].split(";")) for row in csv.DictReader(stream)}
    present: dict[str, list[tuple[float, float, float]]] = defaultdict(list)
    absent: list[float] = []
    last = options.first + options.count
    for path in find_scenes([Path(options.scenes)])[options.first : last : options.every]:
        scene = load_scene(path)
        scene = replace(scene, gaussians=seed(scene))
        features = fuse(scene, LabelsConfig().build(scene, words)).features
        scene = replace(scene, features={features.space.name: features})
        kinds = sorted({o.name for o in scene.objects if o.name is not None})
        result = localize(scene, [*names, *kinds], words, LocalizeConfig(min_probability=0.0))
        corners = {
            word: next(((box.aabb_min, box.aabb_max) for box in result.boxes if box.query == word), None)
            for word in (*names, *kinds)
        }
        for phrase, value in zip(names, result.probabilities.tolist(), strict=False):
            listed = [o for o in scene.objects if o.name in names[phrase]]
            seen = [o for o in listed if o.views >= 5 and o.max_pixels >= 60]
            if seen:
                by_name = max(overlap(corners[kind], seen) for kind in {o.name for o in seen} if kind)
                present[phrase].append((value, overlap(corners[phrase], seen), by_name))
            elif not listed:
                absent.append(value)
        print(scene.name, flush=True)
    values = np.array([pair for pairs in present.values() for pair in pairs])
    level = LocalizeConfig().min_probability
    boxed, right = values[:, 0] >= level, values[:, 1] >= LEAST_IOU
    truth = np.concatenate([np.ones(len(values)), np.zeros(len(absent))])
    scores = np.concatenate([values[:, 0], absent])
    bins = np.minimum((scores * BINS).astype(int), BINS - 1)
    gaps = [abs((truth - scores)[bins == one].mean()) * (bins == one).mean() for one in np.unique(bins)]
    figures = {
        "present": len(values),
        "right": (boxed & right).mean(),
        "right of all boxes": right.mean(),
        "by name": (values[:, 2] >= LEAST_IOU).mean(),
        "boxed if present": boxed.mean(),
        "absent": len(absent),
        "boxed if absent": (np.array(absent) >= level).mean(),
        "AUROC": roc_auc_score(truth, scores),
        "calibration error": sum(gaps),
    }
    write_figures(options.json, figures)
    print(
        f"{len(present)} phrases, {len(values)} times present: first box right {figures['right']:.3f} "
        f"({figures['right of all boxes']:.3f} with min_probability=0), by its name {figures['by name']:.3f}, boxed "
        f"{figures['boxed if present']:.3f}; {len(absent)} times absent: boxed {figures['boxed if absent']:.3f}; AUROC "
        f"{figures['AUROC']:.3f}, ECE {figures['calibration error']:.3f}"
    )
    for phrase, pairs in sorted(present.items(), key=lambda item: np.mean([pair[1] >= LEAST_IOU for pair in item[1]])):
        median = np.median([pair[0] for pair in pairs])
        share, bound = (np.mean([pair[column] >= LEAST_IOU for pair in pairs]) for column in (1, 2))
        print(f"  right {share:.2f}  by name {bound:.2f}  median probability {median:.3f}  {len(pairs):2d}  {phrase}")


if __name__ == "__main__":
    main()
