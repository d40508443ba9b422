"""Lifts color names from photographs onto Gaussians, finds a color as 3D boxes, and draws its relevancy.

gsencoder demo out=outputs/demo
python examples/01_fuse_and_localize.py outputs/demo/room red
"""

import sys
from dataclasses import replace

import numpy as np
import torch
from PIL import Image

from gsencoder import PaletteConfig, PaletteTeacher, fuse, load_scene, localize, render_image, seed, text_table_of
from gsencoder.render import blend


def main(folder: str, word: str) -> None:
    # Cameras, photographs and depth; the room has no splat, so Gaussians are seeded from its depth.
    scene = load_scene(folder)
    scene = replace(scene, gaussians=scene.gaussians or seed(scene))

    # The teacher gives every photograph a map of eleven color names; fusion averages the maps over all views.
    fusion = fuse(scene, PaletteTeacher())
    scene = replace(scene, features={fusion.features.space.name: fusion.features})
    print(f"{int(fusion.features.seen.sum()):,} of {len(scene.gaussians):,} Gaussians were seen")

    # Words are compared with features in the teacher's own space.
    localization = localize(scene, [word], text_table_of(PaletteConfig()))
    for box in localization.boxes:
        size = " × ".join(f"{side:.2f}" for side in box.aabb_max - box.aabb_min)
        print(f"{word} at {box.center.round(2)}, {size} m, score {box.score:.2f}, {len(box.rows)} Gaussians")

    # A view next to the word's relevancy, which is rendered as a color is. Gaussians that were never seen have none.
    relevancy = torch.as_tensor(np.nan_to_num(localization.relevancy[0])).clamp(min=0)
    b = blend(scene.gaussians, scene.views.cameras, 0)
    heat = (255 * b.render(relevancy[:, None])).byte().reshape(*b.shape, 1).expand(-1, -1, 3).numpy()
    picture = render_image(scene.gaussians, scene.views.cameras, 0, blended=b)
    Image.fromarray(np.hstack([picture, heat])).save("relevancy.png")
    print(f"relevancy.png: view 0, and where it is {word}")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(*sys.argv[1:])
