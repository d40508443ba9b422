"""Seconds of a fusion: the labels teacher onto seeds of a scene.

    python bench/fusion.py SCENE [--runs 5]

The first run is that of a fresh process. The digest of features and weights tells whether two versions, or two numbers
of threads, agree to the last bit.
"""

import argparse
import hashlib
import os
import statistics
import time
from pathlib import Path

from json_option import add_json_option, write_figures

from gsencoder.data.scenes import load_scene
from gsencoder.data.seeding.seed import SeedConfig, with_gaussians
from gsencoder.fusion.fuse import fuse
from gsencoder.teachers.build import words_of
from gsencoder.teachers.labels import LabelsConfig
from gsencoder.text.vocabulary import TableTextConfig


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--runs", type=int, default=5)
    add_json_option(parser)
    options = parser.parse_args()
    scene = with_gaussians(load_scene(options.scene), SeedConfig())
    teacher = LabelsConfig().build(scene, words_of(LabelsConfig(), TableTextConfig()))
    print(f"{len(scene.gaussians):,} Gaussians, {len(scene.views)} views")
    runs = []
    for _ in range(options.runs):
        start, before = time.perf_counter(), os.times()
        fusion = fuse(scene, teacher)
        seconds, after = time.perf_counter() - start, os.times()
        digest = hashlib.sha256(fusion.features.features.tobytes() + fusion.features.weights.tobytes()).hexdigest()[:12]
        cpu = after.user - before.user + after.system - before.system
        print(f"{seconds:.2f} s, {cpu:.2f} s of CPU time; {digest}")
        runs.append(seconds)
    figures = {
        "gaussians": len(scene.gaussians),
        "fresh process": runs[0],
        "later": statistics.median(runs[1:] or runs),
    }
    write_figures(options.json, figures)


if __name__ == "__main__":
    main()
