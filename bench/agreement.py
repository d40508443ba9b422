"""How often an encoder gives a real scene the names that a segmenter of its photographs gives it.

    python bench/agreement.py WEIGHTS $S/scenes/kitchen [--voxel 0.02] [--json FILE]

The scene is seeded from its depth, a segmenter (teacher=mosaic text=minilm) is fused over all photographs, and the same
seeds are encoded. A Gaussian is compared where the commonest class that the segmenter gives it is one of the encoder's
kinds, or one of their synonyms or hypernyms; a name agrees if the class is one of its own. `agreement` is the share of
names that agree where the encoder's name, too, is one that the segmenter has a class for; `of_all` the share of all.
"""

import argparse
import warnings
from pathlib import Path

import numpy as np
from errors import one_line_errors
from furnished import classes_of_kinds, names_of
from json_option import add_json_option, write_figures
from segmenter import mosaic

from gsencoder.core.errors import SceneWarning
from gsencoder.data.furnished.kinds import kinds
from gsencoder.data.scenes import load_scene
from gsencoder.data.seeding.seed import SeedConfig, with_gaussians
from gsencoder.data.up import with_up
from gsencoder.fusion.fuse import fuse
from gsencoder.infer.encode import Encoder
from gsencoder.infer.relevancy import relevancy


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights")
    parser.add_argument("scene", type=Path)
    parser.add_argument("--voxel", type=float, default=0.02)
    add_json_option(parser)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", SceneWarning)
    encoder = Encoder.load(arguments.weights)
    words, space = encoder.words, next(iter(encoder.tables))
    assert words is not None
    teacher, vocabulary = mosaic()
    scene, _ = with_up(with_gaussians(load_scene(arguments.scene), SeedConfig(voxel=arguments.voxel)))
    assert scene.gaussians is not None
    fused = fuse(scene, teacher).features
    classes = relevancy(fused, teacher.table, vocabulary.mean).argmax(axis=0)
    encoded = encoder.encode(scene.gaussians, space=space, metres_per_unit=scene.metres_per_unit or 1.0, up=scene.up)
    names = names_of(encoded, words)
    belongs = classes_of_kinds(teacher.names)
    compared = (fused.weights > 0) & belongs.any(axis=0)[classes]
    agrees = belongs[names, classes]
    comparable = compared & belongs.any(axis=1)[names]
    figures = {"agreement": agrees[comparable].mean(), "of_all": agrees[compared].mean()}
    line = ", ".join(f"{name} {share:.3f}" for name, share in figures.items())
    print(f"{compared.sum():,} of {len(names):,} Gaussians compared: {line}")
    every = list(kinds())
    for number in np.flatnonzero(belongs.any(axis=0)):
        rows = compared & (classes == number)
        if rows.mean() > 0.001:
            common = np.bincount(names[rows], minlength=len(every))
            line = ", ".join(f"{every[kind]} {common[kind] / rows.sum():.2f}" for kind in np.argsort(-common)[:5])
            print(f"{teacher.names[number]:10} {rows.sum():7,} Gaussians, {agrees[rows].mean():.3f} agree: {line}")
    write_figures(arguments.json, figures)


if __name__ == "__main__":
    with one_line_errors():
        main()
