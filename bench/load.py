"""How long reading takes: splat files, scenes, seeds.

    python bench/load.py PATH… [--runs 5]

A file or a SOG folder is read as a splat; any other folder as a scene, which is then seeded. Medians of several runs in
one process: files are in the page cache, libraries are loaded.
"""

import argparse
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from json_option import add_json_option, write_figures

from gsencoder.core.errors import SceneWarning
from gsencoder.data.scenes import load_scene
from gsencoder.data.seeding.seed import seed
from gsencoder.data.splats.files import load_splat


def timed(work: Callable[[], Any], runs: int) -> tuple[float, Any]:
    result, seconds = work(), []
    for _ in range(runs):
        start = time.perf_counter()
        result = work()
        seconds.append(time.perf_counter() - start)
    return float(np.median(seconds)), result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", nargs="+", type=Path)
    parser.add_argument("--runs", type=int, default=5)
    add_json_option(parser)
    options = parser.parse_args()
    warnings.simplefilter("ignore", SceneWarning)
    figures = {}
    for path in options.paths:
        if path.is_file() or (path / "meta.json").is_file():
            seconds, gaussians = timed(lambda path=path: load_splat(path), options.runs)
            print(f"{path.name}: {len(gaussians):,} Gaussians in {1000 * seconds:.0f} ms")
            figures[path.name] = {"gaussians": len(gaussians), "seconds": seconds}
            continue
        seconds, scene = timed(lambda path=path: load_scene(path), options.runs)
        views = len(scene.views) if scene.views is not None else 0
        figures[path.name] = {"views": views, "seconds": seconds}
        print(f"{path.name}: {views} views in {1000 * seconds:.0f} ms (pictures are read when they are asked for)")
        seconds, gaussians = timed(lambda scene=scene: seed(scene), options.runs)
        print(f"{path.name}: {len(gaussians):,} seeds in {seconds:.2f} s")
        figures[path.name] |= {"seeds": len(gaussians), "seconds of seeds": seconds}
    write_figures(options.json, figures)


if __name__ == "__main__":
    main()
