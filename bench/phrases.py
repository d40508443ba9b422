"""Phrases that are no names of the table: whether the first box of each is a right object.

    python bench/phrases.py $S/scenes/house [--rooms 48] [--text minilm_l6]

The phrases of `bench/house_phrases.csv` were written before the first run. Labels are fused in the space of the text
tower, and each phrase is asked in every room that holds one of its right objects well enough seen to be asked for.
"""

import argparse
import csv
import os
import warnings
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np

from gsencoder.core.errors import SceneWarning
from gsencoder.data.scenes import find_scenes, load_scene
from gsencoder.data.seeding.seed import seed
from gsencoder.evaluate.boxes import aabb_iou
from gsencoder.fusion.fuse import fuse
from gsencoder.fusion.teachers.build import build_teacher
from gsencoder.fusion.teachers.labels import LabelsConfig
from gsencoder.infer.localize.localize import LocalizeConfig, localize
from gsencoder.text.build import OnnxTextConfig, vocabulary_of

LEAST_IOU = 0.25


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes")
    parser.add_argument("--rooms", type=int, default=48)
    parser.add_argument("--text", default="minilm_l6")
    options = parser.parse_args()
    warnings.simplefilter("ignore", SceneWarning)
    os.environ.setdefault("GSENCODER_MODELS", str(Path(options.scenes).parents[1] / "models"))
    words = vocabulary_of(OnnxTextConfig(model=options.text, pooling="mean"))
    with Path(__file__).with_name("house_phrases.csv").open(encoding="utf-8") as stream:
        right = {row["phrase"]: set(row["right"].split(";")) for row in csv.DictReader(stream)}
    hits: dict[str, list[tuple[bool, bool]]] = defaultdict(list)
    for path in find_scenes([Path(options.scenes)])[: options.rooms]:
        scene = load_scene(path)
        objects = [o for o in scene.objects if o.name and o.views >= 5 and o.max_pixels >= 60]
        scene = replace(scene, gaussians=seed(scene))
        features = fuse(scene, build_teacher(LabelsConfig(), scene, words)).features
        scene = replace(scene, features={features.space.name: features})
        asked = [phrase for phrase, names in right.items() if any(o.name in names for o in objects)]
        boxes = localize(scene, asked, words, LocalizeConfig()).boxes
        for phrase in asked:
            first = next((box for box in boxes if box.query == phrase), None)
            ious = [
                aabb_iou(first.aabb_min, first.aabb_max, o.aabb_min, o.aabb_max) if first is not None else 0.0
                for o in objects
                if o.name in right[phrase]
            ]
            hits[phrase].append((first is not None, max(ious) >= LEAST_IOU))
    rows = [hit for each in hits.values() for hit in each]
    boxed, good = (np.array([hit[column] for hit in rows]) for column in (0, 1))
    by_phrase = {phrase: float(np.mean([hit[1] for hit in each])) for phrase, each in hits.items()}
    print(
        f"{len(hits)} phrases, {len(rows)} questions: first box right {good.mean():.3f}, boxed {boxed.mean():.3f}, "
        f"right where boxed {good[boxed].mean():.3f}; mean over phrases {np.mean(list(by_phrase.values())):.3f}"
    )
    for phrase, share in sorted(by_phrase.items(), key=lambda item: item[1]):
        print(f"  {share:.2f}  {np.mean([hit[0] for hit in hits[phrase]]):.2f} boxed  {len(hits[phrase]):2d}  {phrase}")


if __name__ == "__main__":
    main()
