"""Rendered features of views on a vision tower's grid: seconds of the geometry, and of each rendering from it.

    python bench/tokens.py SCENE [--views 8] [--channels 1280] [--grid 27,27] [--rank 128]

Features are random, in a basis of some rank and as whole vectors; renderings are the median of five.
"""

import argparse
import statistics
import time

import numpy as np
from json_option import add_json_option, write_figures

from gsencoder.core.arrays import even_indices
from gsencoder.data.scenes import load_scene
from gsencoder.data.seeding.seed import with_gaussians
from gsencoder.infer.views.pictures import feature_tokens, token_blends
from gsencoder.types import FeatureBasis, FeatureSpace, GaussianFeatures

PASSES = 5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("scene")
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--channels", type=int, default=1280)
    parser.add_argument("--grid", default="27,27")
    parser.add_argument("--rank", type=int, default=128)
    add_json_option(parser)
    chosen = parser.parse_args()
    scene = with_gaussians(load_scene(chosen.scene))
    assert scene.gaussians is not None
    assert scene.views is not None
    cameras = scene.views.cameras.select(even_indices(len(scene.views), chosen.views))
    lines, columns = map(int, chosen.grid.split(","))
    n, d, rng = len(scene.gaussians), chosen.channels, np.random.default_rng(0)
    space = FeatureSpace(name="random", channels=d)
    mean, weights = rng.normal(size=d).astype(np.float32), np.ones(n, np.float32)
    components = np.linalg.qr(rng.normal(size=(d, chosen.rank)))[0].T.astype(np.float32)
    basis = FeatureBasis(mean=mean, components=np.ascontiguousarray(components), energy_kept=1.0, space=space)
    low = GaussianFeatures(
        features=rng.standard_normal((n, chosen.rank), np.float32),
        weights=weights,
        mean=mean,
        space=space,
        basis=basis,
    )
    whole = GaussianFeatures(features=rng.standard_normal((n, d), np.float32), weights=weights, mean=mean, space=space)
    token_blends(scene.gaussians, cameras.select([0]), (lines, columns))
    start = time.perf_counter()
    blends = token_blends(scene.gaussians, cameras, (lines, columns))
    spent = time.perf_counter() - start
    figures = {"geometry": spent}
    print(f"geometry of {len(blends)} views of {n:,} Gaussians on {lines} × {columns}: {spent:.2f} s")
    for name, features in (("in a basis", low), ("whole", whole)):
        seconds = []
        for _ in range(PASSES):
            start = time.perf_counter()
            feature_tokens(blends, features)
            seconds.append(time.perf_counter() - start)
        figures[name] = statistics.median(seconds)
        print(f"{d} channels {name} ({features.features.shape[1]} columns): {figures[name]:.2f} s")
    write_figures(chosen.json, {**figures, "whole / basis": figures["whole"] / figures["in a basis"]})


if __name__ == "__main__":
    main()
