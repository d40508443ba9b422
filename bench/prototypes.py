"""Words by example: a teacher without words gets them from labeled scenes, and is asked in others.

    python bench/prototypes.py dinov2_s14_dense_int8.onnx --learn SCENE… --ask SCENE…

A name's vector is the mean of the centered features of the Gaussians inside that name's boxes in the `--learn` scenes.
The `--ask` scenes are then scored by the protocol of `gsencoder evaluate`, over the names that were learned.
"""

import argparse
import dataclasses
import time
import warnings
from pathlib import Path

import numpy as np
from json_option import add_json_option, write_figures

from gsencoder.core.errors import SceneWarning
from gsencoder.data.scenes import load_scene
from gsencoder.data.seeding.seed import SeedConfig, seed
from gsencoder.evaluate.boxes import Hit
from gsencoder.evaluate.protocols.localization import LocalizationProtocol, score_queries, scores
from gsencoder.fusion.fuse import FuseConfig, fuse
from gsencoder.infer.localize import LocalizeConfig
from gsencoder.infer.relevancy import ThresholdConfig
from gsencoder.teachers.onnx import OnnxConfig, OnnxTeacher
from gsencoder.text.table import TextTable
from gsencoder.types import FeatureSpace, GaussianFeatures, Scene

ABOVE = 0.005
"""The lowest 5 mm of a box are left out: they hold what the object stands on."""
ENCODER = "examples"
THRESHOLDS = (0.3, 0.4, 0.5, 0.6)


def fused(path: str, config: OnnxConfig) -> tuple[Scene, GaussianFeatures]:
    scene = load_scene(path)
    scene = dataclasses.replace(scene, gaussians=seed(scene, SeedConfig()))
    return scene, fuse(scene, OnnxTeacher(config, text_encoder=ENCODER), FuseConfig()).features


def learn(paths: list[str], config: OnnxConfig) -> TextTable:
    sums: dict[str, np.ndarray] = {}
    channels = 0
    for path in paths:
        scene, features = fused(path, config)
        channels = features.space.channels
        assert scene.gaussians is not None
        points = scene.gaussians.means + scene.origin
        for one in scene.objects:
            low = one.aabb_min + np.array([0, 0, ABOVE])
            rows = np.flatnonzero(features.seen & (points >= low).all(axis=1) & (points <= one.aabb_max).all(axis=1))
            if one.placed and one.name and len(rows):
                vector = features.decode(rows).mean(axis=0) - features.mean
                sums[one.name] = sums.get(one.name, np.zeros(channels)) + vector / np.linalg.norm(vector)
        print(f"learned from {path}: {len(sums)} names", flush=True)
    names = tuple(sorted(sums))
    vectors = np.stack([sums[name] / np.linalg.norm(sums[name]) for name in names]).astype(np.float32)
    space = FeatureSpace(name=ENCODER, channels=channels, text_encoder=ENCODER)
    return TextTable(names=names, embeddings=vectors, space=space, mean=np.zeros(channels, np.float32))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model")
    parser.add_argument("--learn", nargs="+", required=True)
    parser.add_argument("--ask", nargs="+", required=True)
    add_json_option(parser)
    options = parser.parse_args()
    warnings.simplefilter("ignore", SceneWarning)
    config = OnnxConfig(model=options.model, layout="tokens", skip_tokens=1, patch=14, size=448)
    start = time.perf_counter()
    table = learn(options.learn, config)
    hits: dict[float, list[Hit]] = {level: [] for level in THRESHOLDS}
    for path in options.ask:
        scene, features = fused(path, config)
        known = tuple(one for one in scene.objects if one.name in table.names)
        scene = dataclasses.replace(scene, objects=known)
        for level in THRESHOLDS:
            found, _ = score_queries(
                scene,
                features,
                table,
                LocalizationProtocol(),
                LocalizeConfig(threshold=ThresholdConfig(kind="fixed", fixed=level)),
            )
            hits[level] += found
        print(f"asked {Path(path).name} after {time.perf_counter() - start:.0f} s", flush=True)
    table_of_levels = {level: scores(found) for level, found in hits.items()}
    write_figures(options.json, table_of_levels)
    for level, row in table_of_levels.items():
        figures = ", ".join(f"{name} {row[name]:.3f}" for name in ("acc_25", "acc_50", "oracle_acc_25", "mean_iou"))
        print(f"threshold {level}: {row['objects']} objects, {figures}")


if __name__ == "__main__":
    main()
