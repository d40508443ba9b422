"""A splat alone by a segmenter's words, against the same splat with photographs.

    python bench/splat_by_words.py $S/scenes/kitchen [--splat splat.ply] [--orbits 24] [--up 0,0,1]
                                                        [--sheet pictures.png]

The Gaussians of the scene (its seeds, or those of a fitted splat in its frame) get features from photographs, and
from renders of the Gaussians at cameras that are chosen without looking at the photographs (teacher=mosaic
text=minilm). Printed are the share of Gaussians, seen in both and weighted equally, whose nearest classes agree, and,
for each class that photographs give to 1 % of the Gaussians or more, the share that renders give it too. --sheet draws
the renders.
"""

import argparse
import os
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
from json_option import add_json_option, write_figures
from PIL import Image

from gsencoder.core.errors import SceneWarning
from gsencoder.data.scenes import load_scene
from gsencoder.data.seeding.seed import with_gaussians
from gsencoder.data.splats.files import load_splat
from gsencoder.data.up import with_up
from gsencoder.fusion.cameras import with_views
from gsencoder.fusion.fuse import fuse
from gsencoder.infer.draw import contact_sheet
from gsencoder.teachers.segmenter import OnnxSegmenterOptions, SegmenterConfig, SegmenterTeacher
from gsencoder.text.vocabulary import OnnxTextConfig, vocabulary_of
from gsencoder.types import GaussianFeatures


def classes_of(features: GaussianFeatures, teacher: SegmenterTeacher, mean: np.ndarray) -> np.ndarray:
    """The nearest class of each Gaussian by centered cosine."""
    centered = teacher.table - mean
    directions = centered / np.linalg.norm(centered, axis=1, keepdims=True)
    vectors = features.decode() - mean
    return np.asarray((vectors @ directions.T).argmax(axis=1))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--splat", type=Path)
    parser.add_argument("--orbits", type=int, default=24)
    parser.add_argument("--up", help="up of the world; without it up is estimated from the Gaussians")
    parser.add_argument("--sheet", type=Path)
    add_json_option(parser)
    options = parser.parse_args()
    warnings.simplefilter("ignore", SceneWarning)
    os.environ.setdefault("GSENCODER_MODELS", str(options.scene.parents[1] / "models"))
    network = OnnxSegmenterOptions(scale=1.0, mean=(0.0, 0.0, 0.0), std=(1.0, 1.0, 1.0))
    words = vocabulary_of(OnnxTextConfig(model="minilm_l6", pooling="mean"))
    teacher = SegmenterTeacher(SegmenterConfig(model="mosaic_ade31.onnx", onnx=network), words)
    scene = load_scene(options.scene)
    scene = replace(scene, gaussians=load_splat(options.splat)) if options.splat else with_gaussians(scene)
    print(f"{len(scene.gaussians or ()):,} Gaussians")
    stated = None if options.up is None else np.array([float(value) for value in options.up.split(",")])
    level, up = with_up(replace(scene, views=None, up=stated))
    print(f"up {'unknown' if up is None else up.describe()}")
    bare = with_views(level, options.orbits)[0]
    print(f"{len(bare.views)} cameras, {bare.views.names[0]} …")
    if options.sheet:
        pictures = [bare.views.images[view] for view in range(len(bare.views))]
        sheet = contact_sheet(pictures, list(bare.views.names), columns=4, width=320)
        Image.fromarray(sheet).save(options.sheet)
    photographed, rendered = fuse(scene, teacher).features, fuse(bare, teacher).features
    both = photographed.seen & rendered.seen
    true, given = (classes_of(each, teacher, words.mean)[both] for each in (photographed, rendered))
    print(f"seen in both: {both.sum():,}; the same class: {(true == given).mean():.3f}")
    classes = {}
    for number in np.argsort(-np.bincount(true, minlength=len(teacher.names))):
        share = (true == number).mean()
        if share >= 0.01:
            agreed = (given[true == number] == number).mean()
            classes[teacher.names[number]] = agreed
            print(f"  {teacher.names[number]}: {share:.3f} of the Gaussians, {agreed:.3f} of them by renders too")
    write_figures(options.json, {"cameras": len(bare.views), "agree": (true == given).mean(), "classes": classes})


if __name__ == "__main__":
    main()
