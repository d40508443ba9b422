"""Labeled rooms twice: with Gaussians from their depth images, and with the same ones fitted to the photographs.

    python bench/mix.py HOUSE OUT [--names 'train_0*'] [--fitted '*'] [--steps 600] [--options raster.eps2d=0.1 …]
    torchrun --nproc_per_node=2 -m gsencoder train OUT experiment=house_cpu splat=splat.ply holdout=train_04*
    gsencoder evaluate OUT/train_04*_fitted splat=splat.ply weights=…

OUT/NAME holds the scene and its seeds, OUT/NAME_fitted the scene and its reconstruction, each as splat.ply; of scenes
that do not match --fitted there are seeds alone. What is in OUT already is not made again, so that several calls, also
at the same time, may share the work.
"""

import argparse
import fnmatch
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from errors import existing_folder, matching_names, one_line_errors, output_folder

SEEDS_ALONE = ["optimize.steps=0", "holdout=0"]


def add(scene: Path, target: Path, options: list[str]) -> None:
    """A copy of the scene with the splat that `reconstruct` makes of it; it appears whole."""
    if target.exists():
        return
    with tempfile.TemporaryDirectory(dir=target.parent) as made:
        command = [sys.executable, "-m", "gsencoder", "reconstruct", str(scene), f"out={made}/out", *options]
        subprocess.run([*command, "validate_every=0", "quiet=true"], check=True)
        copy = Path(made) / "scene"
        shutil.copytree(scene, copy)
        shutil.copy(Path(made) / "out" / "splat.ply", copy)
        try:
            os.rename(copy, target)
        except OSError:
            # Another call has made it in the meantime.
            if not target.exists():
                raise


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("house", type=existing_folder)
    parser.add_argument("out", type=output_folder)
    parser.add_argument("--names", default="train_0*")
    parser.add_argument("--fitted", default="*", help="names of the scenes that are reconstructed")
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--options", nargs="*", default=["raster.eps2d=0.1"])
    arguments = parser.parse_args()
    scenes = matching_names(parser, arguments.house, arguments.names)
    arguments.out.mkdir(parents=True, exist_ok=True)
    for scene in scenes:
        add(scene, arguments.out / scene.name, SEEDS_ALONE)
        if fnmatch.fnmatch(scene.name, arguments.fitted):
            options = [f"optimize.steps={arguments.steps}", *arguments.options]
            add(scene, arguments.out / f"{scene.name}_fitted", options)
        print(scene.name, flush=True)


if __name__ == "__main__":
    with one_line_errors():
        main()
