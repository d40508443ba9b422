"""A segmenter's words on real photographs: agreement on frames that were left out.

    python bench/segmenter.py $S/scenes/kitchen

Every eighth frame is left out of the fusion (teacher=mosaic text=minilm). The fused features, rendered there, are named
by their nearest class and compared with the network's own map of the photograph; both are compared with the red fronts
of the cabinets, recognized by color.
"""

import argparse
import os
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from json_option import add_json_option, write_figures
from PIL import Image

from gsencoder.core.errors import SceneWarning
from gsencoder.data.scenes import load_scene
from gsencoder.data.seeding.seed import with_gaussians
from gsencoder.fusion.fuse import fuse
from gsencoder.render import blend
from gsencoder.teachers.segmenter import OnnxSegmenterOptions, SegmenterConfig, SegmenterTeacher
from gsencoder.text.vocabulary import OnnxTextConfig, Words, vocabulary_of

MIN_ALPHA = 0.5
"""Pixels of a render below this alpha are not compared."""


def mosaic() -> tuple[SegmenterTeacher, Words]:
    """The segmenter, and the text encoder of its classes."""
    network = OnnxSegmenterOptions(scale=1.0, mean=(0.0, 0.0, 0.0), std=(1.0, 1.0, 1.0))
    words = vocabulary_of(OnnxTextConfig(model="minilm_l6", pooling="mean"))
    return SegmenterTeacher(SegmenterConfig(model="mosaic_ade31.onnx", onnx=network), words), words


def red_fronts(image: np.ndarray) -> np.ndarray:
    """Pixels of the red cabinet fronts: red at least 1.7 times green and blue, and not dark."""
    red, green, blue = image.astype(np.float32).transpose(2, 0, 1)
    return (red > 50) & (red > 1.7 * green) & (red > 1.7 * blue)


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / max(int((a | b).sum()), 1))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene")
    parser.add_argument("--every", type=int, default=8)
    add_json_option(parser)
    options = parser.parse_args()
    warnings.simplefilter("ignore", SceneWarning)
    os.environ.setdefault("GSENCODER_MODELS", str(Path(options.scene).parents[1] / "models"))
    teacher, words = mosaic()
    scene = load_scene(options.scene)
    views = scene.views
    left_out = np.arange(0, len(views), options.every)
    fitted = np.setdiff1d(np.arange(len(views)), left_out)
    scene = with_gaussians(replace(scene, views=views.select(fitted)))
    features = fuse(scene, teacher).features
    basis = features.basis
    values = torch.from_numpy(np.concatenate([features.features, features.seen[:, None]], axis=1).astype(np.float32))
    centered = teacher.table - words.mean
    directions = centered / np.linalg.norm(centered, axis=1, keepdims=True)
    cabinet = teacher.names.index("cabinet")
    agreements, red = [], []
    for view in left_out.tolist():
        maps = blend(scene.gaussians, views.cameras, view).render(values).numpy()
        seen = maps[:, -1] >= MIN_ALPHA
        vectors = (maps[:, :-1] / np.maximum(maps[:, -1:], 1e-6)) @ basis.components + basis.mean - words.mean
        named = (vectors @ directions.T).argmax(axis=1)
        shares = teacher.feature_map(views, view).shares
        image = views.images[view]
        predicted = shares.argmax(axis=-1).astype(np.uint8)
        predicted = np.asarray(Image.fromarray(predicted).resize(image.shape[1::-1], Image.Resampling.NEAREST)).ravel()
        agreements.append(float((named == predicted)[seen].mean()))
        fronts = red_fronts(image).ravel()[seen]
        if fronts.mean() > 0.01:
            red.append((iou(named[seen] == cabinet, fronts), iou(predicted[seen] == cabinet, fronts)))
    fused, network_iou = np.mean(red, axis=0)
    print(f"{len(left_out)} frames left out: {np.mean(agreements):.3f} of the pixels have the network's own class")
    figures = {"agreement": np.mean(agreements), "IoU, fused": fused, "IoU, network": network_iou}
    write_figures(options.json, figures)
    print(f"red fronts in {len(red)} frames: IoU {fused:.3f} of the fused map, {network_iou:.3f} of the network's own")


if __name__ == "__main__":
    main()
