"""Lifts color names from photographs onto Gaussians, and finds a color as 3D boxes.

gsencoder demo out=outputs/demo
python examples/01_fuse_and_localize.py outputs/demo/room red
"""

import sys
from dataclasses import replace

from gsencoder import PaletteConfig, PaletteTeacher, fuse, load_scene, localize, seed, text_table_of


def main(folder: str, word: str) -> None:
    # Cameras, photographs and depth; the room has no splat, so Gaussians are seeded from its depth.
    scene = load_scene(folder)
    scene = replace(scene, gaussians=scene.gaussians or seed(scene))

    # The teacher gives every photograph a map of eleven color names; fusion averages the maps over all views.
    fusion = fuse(scene, PaletteTeacher())
    scene = replace(scene, features={fusion.features.space.name: fusion.features})
    print(f"{int(fusion.features.seen.sum()):,} of {len(scene.gaussians):,} Gaussians were seen")

    # Words are compared with features in the teacher's own space.
    for box in localize(scene, [word], text_table_of(PaletteConfig())).boxes:
        size = " × ".join(f"{side:.2f}" for side in box.aabb_max - box.aabb_min)
        print(f"{word} at {box.center.round(2)}, {size} m, score {box.score:.2f}, {len(box.rows)} Gaussians")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(*sys.argv[1:])
