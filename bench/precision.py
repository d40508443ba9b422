"""Exports of one encoder in several precisions: bytes, features and seconds against the first of them.

    python bench/precision.py FLOAT32.onnx OTHER.onnx … --scenes SCENE …

Features are compared by centered cosine, Gaussian by Gaussian, of an encoder of several spaces in the one that has
words; 1 % of them are below the second figure. Seconds are the best of three passes, in which the files take turns.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from json_option import add_json_option, write_figures

from gsencoder.data.scenes import load_scene
from gsencoder.data.seeding.seed import with_gaussians
from gsencoder.fusion.basis import row_cosines
from gsencoder.infer.encode import EncodeConfig, Encoder
from gsencoder.types import GaussianFeatures

PASSES = 3


def cosines(ours: GaussianFeatures, theirs: GaussianFeatures) -> np.ndarray:
    """Of coordinates, which are centered as they are, or of vectors less the space's mean."""
    mean = ours.mean if ours.basis is None else np.float32(0)
    a, b = (each.features.astype(np.float64) - mean for each in (ours, theirs))
    return row_cosines(a, b)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("models", nargs="+")
    parser.add_argument("--scenes", nargs="+", required=True)
    add_json_option(parser)
    chosen = parser.parse_args()
    config = EncodeConfig(chunk=0, device="cpu")
    encoders = {name: Encoder.load(name, "cpu") for name in chosen.models}
    space = next(iter(encoders[chosen.models[0]].tables), None)
    means, lows, seconds = ({name: list[float]() for name in encoders} for _ in range(3))
    for scene in chosen.scenes:
        gaussians = with_gaussians(load_scene(scene)).gaussians
        features = {name: encoder.encode(gaussians, config, space=space) for name, encoder in encoders.items()}
        best = dict.fromkeys(encoders, np.inf)
        for _ in range(PASSES):
            for name, encoder in encoders.items():
                start = time.perf_counter()
                encoder.encode(gaussians, config, space=space)
                best[name] = min(best[name], time.perf_counter() - start)
        for name in encoders:
            near = cosines(features[name], features[chosen.models[0]])
            means[name].append(float(near.mean()))
            lows[name].append(float(np.quantile(near, 0.01)))
            seconds[name].append(best[name] / best[chosen.models[0]])
    size = Path(chosen.models[0]).stat().st_size
    figures = {}
    for name, encoder in encoders.items():
        figures[encoder.network.header.precision] = {
            "size": Path(name).stat().st_size / size,
            "cosine": np.mean(means[name]),
            "1 % below": np.mean(lows[name]),
            "seconds": np.median(seconds[name]),
        }
        print(
            f"{encoder.network.header.precision}: bytes {Path(name).stat().st_size / size:.3f}; centered cosine "
            f"{np.mean(means[name]):.5f} (worst scene {min(means[name]):.5f}), 1 % below {np.mean(lows[name]):.4f}; "
            f"seconds {np.median(seconds[name]):.2f} ({min(seconds[name]):.2f} to {max(seconds[name]):.2f})"
        )
    write_figures(chosen.json, {"bytes": size, **figures})


if __name__ == "__main__":
    main()
