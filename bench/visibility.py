"""How each lift and each visibility test changes what is found: SplatDistill's protocol on labeled scenes.

    python bench/visibility.py SCENE… [--voxels 0.02,0.01] [--thresholds 0.4] [--out table.csv]

Seeds are made once a scene and voxel, then fused in every way. Rays per patch do not matter for the labels teacher,
whose maps have one cell a pixel. Rows appear in the table when all scenes are done; a line a scene tells how far it is.
"""

import argparse
import dataclasses
import time
import warnings
from pathlib import Path

from json_option import add_json_option, write_figures

from gsencoder.core.errors import SceneWarning
from gsencoder.core.files import csv_text
from gsencoder.data.scenes import find_scenes, load_scene
from gsencoder.data.seeding.seed import SeedConfig, seed
from gsencoder.evaluate.benchmarks.localization import Hit, LocalizationProtocol, score_queries, scores
from gsencoder.fusion.fuse import FuseConfig, fuse
from gsencoder.fusion.lift import VisibilityConfig
from gsencoder.infer.localize import LocalizeConfig
from gsencoder.infer.relevancy import ThresholdConfig
from gsencoder.teachers.build import text_table_of
from gsencoder.teachers.labels import LabelsConfig

VISIBILITIES = {
    "none": VisibilityConfig(against=()),
    **{
        f"{source} {kind} {size}": VisibilityConfig(
            against=(source,),
            relative=size if kind == "relative" else 0.0,
            absolute=size if kind == "absolute" else 0.0,
        )
        for source in ("sensor", "rendered")
        for kind, size in (("relative", 0.01), ("relative", 0.02), ("relative", 0.05), ("absolute", 0.05))
    },
    "both relative 0.02": VisibilityConfig(against=("sensor", "rendered"), relative=0.02),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--voxels", default="0.02,0.01")
    parser.add_argument("--thresholds", default="0.4")
    parser.add_argument("--cell", type=int, default=1, help="pixels along a cell of the labels teacher")
    parser.add_argument("--lifts", default="blend,center")
    parser.add_argument("--only", default="", help="names of visibility tests, separated by commas")
    parser.add_argument("--out", type=Path, default=Path("visibility.csv"))
    add_json_option(parser)
    options = parser.parse_args()
    warnings.simplefilter("ignore", SceneWarning)
    teacher = LabelsConfig(cell=options.cell)
    words = text_table_of(teacher)
    tests = {name: VISIBILITIES[name] for name in options.only.split(",") if name} or VISIBILITIES
    thresholds = [float(value) for value in options.thresholds.split(",")]
    hits: dict[tuple[float, str, str, float], list[Hit]] = {}
    seen: dict[tuple[float, str, str], list[float]] = {}
    start = time.perf_counter()
    for path in find_scenes(options.scenes):
        for voxel in map(float, options.voxels.split(",")):
            scene = load_scene(path)
            scene = dataclasses.replace(scene, gaussians=seed(scene, SeedConfig(voxel=voxel)))
            labels = teacher.build(scene, words)
            for lift in options.lifts.split(","):
                for name, visibility in tests.items():
                    config = FuseConfig(lift=lift, visibility=visibility)  # type: ignore[arg-type]
                    features = fuse(scene, labels, config).features
                    seen.setdefault((voxel, lift, name), []).append(float(features.seen.mean()))
                    for level in thresholds:
                        asked = LocalizeConfig(threshold=ThresholdConfig(kind="fixed", fixed=level))
                        found, _ = score_queries(scene, features, words, LocalizationProtocol(), asked)
                        hits.setdefault((voxel, lift, name, level), []).extend(found)
        print(f"{path.name}: {time.perf_counter() - start:.0f} s", flush=True)
        rows = [
            {
                "voxel": voxel, "lift": lift, "visibility": name, "threshold": level, **scores(found),
                "seen": sum(seen[voxel, lift, name]) / len(seen[voxel, lift, name]),
            }
            for (voxel, lift, name, level), found in hits.items()
        ]  # fmt: skip
        options.out.write_text(csv_text(rows))
    print(options.out.read_text())
    keys = ("voxel", "lift", "visibility", "threshold")
    write_figures(options.json, {", ".join(str(row[key]) for key in keys): row for row in rows})


if __name__ == "__main__":
    main()
