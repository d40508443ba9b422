"""How long it takes to score instances: 100 scenes with 200 predicted masks each.

    python bench/scores.py [--scenes 100] [--instances 200] [--points 20000]

Scenes are random: instances are runs of vertices, and every mask is one of them, moved and cut. In the first row a
scene has as many vertices as `points`, in the second each instance has. Checking the masks, matching and scoring are
timed, and not how the data is made; then reading the files of some scenes of the first kind.
"""

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from json_option import add_json_option, write_figures

from gsencoder.data.labels.classes import ClassTable
from gsencoder.data.labels.files import write_integer_lines
from gsencoder.evaluate.benchmarks.instances import (
    InstancePrediction,
    instance_scores,
    match_instance_files,
    match_instances,
    write_instance_prediction,
)

CLASSES = ClassTable(
    names=tuple(f"class {number}" for number in range(1, 199)),
    ids=tuple(range(1, 199)),
    groups={
        group: tuple(f"class {number}" for number in range(first, first + 66))
        for group, first in (("head", 1), ("common", 67), ("tail", 133))
    },
)
FILE_SCENES = 3


def random_scene(seed: int, instances: int, mask: int) -> tuple[np.ndarray, InstancePrediction]:
    """A scene of `instances` runs of `mask` vertices, and as many masks of as many vertices."""
    vertices = instances * mask
    rng = np.random.default_rng(seed)
    starts = np.arange(instances) * mask
    labels = rng.integers(1, 199, instances)
    ids = np.repeat(labels * 1000 + np.arange(1, instances + 1), mask)
    begins = np.clip(starts + rng.integers(-mask // 3, mask // 3 + 1, instances), 0, vertices - mask)
    prediction = InstancePrediction(
        scene=f"scene{seed:04d}_00",
        num_vertices=vertices,
        masks=tuple(begins[:, None] + np.arange(mask)),
        labels=np.where(rng.random(instances) < 0.7, labels, rng.integers(1, 199, instances)),
        scores=rng.random(instances),
    )
    return ids, prediction


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--scenes", type=int, default=100)
    parser.add_argument("--instances", type=int, default=200)
    parser.add_argument("--points", type=int, default=20_000)
    add_json_option(parser)
    options = parser.parse_args()
    kinds = (max(options.points // options.instances, 100), options.points)
    figures: dict[str, float] = {}
    for mask in kinds:
        matches, seconds = [], 0.0
        for seed in range(options.scenes):
            ids, made = random_scene(seed, options.instances, mask)
            start = time.perf_counter()
            matches.append(match_instances(ids, replace(made), CLASSES))
            seconds += time.perf_counter() - start
        start = time.perf_counter()
        scores = instance_scores(matches, CLASSES)
        last = time.perf_counter() - start
        size = f"{options.instances * mask:,} vertices, {options.instances} masks of {mask:,}"
        print(f"{options.scenes} scenes of {size}: matching {seconds:.2f} s, scores {last:.2f} s")
        figures[f"masks of {mask}: seconds"] = seconds + last
        figures[f"masks of {mask}: AP"] = scores.overall["ap"]
        print(
            f"    AP {scores.overall['ap']:.3f}, AP50 {scores.overall['ap_50']:.3f}, AP25 {scores.overall['ap_25']:.3f}"
        )
    with tempfile.TemporaryDirectory() as name:
        folders = Path(name) / "predictions", Path(name) / "truth"
        for folder in folders:
            folder.mkdir(parents=True)
        for seed in range(FILE_SCENES):
            ids, prediction = random_scene(seed, options.instances, kinds[0])
            write_instance_prediction(folders[0], prediction)
            write_integer_lines(folders[1] / f"{prediction.scene}.txt", ids)
        start = time.perf_counter()
        instance_scores(list(match_instance_files(*folders, CLASSES)), CLASSES)
        seconds = (time.perf_counter() - start) / FILE_SCENES
        print(f"from files: {seconds:.3f} s a scene, {seconds * options.scenes:.1f} s for all")
        figures["files: seconds"] = seconds * options.scenes
    write_figures(options.json, figures)


if __name__ == "__main__":
    main()
