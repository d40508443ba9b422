"""A segmenter of photographs, an encoder, and both together (`fuse encoder=`): how often each names a Gaussian rightly.

    python bench/together.py WEIGHTS LIBRARIES [--homes 6] [--seed 3000] [--bias 0.3] [--json FILE]
    python bench/together.py WEIGHTS $S/scenes/kitchen --regions bench/kitchen_regions.csv

Made homes have held-out makes and photographs; the segmenter (teacher=mosaic text=minilm) is fused over these. With
--regions the truth is a table of boxes in the frame of an upright real scene, drawn by hand: Gaussians in a box are of
its class. All three are asked for all kinds, and a name is right if it belongs to a class of the segmenter's to which
the truth belongs, by its name, a synonym or a broader word; Gaussians of other kinds are left out. Means over homes, or
over regions, with the standard error.
"""

import argparse
import csv
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from errors import one_line_errors, positive
from furnished import VOXEL, classes_of_kinds, kinds_of, names_of, summary
from json_option import add_json_option, write_figures
from segmenter import mosaic

from gsencoder.core.errors import SceneWarning
from gsencoder.data.furnished.kinds import kinds
from gsencoder.data.furnished.library import load_libraries, select_makes
from gsencoder.data.furnished.plan import plan_home
from gsencoder.data.furnished.walk import furnished_scene, furnished_splat, splat_walk
from gsencoder.data.scenes import load_scene
from gsencoder.data.seeding.seed import SeedConfig, with_gaussians
from gsencoder.data.up import upright_gaussians, with_up
from gsencoder.fusion.fuse import fuse
from gsencoder.infer.encode import Encoder
from gsencoder.infer.ensemble import BIAS, surer_features
from gsencoder.types import Scene

WIDTH = 512
"""Width of the photographs: the segmenter sees squares of this size."""


def homes(libraries: Path, seed: int, count: int) -> Iterator[tuple[Scene, np.ndarray]]:
    """Homes of held-out makes with photographs, and the kind of each Gaussian."""
    models = select_makes(load_libraries([libraries]), "held_out")
    for number in range(count):
        home = plan_home(models, np.random.default_rng([seed, number]))
        # Without drift both draw the same cameras and materials.
        walk = replace(splat_walk(home, drift=0.0), width=WIDTH)
        scene = furnished_scene(home, f"home {number}", walk, np.random.default_rng([seed, number, 1]))
        labels = furnished_splat(home, walk, VOXEL, np.random.default_rng([seed, number, 1]))
        yield replace(scene, gaussians=labels.gaussians()), kinds_of(labels, home)


def regions(path: Path, table: Path) -> Iterator[tuple[Scene, np.ndarray]]:
    """A real scene for each region, and the kind of each of its Gaussians, −1 outside the region."""
    scene, _ = with_up(with_gaussians(load_scene(path), SeedConfig(voxel=VOXEL)))
    assert scene.gaussians is not None
    means = upright_gaussians(scene.gaussians, scene.up).means
    with table.open(newline="") as file:
        for row in csv.DictReader(file):
            lower, upper = (np.array([float(row[f"{axis}{end}"]) for axis in "xyz"]) for end in "01")
            inside = ((means >= lower) & (means <= upper)).all(axis=1)
            yield replace(scene, name=row["kind"]), np.where(inside, list(kinds()).index(row["kind"]), -1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights")
    parser.add_argument("source", type=Path)
    parser.add_argument("--regions", type=Path)
    parser.add_argument("--homes", type=positive, default=6)
    parser.add_argument("--seed", type=int, default=3000)
    parser.add_argument("--bias", type=float, default=BIAS)
    add_json_option(parser)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", SceneWarning)
    encoder, (teacher, _) = Encoder.load(arguments.weights), mosaic()
    words, space = encoder.words, next(iter(encoder.tables))
    assert words is not None
    belongs = classes_of_kinds(teacher.names)
    shares: dict[str, list[float]] = {"teacher": [], "encoder": [], "together": []}
    names_by_source: dict[str, np.ndarray] = {}
    if arguments.regions:
        scenes = regions(arguments.source, arguments.regions)
    else:
        scenes = homes(arguments.source, arguments.seed, arguments.homes)
    for scene, truth in scenes:
        if not arguments.regions or not names_by_source:
            assert scene.gaussians is not None
            fused = fuse(scene, teacher).features
            unit = scene.metres_per_unit or 1.0
            encoded = encoder.encode(scene.gaussians, space=space, metres_per_unit=unit, up=scene.up)
            both, by_encoder = surer_features(
                fused, encoded, words.encode(words.trained or words.names), words.mean, bias=arguments.bias
            )
            names_by_source = {
                title: names_of(each, words) for title, each in zip(shares, (fused, encoded, both), strict=True)
            }
            print(f"{by_encoder.mean():.2f} of the Gaussians have the encoder's features", flush=True)
        compared = (truth >= 0) & belongs[truth].any(axis=1) & (fused.weights > 0)
        for title, names in names_by_source.items():
            shares[title].append(float((belongs[names] & belongs[truth])[compared].any(axis=1).mean()))
        line = ", ".join(f"{title} {values[-1]:.3f}" for title, values in shares.items())
        print(f"{scene.name}: {compared.sum():,} Gaussians, {line}", flush=True)
    figures = {title: summary(values) for title, values in shares.items()}
    print(", ".join(f"{title} {each['mean']:.3f} ± {each['standard_error']:.3f}" for title, each in figures.items()))
    write_figures(arguments.json, {title: each["mean"] for title, each in figures.items()})


if __name__ == "__main__":
    with one_line_errors():
        main()
