"""A large splat of many rooms: the seeds of scenes side by side, on a grid of places.

    python bench/side_by_side.py OUT.ply SCENE… [--spacing 9]
    gsencoder encode OUT.ply weights=house data.metres_per_unit=1

The first 18 house scenes give 3,082,565 Gaussians.
"""

import argparse
from dataclasses import fields
from pathlib import Path

import numpy as np

from gsencoder.data.scenes import load_scene
from gsencoder.data.seeding.seed import SeedConfig, with_gaussians
from gsencoder.data.splats.files import save_splat
from gsencoder.types import Gaussians

COLUMNS = 4


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("scenes", type=Path, nargs="+")
    parser.add_argument("--spacing", type=float, default=9.0, help="metres between neighbors")
    options = parser.parse_args()
    rooms = []
    for number, path in enumerate(options.scenes):
        seeds = with_gaussians(load_scene(path), SeedConfig()).gaussians
        assert seeds is not None
        row, column = divmod(number, COLUMNS)
        offset = np.array([column * options.spacing, row * options.spacing, 0], np.float32)
        parts = {each.name: getattr(seeds, each.name) for each in fields(Gaussians)}
        rooms.append(parts | {"means": seeds.means + offset})
    splat = Gaussians(**{name: np.concatenate([room[name] for room in rooms]) for name in rooms[0]})
    save_splat(options.out, splat)
    print(f"{len(splat):,} Gaussians of {len(rooms)} scenes in {options.out}")


if __name__ == "__main__":
    main()
